"""Server-sent events for each change of a job or a live feed.

One poller for each of them that is watched reads the queue, however many callers listen. All callers read the same list
of the last MAX_EVENTS changes, each at its own pace, so a slow caller costs no memory and delays nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

from fastapi.sse import format_sse_event
from starlette.concurrency import run_in_threadpool

from contract.queue.interface import MAX_EVENTS, Queue, event_order
from contract.wire.job import TERMINAL_STATES, Forecast, JobRecord, JobView
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
    data: str
    is_last: bool = False


class Channel:
    """The last changes of one job or feed. count: how many there have been in total; changed: set at the next one."""

    def __init__(self, watched_id: str, most_entries: int = MAX_EVENTS) -> None:
        self.watched_id = watched_id
        self.listeners = 0
        self.count = 0
        self.is_over = False
        self.changed = asyncio.Event()
        self._entries: deque[Entry] = deque(maxlen=most_entries)

    @property
    def newest(self) -> Entry | None:
        """The last entry."""
        return self._entries[-1] if self._entries else None

    def add(self, entry: Entry) -> None:
        """Send an entry to the listeners."""
        self._entries.append(entry)
        self.count += 1
        self.wake()

    def end(self) -> None:
        """Mark the channel as ended."""
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


class Channels(ABC):
    """The channels that have listeners, with their pollers."""

    event: ClassVar[str]
    """The type of their events."""
    most_entries: ClassVar[int] = MAX_EVENTS
    """Entries that a channel stores for listeners that read slowly or come late."""

    def __init__(self, queue: Queue) -> None:
        self._queue = queue
        self._channels: dict[str, Channel] = {}
        self._pollers: dict[str, asyncio.Task[None]] = {}
        self._is_ending = False

    def end(self) -> None:
        """End all streams within a poll's period. May be called from a signal handler."""
        self._is_ending = True

    async def stream(self, watched_id: str, after: EventOrder = NOTHING_SEEN) -> AsyncIterator[bytes]:
        """The events after `after` and all later ones until the end, encoded for text/event-stream."""
        ends_at_s = time.monotonic() + STREAM_S
        with self._listening(watched_id) as channel:
            yield format_sse_event(retry=RETRY_MS)
            while not (channel.count or channel.is_over):
                await channel.changed.wait()
            seen = channel.seen_at(after)
            while True:
                changed = channel.changed
                for entry in channel.since(seen):
                    yield format_sse_event(event=self.event, id=entry.number, data_str=entry.data)
                seen = channel.count
                newest = channel.newest
                has_ended = newest is not None and newest.is_last
                if channel.is_over or has_ended or time.monotonic() > ends_at_s:
                    return
                try:
                    async with asyncio.timeout(HEARTBEAT_S):
                        await changed.wait()
                except TimeoutError:
                    yield format_sse_event(comment="still here")

    @contextlib.contextmanager
    def _listening(self, watched_id: str) -> Iterator[Channel]:
        channel = self._channels.get(watched_id)
        if channel is None:
            channel = self._channels[watched_id] = Channel(watched_id, self.most_entries)
            self._pollers[watched_id] = asyncio.create_task(self._poll_until_over(channel))
        channel.listeners += 1
        try:
            yield channel
        finally:
            channel.listeners -= 1
            if channel.listeners == 0:
                self._pollers.pop(watched_id).cancel()
                del self._channels[watched_id]

    async def _poll_until_over(self, channel: Channel) -> None:
        poll = self._poller(channel)
        while not (channel.is_over or self._is_ending):
            with contextlib.suppress(UnavailableError):  # the listeners get the changes when the queue is back
                await poll()
            await asyncio.sleep(POLL_PERIOD_S)
        channel.end()

    @abstractmethod
    def _poller(self, channel: Channel) -> Callable[[], Awaitable[None]]:
        """A function that adds the news to the channel, called every POLL_PERIOD_S; it may raise UnavailableError."""


class JobChannels(Channels):
    """The changes of jobs, from the queue's own stream of them."""

    event = "job"

    def _poller(self, channel: Channel) -> Callable[[], Awaitable[None]]:
        after, looked_at_s, forecast = "0", 0.0, None

        async def poll() -> None:
            nonlocal after, looked_at_s, forecast
            for event in await run_in_threadpool(self._queue.events, channel.watched_id, after):
                channel.add(_entry_of(event.record, event.number))
                after, forecast = event.number, None
            if time.monotonic() >= looked_at_s + LOOK_PERIOD_S:
                forecast = await self._look(channel, forecast)
                looked_at_s = time.monotonic()

        return poll

    async def _look(self, channel: Channel, sent: Forecast | None) -> Forecast | None:
        """Send a changed position in the queue, and a job without events. Returns the forecast that was sent last."""
        record = await run_in_threadpool(self._queue.get, channel.watched_id)
        if record is None:
            channel.end()
            return None
        if record.state in TERMINAL_STATES:
            if channel.newest is None:  # the job was restored after the queue had lost it
                channel.add(_entry_of(record))
            return None
        forecast = await run_in_threadpool(self._queue.forecast, channel.watched_id)
        if sent is None or forecast.position != sent.position:
            channel.add(_entry_of(record, forecast=forecast))
        return forecast


def _entry_of(record: JobRecord, number: str | None = None, forecast: Forecast | None = None) -> Entry:
    data = JobView.of(record, forecast).model_dump_json()
    return Entry(number, data, is_last=record.state in TERMINAL_STATES)
