"""Gives orders to a process on its stdin, in a thread: a process that does not read holds nobody up."""

from __future__ import annotations

import contextlib
import io
import queue
import threading
from typing import IO

from worker.orders import Message, line_of


class OrderWriter:
    """Writes orders in turn until end(); nothing happens when the process has ended. Any thread may call it."""

    def __init__(self, stdin: IO[bytes]) -> None:
        assert isinstance(stdin, io.BufferedWriter)
        self._raw = stdin.raw  # whose close() does not wait for a write that hangs
        self._orders: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        threading.Thread(target=self._write, name="orders", daemon=True).start()

    def send(self, order: Message) -> None:
        """Give an order; do not wait until the process reads it."""
        self._orders.put(order)

    def end(self) -> None:
        """The process reads no more orders."""
        self._orders.put(None)

    def _write(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            while (order := self._orders.get()) is not None:
                left = memoryview(line_of(order))
                while left:
                    left = left[self._raw.write(left) or 0 :]
