"""Announce an address to the queue while something lasts."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from contract.queue.interface import ANNOUNCE_PERIOD_S, Queue
from contract.wire.rendering import WorkerAddress
from intrasplat.errors import UnavailableError

LOOK_PERIOD_S = 0.1
"""How soon a change of the address is announced."""


@contextlib.contextmanager
def announced(queue: Queue, name: str, address: Callable[[], WorkerAddress | None]) -> Iterator[None]:
    """Announce the worker's address every ANNOUNCE_PERIOD_S and at every change while the context lasts."""
    end = threading.Event()

    def announce() -> None:
        last: WorkerAddress | None = None
        next_s = 0.0
        while not end.wait(LOOK_PERIOD_S):
            now = address()
            if now == last and (now is None or time.monotonic() < next_s):
                continue
            with contextlib.suppress(UnavailableError):
                if now is None:
                    queue.withdraw(name)
                else:
                    queue.announce(now)
                last = now
            next_s = time.monotonic() + ANNOUNCE_PERIOD_S

    thread = threading.Thread(target=announce, name="announce", daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()
        with contextlib.suppress(UnavailableError):
            queue.withdraw(name)
