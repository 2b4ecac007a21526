"""Answer requests that wait for a disk or a sender, beside renders: each kind in a thread of its own, in order."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from contract.wire.rendering import CutRequest, PushRequest
from intrasplat.errors import SceneError, UnavailableError
from worker.reply import Reply

MAX_WAITING = 32
"""Most requests of a kind that wait. A push has at most MAX_PUSH_BYTES."""

Answer = Callable[[Any, bytes], Reply]


@dataclass(frozen=True)
class Done:
    """An answered request. seconds: from its arrival."""

    caller: bytes
    request_id: bytes
    outcome: Reply | Exception
    seconds: float


@dataclass(frozen=True)
class _Waiting:
    caller: bytes
    request_id: bytes
    request: CutRequest | PushRequest
    content: bytes
    arrived_s: float


class Aside:
    """The threads. One thread gives requests and takes the answers.

    descriptor: readable when there may be answers
    """

    def __init__(self, answers: Mapping[type[CutRequest | PushRequest], Answer]) -> None:
        """answers: for each kind, called with the request and the third part of its message."""
        self._ready: queue.SimpleQueue[Done] = queue.SimpleQueue()
        self.descriptor, self._wake = os.pipe()
        for end in (self.descriptor, self._wake):
            os.set_blocking(end, False)
        self._waking, self._is_closed = threading.Lock(), False
        self._queues: dict[type, queue.SimpleQueue[_Waiting | None]] = {}
        for kind, answer in answers.items():
            self._queues[kind] = queue.SimpleQueue()
            threading.Thread(target=self._run, args=(self._queues[kind], answer), name="aside", daemon=True).start()

    def take_in(self, caller: bytes, request_id: bytes, request: CutRequest | PushRequest, content: bytes) -> None:
        """Queue a request.

        Raises:
            SceneError: nothing here answers this kind.
            UnavailableError: too many wait.
        """
        waiting = self._queues.get(type(request))
        if waiting is None:
            raise SceneError("This process does not answer such requests.")
        if waiting.qsize() >= MAX_WAITING:
            raise UnavailableError(
                f"{MAX_WAITING} requests wait already.", "Wait for the answers before you send more."
            )
        waiting.put(_Waiting(caller, request_id, request, content, time.monotonic()))

    def ready(self) -> Iterator[Done]:
        """What was answered since the last call."""
        with contextlib.suppress(BlockingIOError):
            while os.read(self.descriptor, 4096):
                pass
        with contextlib.suppress(queue.Empty):
            while True:
                yield self._ready.get_nowait()

    def close(self) -> None:
        """Answer nothing more; an answer in progress is not waited for."""
        for each in self._queues.values():
            each.put(None)
        with self._waking:
            if not self._is_closed:
                self._is_closed = True
                os.close(self.descriptor)
                os.close(self._wake)

    def _run(self, waiting: queue.SimpleQueue[_Waiting | None], answer: Answer) -> None:
        while (next_one := waiting.get()) is not None:
            outcome: Reply | Exception
            try:
                outcome = answer(next_one.request, next_one.content)
            except Exception as error:  # one request must not end the thread for all
                outcome = error
            seconds = time.monotonic() - next_one.arrived_s
            self._ready.put(Done(next_one.caller, next_one.request_id, outcome, seconds))
            with self._waking, contextlib.suppress(BlockingIOError):
                if not self._is_closed:
                    os.write(self._wake, b"\0")
