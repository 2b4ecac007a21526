"""Calls to the queue with a short timeout; the queue's client itself retries for seconds.

While one call has no answer, further calls fail at once: each would wait in vain and occupy a thread.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from contract.queue.redis_client import QUEUE_REMEDY
from intrasplat.errors import UnavailableError

THREADS = 8
"""Maximum calls at a time."""

Answer = TypeVar("Answer")


class Questions:
    """Calls the queue in its own threads. Thread-safe."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="questions")
        self._unanswered: Future[Any] | None = None

    def ask(self, question: Callable[[], Answer], patience_s: float) -> Answer:
        """The queue's answer.

        Raises:
            UnavailableError: this answer, or one to an earlier call, is late; or the queue is unreachable.
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
        """Make no more calls."""
        self._pool.shutdown(wait=False, cancel_futures=True)
