"""The device process's side of the messages of worker/orders.py: it sends reports and reads orders.

This module imports no torch.
"""

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

from contract.runtime import traces
from worker.orders import Message, RunJob, ScoreScene, line_of, read_order

TRACES_PATIENCE_S = 1.0
"""How long the process waits at its end for a trace collector: less than a supervisor waits for the process."""

logger = logging.getLogger("intrasplat.worker")


class Channel:
    """Sends reports; any thread may use it."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()
        self._last: dict[type[Message], Message] = {}

    @classmethod
    def instead_of_stdout(cls) -> Channel:
        """Use stdout for reports; anything else that is printed from now on goes to stderr."""
        sys.stdout.flush()
        own = os.dup(sys.stdout.fileno())  # child processes do not inherit it
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        return cls(os.fdopen(own, "wb"))

    def send(self, message: Message) -> None:
        """Write one report; do nothing if the supervisor has ended."""
        with self._lock, contextlib.suppress(BrokenPipeError):
            self._stream.write(line_of(message))
            self._stream.flush()

    def send_if_new(self, message: Message) -> None:
        """Write a report unless it equals the last of its type; only one thread may call this."""
        if self._last.get(type(message)) != message:
            self._last[type(message)] = message
            self.send(message)


@dataclass(frozen=True)
class Task:
    """An order; `stop` is set when the work on it must stop."""

    order: RunJob | ScoreScene
    stop: threading.Event = field(default_factory=threading.Event)


class Orders:
    """Reads orders in a thread, which ends the whole process when the stream ends."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._tasks: queue.SimpleQueue[Task] = queue.SimpleQueue()
        threading.Thread(target=self._read, name="orders", daemon=True).start()

    @classmethod
    def from_stdin(cls) -> Orders:
        """Orders from stdin, read through a duplicate: at exit Python must not wait for this thread's lock."""
        return cls(os.fdopen(os.dup(sys.stdin.fileno()), "rb"))

    def next(self, timeout_s: float) -> Task | None:
        """The next task; None if none comes within timeout_s."""
        try:
            return self._tasks.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def _read(self) -> None:
        task: Task | None = None
        for line in self._stream:
            try:
                order = read_order(line)
            except ValidationError:  # of another version: a process that understands no orders would only seem to work
                logger.error("an order cannot be read; restart the worker after updating the program")
                os._exit(1)
            if isinstance(order, RunJob | ScoreScene):
                task = Task(order)
                self._tasks.put(task)
            elif task is not None:
                task.stop.set()
        traces.flush(TRACES_PATIENCE_S)
        os._exit(0)  # everything that must be stored is on disk already
