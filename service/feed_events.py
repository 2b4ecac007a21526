"""Server-sent events of live feeds: a change of state at once, and the numbers once a second."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from typing import ClassVar

from starlette.concurrency import run_in_threadpool

from contract.wire.feeds import FeedView
from service.events import Channel, Channels, Entry

NUMBERS_PERIOD_S = 0.9
"""How often the numbers are sent at most while the state stays."""


class FeedChannels(Channels):
    """What the queue says of feeds. Whoever reads slowly gets the newest view alone."""

    event: ClassVar[str] = "feed"
    most_entries: ClassVar[int] = 1

    def _poller(self, channel: Channel) -> Callable[[], Awaitable[None]]:
        sent: tuple[object, ...] = ()
        sent_s = 0.0

        async def poll() -> None:
            nonlocal sent, sent_s
            record = await run_in_threadpool(self._queue.feed, channel.watched_id)
            if record is None:
                channel.end()
                return
            view, now_s = FeedView.of(record, time.time()), time.monotonic()
            state = (view.state, view.reason, view.recording, view.wish)
            if state != sent or now_s >= sent_s + NUMBERS_PERIOD_S:
                channel.add(Entry(None, view.model_dump_json()))
                sent, sent_s = state, now_s

        return poll
