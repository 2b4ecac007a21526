"""The pipe to the reading process, into which a caller pushes a stream."""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Callable

from intrasplat.errors import UnavailableError

POLL_S = 0.1


class PushPipe:
    """One caller's way to the process that reads. A push begins with its first bytes.

    is_wanted  whether somebody pushes and no process reads yet
    """

    def __init__(self, changed: threading.Condition, is_deaf: Callable[[], bool]) -> None:
        """changed: notified when is_wanted rises. is_deaf: whether what is pushed is to be discarded."""
        self._changed, self._is_deaf = changed, is_deaf
        self._writing = threading.Lock()
        self._pipe: int | None = None
        self.is_wanted = self._is_broken = False

    def begin(self, pipe: int | None) -> None:
        """A process reads from the other end of `pipe` now."""
        with self._changed:
            self._pipe, self.is_wanted, self._is_broken = pipe, False, False
            self._changed.notify_all()

    def cut_off(self, *, by_sender: bool) -> None:
        """The process has ended; unless the sender's end was the cause, the next write fails."""
        with self._writing:
            self._close(broken=not by_sender)

    def end(self) -> None:
        """The pushed stream has ended."""
        with self._writing:
            self._close(broken=False)

    def write(self, data: bytes, timeout_s: float) -> None:
        """Write all of it. Raises UnavailableError as Source.write."""
        deadline_s = time.monotonic() + timeout_s
        view = memoryview(data)
        while view:
            pipe = self._ready(deadline_s)
            if pipe is None:
                return
            with self._writing:
                if pipe != self._pipe or not select.select([], [pipe], [], POLL_S)[1]:
                    continue
                try:
                    view = view[os.write(pipe, view) :]
                except BlockingIOError:
                    continue
                except BrokenPipeError:
                    self._close(broken=True)

    def _ready(self, deadline_s: float) -> int | None:
        """The pipe; None while what is pushed is discarded."""
        with self._changed:
            while True:
                if self._is_deaf():
                    return None
                if self._is_broken:
                    self._is_broken = False
                    raise _cut_off("The process that reads the push ended.")
                if time.monotonic() > deadline_s:
                    raise _cut_off("The pushed bytes were not taken in time.")
                if self._pipe is not None:
                    return self._pipe
                self.is_wanted = True
                self._changed.notify_all()
                self._changed.wait(POLL_S)

    def _close(self, *, broken: bool) -> None:
        with self._changed:
            pipe, self._pipe, self.is_wanted = self._pipe, None, False
            self._is_broken = broken and pipe is not None
        if pipe is not None:
            os.close(pipe)


def _cut_off(problem: str) -> UnavailableError:
    return UnavailableError(problem, "Begin the push anew.", may_return=True)
