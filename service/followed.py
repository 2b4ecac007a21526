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
from typing import TypeAlias, TypeVar

from service.connection import Answer

POLLS_PER_S = 20.0

Shown = TypeVar("Shown")
Ask: TypeAlias = Callable[[float], Awaitable[tuple[Shown, Answer]]]
"""Asks the worker for a picture of a moment that is newer than this second of the source; raises its errors."""


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

    async def newer(self, feed_id: str, after_s: float, ask: Ask[Shown]) -> tuple[Shown, Answer]:
        """The first view of a moment after `after_s`. Raises what `ask` raises."""
        with self._followed(feed_id) as feed:
            while True:
                view = await (self._poll(feed, after_s, ask) if feed.newest_s <= after_s else ask(after_s))
                if view is None:
                    continue
                _, answer = view
                if answer.head.feed is not None:
                    feed.newest_s = answer.head.feed.source_s
                if answer.body or answer.head.feed is None:
                    return view

    async def _poll(self, feed: _Followed, after_s: float, ask: Ask[Shown]) -> tuple[Shown, Answer] | None:
        """What the worker shows; None: another viewer has seen a newer moment meanwhile."""
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
