"""Run the device process from the supervisor: start it, give it orders, watch it, and kill it if necessary.

A kernel may crash, hang or use all memory. The supervisor survives every end of the device process and notices it.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from contract.runtime.supervised import ProcessEnd, Supervised, cause_of
from contract.wire.job import JobProgress
from intrasplat.machine.hooks import ignore
from intrasplat.machine.processes import starved_s
from worker.hang import HangDetector
from worker.order_writer import OrderWriter
from worker.orders import (
    Advanced,
    CachedScenes,
    DeviceOrder,
    Failed,
    Finished,
    Ready,
    Scored,
    StopJob,
    Stopped,
    read_report,
)

MAX_START_S = 240.0
"""Time to import torch and compile all kernels on a slow machine with an empty cache."""

LOOK_PERIOD_S = 0.1
"""How soon a supervisor that waits for its child notices its end, or acts on a new order of the queue."""

MAX_STOP_S = 5.0
"""How long a child may take, after an order to stop, to save the job's state before it is killed."""

LAST_REPORTS_S = 0.5
"""How long to wait for the last reports of a dead child: a process that it started may keep its pipe open."""

MAX_END_S = 2.0
"""How long a child without a job may take to end after its orders end."""

logger = logging.getLogger("intrasplat.worker")


@dataclass(frozen=True)
class Ended:
    """The child has ended; cause is for the log. was_stopping: it had been ordered to stop."""

    cause: str
    was_stopping: bool = False


JobReport: TypeAlias = Advanced | Finished | Scored | Stopped | Failed


class DeviceChild:
    """One running device process: send() gives orders, next_report() returns reports. `kill` must end the process."""

    def __init__(self, process: subprocess.Popen[bytes], kill: Callable[[], None]) -> None:
        self.process = process
        self.kill = kill
        self.ready: Ready | None = None
        self.scenes: tuple[str, ...] = ()
        self.is_nice = False
        assert process.stdin is not None
        self._orders = OrderWriter(process.stdin)
        self._reports: queue.SimpleQueue[JobReport] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, name="reports", daemon=True)
        self._reader.start()

    @property
    def ended(self) -> Ended | None:
        """How the process ended; None while it runs. Any thread may ask."""
        status = self.process.poll()
        return None if status is None else Ended(cause_of(status))

    def starved_s(self) -> float:
        """As of intrasplat/machine/processes.py."""
        return starved_s(self.process.pid)

    def send(self, order: DeviceOrder) -> None:
        """Give an order; do not wait until the child reads it. If it is dead, next_report() returns its end."""
        self._orders.send(order)

    def next_report(self, timeout_s: float) -> JobReport | Ended | None:
        """The next report on the job; after the last one, the child's end. None if nothing comes within timeout_s."""
        with contextlib.suppress(queue.Empty):
            return self._reports.get(timeout=timeout_s)
        ended = self.ended
        if ended is None:
            return None
        self._reader.join(LAST_REPORTS_S)
        with contextlib.suppress(queue.Empty):
            return self._reports.get_nowait()
        return ended

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                report = read_report(line)
                if report is None:
                    logger.warning("the device process printed a line of %d bytes that is not a report", len(line))
                elif isinstance(report, Ready):
                    self.ready = report
                elif isinstance(report, CachedScenes):
                    self.scenes = report.scenes
                else:
                    self._reports.put(report)
        self._orders.end()


def watch(
    child: DeviceChild, stop: Callable[[], bool], on_progress: Callable[[JobProgress], object] = ignore
) -> Finished | Scored | Stopped | Failed | Ended:
    """The child's report that ends its order; kill the child if it hangs.

    stop: when it returns True, the child is ordered to stop, and killed if it needs more than MAX_STOP_S for that.
    on_progress: receives the child's progress.
    """
    detector, asked_s = HangDetector(starved_s=child.starved_s), None
    while True:
        report = child.next_report(LOOK_PERIOD_S)
        if isinstance(report, Ended):
            return replace(report, was_stopping=asked_s is not None)
        if isinstance(report, Finished | Scored | Stopped | Failed):
            return report
        if isinstance(report, Advanced):
            detector.observe(report.progress)
            on_progress(report.progress)
        if asked_s is None and stop():
            child.send(StopJob())
            asked_s = time.monotonic()
        if asked_s is not None and time.monotonic() - asked_s > MAX_STOP_S:
            child.kill()
            return Ended(f"did not stop within {MAX_STOP_S:g} s and was killed", was_stopping=True)
        if detector.is_hung():
            child.kill()
            return Ended(f"hung in stage {detector.stage!r} and was killed", was_stopping=asked_s is not None)


class ChildKeeper:
    """Keeps one device process running. Use it from a single thread, which must live as long as the process."""

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str] | None = None, last_words: Path | None = None
    ) -> None:
        self._supervised = Supervised(
            "device process",
            command,
            environment,
            last_words=last_words,
            pipes=True,
            dies_with_parent=False,  # the child arranges that itself
            grace_s=MAX_END_S,
        )
        self._child: DeviceChild | None = None

    @property
    def live(self) -> DeviceChild | None:
        """The child, if it is ready and has not ended; any thread may ask."""
        child = self._child
        return child if child is not None and child.ready is not None and child.ended is None else None

    def child(self, end: threading.Event) -> DeviceChild | None:
        """Wait until the child is ready and return it; None if `end` is set first.

        Raises:
            UnavailableError: the child cannot work here; the error is the one that it left as last words.
        """
        while not end.is_set():
            ended = self._supervised.watch()
            if ended is not None:
                _log_end(ended)
            self._child = child = self._running()
            if child is not None and child.ready is not None:
                self._supervised.mark_healthy()
                return child
            if child is not None and self._supervised.age_s > MAX_START_S:
                logger.warning("the device process was not ready after %g s and was killed", MAX_START_S)
                child.kill()
            end.wait(LOOK_PERIOD_S)
        return None

    def stop(self) -> None:
        """End a child without a job, and start no other."""
        self._supervised.stop()

    def _running(self) -> DeviceChild | None:
        """The child of the process that runs now, which may be a new one."""
        process = self._supervised.process
        if process is None:
            return None
        if self._child is not None and self._child.process is process:
            return self._child
        return DeviceChild(process, self._supervised.kill)


def _log_end(ended: ProcessEnd) -> None:
    if ended.pause_s:
        logger.warning("the device process %s before it was ready; another starts in %g s", ended.cause, ended.pause_s)
    else:
        logger.warning("the device process %s; another starts", ended.cause)
