"""Ends this process on a signal, or together with its parent; niceness of other processes, and how they starve."""

from __future__ import annotations

import contextlib
import ctypes
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_ENDING = (signal.SIGINT, signal.SIGTERM)
_PR_SET_PDEATHSIG = 1
STARVED_FACTOR = 10.0
"""A time limit for a process becomes at most so many times as long while its threads wait for a core: they may wait for
one another, so even a process that never ends may seem to starve."""
STARVED_FROM_S = 1.0
"""Silence, or a tenth of its limit if that is less, from which on waiting for a core is measured: that takes 1 ms."""


def shutdown_event() -> threading.Event:
    """An event that the next SIGINT or SIGTERM sets. Call it from the main thread."""
    end = threading.Event()
    signals: queue.SimpleQueue[None] = queue.SimpleQueue()

    def wait() -> None:
        signals.get()
        end.set()

    # A handler may interrupt the main thread while that thread has the lock that end.set() needs: a deadlock.
    # SimpleQueue.put() is safe in a handler.
    threading.Thread(target=wait, name="signals", daemon=True).start()
    for number in _ENDING:
        signal.signal(number, lambda *_: signals.put(None))
    return end


@contextmanager
def heeding_signals() -> Iterator[threading.Event]:
    """Context manager around shutdown_event(); afterwards the previous signal handlers are restored."""
    before = {number: signal.getsignal(number) for number in _ENDING}
    try:
        yield shutdown_event()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def die_with_parent() -> None:
    """From now on the kernel kills this process when the thread that started it ends, however it ends (Linux only)."""
    if not sys.platform.startswith("linux"):
        return
    parent = os.getppid()
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # the parent ended before prctl
        os.kill(os.getpid(), signal.SIGKILL)


def starved_s(process_id: int) -> float:
    """Seconds for which threads of a process and of its children waited for a core, summed over the threads; 0 where
    the system does not say. It falls when a thread ends."""
    nanoseconds, waiting = 0, [process_id]
    while waiting:
        for thread in _threads(waiting.pop()):
            with contextlib.suppress(OSError, ValueError, IndexError):  # it has ended, or the kernel counts nothing
                nanoseconds += int((thread / "schedstat").read_text().split()[1])
                waiting += map(int, (thread / "children").read_text().split())
    return nanoseconds / 1e9


class Silence:
    """Judges the silence of a process by a limit, which grows by the time for which the process waits for a core.

    starved_s: as the function of that name, of this process.
    """

    def __init__(self, starved_s: Callable[[], float]) -> None:
        self._starved_s = starved_s
        self._before_s: float | None = None

    def end(self) -> None:
        """The process was heard."""
        self._before_s = None

    def is_too_long(self, silence_s: float, limit_s: float) -> bool:
        """Whether the silence exceeds its limit. Call it often, with the seconds since the process was heard."""
        if self._before_s is None and silence_s > min(STARVED_FROM_S, limit_s / 10):
            self._before_s = self._starved_s()
        if silence_s <= limit_s or self._before_s is None:
            return silence_s > limit_s
        return silence_s > min(limit_s + max(0.0, self._starved_s() - self._before_s), STARVED_FACTOR * limit_s)


def _threads(process_id: int) -> list[Path]:
    """The folders of a process's threads; none if it has ended, or where the system has none."""
    with contextlib.suppress(OSError):
        return list(Path(f"/proc/{process_id}/task").iterdir())
    return []


def set_niceness(process_id: int, niceness: int) -> None:
    """Let a process, all its threads and later children run at a niceness in [0, 19], as far as the system allows:
    without privileges none becomes less nice again."""
    for thread in [int(each.name) for each in _threads(process_id)] or [process_id]:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, niceness)
    # Linux may compare whole sessions. A supervised process has one of its own.
    with contextlib.suppress(OSError):
        Path(f"/proc/{process_id}/autogroup").write_text(str(niceness))
