"""Server-sent events for each change of a job, from the queue's own stream of changes.

One poller per watched job reads the queue, however many callers listen. All callers read the same list of the last
MAX_EVENTS changes, each at its own pace, so a slow caller costs no memory and delays nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass

from fastapi.sse import format_sse_event
from starlette.concurrency import run_in_threadpool

from contract.queue.interface import MAX_EVENTS, Queue, event_order
from contract.wire.job import TERMINAL_STATES, Forecast, JobRecord, JobState, JobView
from intrasplat.errors import UnavailableError

POLL_PERIOD_S = 0.4
LOOK_PERIOD_S = 2.0
"""How often to check whether a job that has not ended was purged, and its position in the queue."""
HEARTBEAT_S = 15.0
"""Interval of heartbeats: proxies close a connection after 30 s or more of silence."""
STREAM_S = 3600.0
"""Maximum length of a stream. The caller then reconnects with its key, so a revoked key stops here at the latest."""
RETRY_MS = 2000

EventOrder = tuple[int, int]
"""The sort key of an event number."""
NOTHING_SEEN: EventOrder = (0, 0)


@dataclass(frozen=True)
class Entry:
    """One message to the listeners. number None: it is not an event of the queue, such as a new forecast."""

    number: str | None
    state: JobState
    data: str


class Feed:
    """The last changes of one job. count: how many there have been in total; changed: set at the next one."""

    def __init__(self, job_id: str) -> None:
        self.job_id = job_id
        self.listeners = 0
        self.count = 0
        self.is_over = False
        self.changed = asyncio.Event()
        self._entries: deque[Entry] = deque(maxlen=MAX_EVENTS)

    @property
    def newest(self) -> Entry | None:
        """The last entry."""
        return self._entries[-1] if self._entries else None

    def add(self, record: JobRecord, number: str | None = None, forecast: Forecast | None = None) -> None:
        """Send the job's present state to the listeners."""
        self._entries.append(Entry(number, record.state, JobView.of(record, forecast).model_dump_json()))
        self.count += 1
        self.wake()

    def end(self) -> None:
        """Mark the feed as ended."""
        self.is_over = True
        self.wake()

    def wake(self) -> None:
        """Wake all listeners."""
        self.changed.set()
        self.changed = asyncio.Event()

    def since(self, seen: int) -> list[Entry]:
        """The stored entries after the first `seen`."""
        new = min(self.count - seen, len(self._entries))
        return list(self._entries)[len(self._entries) - new :]

    def seen_at(self, order: EventOrder) -> int:
        """How many of all entries a listener has seen whose last event was `order`."""
        for unseen, entry in enumerate(reversed(self._entries)):
            if entry.number is not None and event_order(entry.number) <= order:
                return self.count - unseen
        return self.count - len(self._entries)


class Feeds:
    """The feeds that have listeners, with their pollers."""

    def __init__(self, queue: Queue) -> None:
        self._queue = queue
        self._feeds: dict[str, Feed] = {}
        self._pollers: dict[str, asyncio.Task[None]] = {}
        self._is_ending = False

    def end(self) -> None:
        """End all streams within a poll's period. May be called from a signal handler."""
        self._is_ending = True

    async def stream(self, job_id: str, after: EventOrder) -> AsyncIterator[bytes]:
        """The events after `after` and all later ones until the job's end, encoded for text/event-stream."""
        ends_at_s = time.monotonic() + STREAM_S
        with self._listening(job_id) as feed:
            yield format_sse_event(retry=RETRY_MS)
            while not (feed.count or feed.is_over):
                await feed.changed.wait()
            seen = feed.seen_at(after)
            while True:
                changed = feed.changed
                for entry in feed.since(seen):
                    yield format_sse_event(event="job", id=entry.number, data_str=entry.data)
                seen = feed.count
                newest = feed.newest
                has_ended = newest is not None and newest.state in TERMINAL_STATES
                if feed.is_over or has_ended or time.monotonic() > ends_at_s:
                    return
                try:
                    async with asyncio.timeout(HEARTBEAT_S):
                        await changed.wait()
                except TimeoutError:
                    yield format_sse_event(comment="still here")

    @contextlib.contextmanager
    def _listening(self, job_id: str) -> Iterator[Feed]:
        feed = self._feeds.get(job_id)
        if feed is None:
            feed = self._feeds[job_id] = Feed(job_id)
            self._pollers[job_id] = asyncio.create_task(self._poll(feed))
        feed.listeners += 1
        try:
            yield feed
        finally:
            feed.listeners -= 1
            if feed.listeners == 0:
                self._pollers.pop(job_id).cancel()
                del self._feeds[job_id]

    async def _poll(self, feed: Feed) -> None:
        after, looked_at_s, forecast = "0", 0.0, None
        while not (feed.is_over or self._is_ending):
            with contextlib.suppress(UnavailableError):  # the listeners get the changes when the queue is back
                for event in await run_in_threadpool(self._queue.events, feed.job_id, after):
                    feed.add(event.record, event.number)
                    after, forecast = event.number, None
                if time.monotonic() >= looked_at_s + LOOK_PERIOD_S:
                    forecast = await self._look(feed, forecast)
                    looked_at_s = time.monotonic()
            await asyncio.sleep(POLL_PERIOD_S)
        feed.end()

    async def _look(self, feed: Feed, sent: Forecast | None) -> Forecast | None:
        """Send a changed position in the queue, and a job without events. Returns the forecast that was sent last."""
        record = await run_in_threadpool(self._queue.get, feed.job_id)
        if record is None:
            feed.end()
            return None
        if record.state in TERMINAL_STATES:
            if feed.newest is None:  # the job was restored after the queue had lost it
                feed.add(record)
            return None
        forecast = await run_in_threadpool(self._queue.forecast, feed.job_id)
        if sent is None or forecast.position != sent.position:
            feed.add(record, forecast=forecast)
        return forecast
