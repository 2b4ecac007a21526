"""New moments of live feeds for the viewers of /stream.

A worker is asked for "a picture, if there is a newer moment" at most POLLS_PER_S times a second for each feed, by one
viewer at a time. What one viewer learns, the others of the feed know at once, and then ask for their own pictures.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from service.connection import Answer

POLLS_PER_S = 20.0

Ask = Callable[[float], Awaitable[Answer]]
"""Asks the worker for a picture of a moment that is newer than this second of the source."""


@dataclass(eq=False)
class _Followed:
    """A feed that has viewers. newest_s: its newest moment that any of them knows, in seconds of the source."""

    viewers: int = 0
    newest_s: float = -math.inf
    next_poll_s: float = 0.0
    polling: asyncio.Lock = field(default_factory=asyncio.Lock)


class FollowedFeeds:
    """The feeds whose viewers wait for new moments. Only the event loop uses it."""

    def __init__(self) -> None:
        self._feeds: dict[str, _Followed] = {}

    async def newer(self, feed_id: str, after_s: float, ask: Ask) -> Answer:
        """The first answer that shows a moment after `after_s`, or that is an error."""
        with self._followed(feed_id) as feed:
            while True:
                if feed.newest_s <= after_s:
                    answer = await self._poll(feed, after_s, ask)
                else:
                    answer = await ask(after_s)
                if answer is None:
                    continue
                if answer.head.error is not None:
                    return answer
                shown = answer.head.feed
                if shown is None:
                    return answer
                # A worker that began anew counts from where it is: what was known before does not matter.
                feed.newest_s = shown.source_s
                if answer.body:
                    return answer

    async def _poll(self, feed: _Followed, after_s: float, ask: Ask) -> Answer | None:
        """The worker's answer; None: another viewer has seen a newer moment meanwhile."""
        async with feed.polling:
            if feed.newest_s > after_s:
                return None
            await asyncio.sleep(feed.next_poll_s - time.monotonic())
            feed.next_poll_s = time.monotonic() + 1 / POLLS_PER_S
            return await ask(after_s)

    @contextmanager
    def _followed(self, feed_id: str) -> Iterator[_Followed]:
        feed = self._feeds.setdefault(feed_id, _Followed())
        feed.viewers += 1
        try:
            yield feed
        finally:
            feed.viewers -= 1
            if feed.viewers == 0:
                del self._feeds[feed_id]
