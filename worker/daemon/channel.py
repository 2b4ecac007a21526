"""The child's end of the wire of worker/daemon/orders.py: reports go out, orders come in. Imports no torch."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import sys
import threading
from dataclasses import dataclass, field
from typing import BinaryIO

from pydantic import ValidationError

from worker.daemon.orders import DeviceReport, Run, line_of, read_order

logger = logging.getLogger("intrasplat.worker")


class Channel:
    """Where reports go; for any thread."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()
        self._last: dict[type[DeviceReport], DeviceReport] = {}

    @classmethod
    def instead_of_stdout(cls) -> Channel:
        """Takes stdout for itself: whatever else is printed from now on goes to stderr."""
        sys.stdout.flush()
        own = os.dup(sys.stdout.fileno())  # not inherited by processes that are started from here
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        return cls(os.fdopen(own, "wb"))

    def send(self, message: DeviceReport) -> None:
        """Write one report. A supervisor that is gone ends this process by other means."""
        with self._lock, contextlib.suppress(BrokenPipeError):
            self._stream.write(line_of(message))
            self._stream.flush()

    def send_if_new(self, message: DeviceReport) -> None:
        """Write a report unless it says what the last of its kind said; for one thread."""
        if self._last.get(type(message)) != message:
            self._last[type(message)] = message
            self.send(message)


@dataclass(frozen=True)
class Task:
    """A job that was ordered, and whether its end was since."""

    run: Run
    stop: threading.Event = field(default_factory=threading.Event)


class Orders:
    """Reads orders in a thread of its own; at their end it ends the process, whatever else goes on in it."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._tasks: queue.SimpleQueue[Task] = queue.SimpleQueue()
        threading.Thread(target=self._read, name="orders", daemon=True).start()

    @classmethod
    def from_stdin(cls) -> Orders:
        """Through a file of its own: Python must not wait for this thread's lock on sys.stdin when it ends."""
        return cls(os.fdopen(os.dup(sys.stdin.fileno()), "rb"))

    def next(self, timeout_s: float) -> Task | None:
        """The next job; None after timeout_s."""
        try:
            return self._tasks.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def _read(self) -> None:
        task: Task | None = None
        for line in self._stream:
            try:
                order = read_order(line)
            except ValidationError:  # of another version: a process that heard no further order would only seem to work
                logger.error("an order cannot be read; restart the worker after its program was changed")
                os._exit(1)
            if isinstance(order, Run):
                task = Task(order)
                self._tasks.put(task)
            elif task is not None:
                task.stop.set()
        os._exit(0)  # nothing here is worth keeping: what is durable is on disk already
