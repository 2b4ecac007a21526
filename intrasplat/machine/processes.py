"""How this process ends: by a signal, or together with its parent."""

from __future__ import annotations

import ctypes
import os
import queue
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_ENDING = (signal.SIGINT, signal.SIGTERM)
_PR_SET_PDEATHSIG = 1


def told_to_end() -> threading.Event:
    """An event that is set at the first SIGINT or SIGTERM from now on; for the main thread."""
    end = threading.Event()
    signals: queue.SimpleQueue[None] = queue.SimpleQueue()

    def wait() -> None:
        signals.get()
        end.set()

    # A handler interrupts the main thread anywhere, also while that holds the lock that end.set() needs, and would wait
    # for itself. SimpleQueue.put() is safe there.
    threading.Thread(target=wait, name="signals", daemon=True).start()
    for number in _ENDING:
        signal.signal(number, lambda *_: signals.put(None))
    return end


@contextmanager
def heeding_signals() -> Iterator[threading.Event]:
    """told_to_end() as long as the with statement lasts; afterwards signals do what they did before."""
    before = {number: signal.getsignal(number) for number in _ENDING}
    try:
        yield told_to_end()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def die_with_parent() -> None:
    """From now on this process is killed when the thread that started it ends, kill -9 included (Linux only)."""
    if not sys.platform.startswith("linux"):
        return
    parent = os.getppid()
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died just before
        os.kill(os.getpid(), signal.SIGKILL)
