"""Questions to the queue that are answered within a time, or not at all: the queue's client itself tries for seconds.

While one question has no answer, others are not asked: they would wait in vain, and hold a thread each.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from contract.queue.redis_client import QUEUE_REMEDY
from intrasplat.errors import UnavailableError

THREADS = 8
"""Questions at a time."""

Answer = TypeVar("Answer")


class Questions:
    """Asks in threads of its own; for many threads."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="questions")
        self._unanswered: Future[Any] | None = None

    def ask(self, question: Callable[[], Answer], patience_s: float) -> Answer:
        """The queue's answer.

        Raises:
            UnavailableError: it, or one to an earlier question, does not come in time; or the queue is away.
        """
        unanswered = self._unanswered
        if unanswered is None or unanswered.done():
            asked = self._pool.submit(question)
            try:
                return asked.result(patience_s)
            except TimeoutError:
                self._unanswered = asked
        raise UnavailableError("The queue does not answer.", QUEUE_REMEDY, may_return=True)

    def close(self) -> None:
        """Ask nothing more."""
        self._pool.shutdown(wait=False, cancel_futures=True)
