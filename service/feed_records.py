"""Records of live feeds for renders: read from the queue once a second, and known on while the queue is away."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict

from contract.queue.interface import Queue
from contract.wire.feeds import FeedRecord
from intrasplat.errors import UnavailableError
from service.questions import Questions

VALID_S = 1.0
PATIENCE_S = 1.0
"""How long a render waits for the queue's record."""
REMEMBERED = 256


class FeedRecords:
    """The records of feeds. Thread-safe."""

    def __init__(self, queue: Queue, questions: Questions) -> None:
        self._queue = queue
        self._questions = questions
        self._lock = threading.Lock()
        self._known: OrderedDict[str, tuple[FeedRecord, float]] = OrderedDict()

    def is_known(self, feed_id: str) -> bool:
        """Whether this id was a feed's when it was last asked for."""
        return feed_id in self._known

    def record(self, feed_id: str) -> FeedRecord | None:
        """The record, at most VALID_S old unless the queue is away; None if there is no such feed.

        Raises:
            UnavailableError: the queue is unreachable, and the feed was not known before.
        """
        with self._lock:
            known = self._known.get(feed_id)
        if known is not None and time.monotonic() < known[1] + VALID_S:
            return known[0]
        try:
            record = self._questions.ask(lambda: self._queue.feed(feed_id), PATIENCE_S)
        except UnavailableError:
            if known is None:
                raise
            record = known[0]
        with self._lock:
            self._known.pop(feed_id, None)
            if record is not None:
                self._known[feed_id] = record, time.monotonic()
            if len(self._known) > REMEMBERED:
                self._known.popitem(last=False)
        return record

    def forget(self, feed_id: str) -> None:
        """Read the record anew when it is next asked for."""
        with self._lock:
            self._known.pop(feed_id, None)
