"""The device child as its supervisor holds it: a process that is started, spoken to, watched and, if need be, killed.

A kernel may crash, hang or eat all memory: whatever becomes of the child, the supervisor stands beside it and sees it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from contract.wire.errors import UnavailableError
from worker.daemon.orders import (
    Advanced,
    DeviceOrder,
    Failed,
    Finished,
    Holding,
    Ready,
    Stopped,
    Unable,
    line_of,
    read_report,
)

START_LIMIT_S = 240.0
"""To import torch and compile all kernels, on a slow machine whose cache is empty."""

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0
"""Before a child that died before it was ready is started again; the pauses double."""

LOOK_PERIOD_S = 0.1
"""How soon a supervisor that waits for its child sees what has become of it."""

LAST_WORDS_S = 0.5
"""How long what a dead child has written is waited for, should a process of its own hold its pipe open."""

END_LIMIT_S = 2.0
"""A child without a job ends at once when its orders end."""

logger = logging.getLogger("intrasplat.worker")


@dataclass(frozen=True)
class Ended:
    """The child is gone; cause is for the log."""

    cause: str


class DeviceChild:
    """One process. Start it from a thread that lives as long as it: on Linux it dies with that thread."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self.ready: Ready | None = None
        self.unable: Unable | None = None
        self.scenes: tuple[str, ...] = ()
        self.ended: Ended | None = None
        self._was_killed = False
        self._reports: queue.SimpleQueue[Advanced | Finished | Stopped | Failed | Ended] = queue.SimpleQueue()
        # A session of its own: Ctrl-C reaches the supervisor alone, which ends the child in order.
        self._process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        self._reader = threading.Thread(target=self._read, name="reports", daemon=True)
        self._reader.start()
        self._waiter = threading.Thread(target=self._wait, name="child", daemon=True)
        self._waiter.start()

    @property
    def process_id(self) -> int:
        """Of the process."""
        return self._process.pid

    def send(self, order: DeviceOrder) -> None:
        """Give an order; that a dead child hears none is reported by next_report."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError, ValueError):
            self._process.stdin.write(line_of(order))
            self._process.stdin.flush()

    def next_report(self, timeout_s: float) -> Advanced | Finished | Stopped | Failed | Ended | None:
        """The next report on the job, or the news of the child's end; None after timeout_s."""
        try:
            return self._reports.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def kill(self) -> None:
        """End it without asking, and wait until it is gone."""
        self._was_killed = True
        self._process.kill()
        self._waiter.join()

    def end(self) -> None:
        """Let a child without a job go."""
        self._close_orders()
        self._waiter.join(END_LIMIT_S)
        if self.ended is None:
            self.kill()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                report = read_report(line)
                if report is None:
                    logger.warning("the device process printed a line of %d bytes that is no report", len(line))
                elif isinstance(report, Ready):
                    self.ready = report
                elif isinstance(report, Unable):
                    self.unable = report
                elif isinstance(report, Holding):
                    self.scenes = report.scenes
                else:
                    self._reports.put(report)

    def _wait(self) -> None:
        status = self._process.wait()
        self._reader.join(LAST_WORDS_S)
        self._close_orders()
        self.ended = Ended("was killed by its supervisor" if self._was_killed else cause_of(status))
        self._reports.put(self.ended)

    def _close_orders(self) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()


def cause_of(status: int) -> str:
    """Why a process ended with this status, in words."""
    number = -status if status < 0 else status - 128  # a shell in between adds 128
    if number == signal.SIGKILL:
        return "was killed by SIGKILL (was there not enough memory?)"
    if number in set(signal.Signals):
        return f"was killed by {signal.Signals(number).name}"
    return f"ended with status {status}"


class Keeper:
    """Sees to it that there is a child: a dead one is followed by a new one."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        self._command = list(command)
        self._environment = dict(os.environ if environment is None else environment)
        self._child: DeviceChild | None = None
        self._started_s = 0.0
        self._pause_s = FIRST_PAUSE_S
        self._start_at_s = 0.0

    @property
    def live(self) -> DeviceChild | None:
        """The child, if it is ready and has not ended; for any thread."""
        child = self._child
        return child if child is not None and child.ready is not None and child.ended is None else None

    def child(self, end: threading.Event) -> DeviceChild | None:
        """The child as soon as it is ready; None if `end` was set first.

        Raises:
            UnavailableError: it says that it cannot work here.
        """
        while not end.is_set():
            child = self._child
            if child is None:
                if time.monotonic() >= self._start_at_s:
                    self._child, self._started_s = DeviceChild(self._command, self._environment), time.monotonic()
                else:
                    end.wait(LOOK_PERIOD_S)
                continue
            if child.unable is not None:
                raise UnavailableError(child.unable.problem, child.unable.remedy)
            if child.ended is not None:
                self._bury(child, child.ended)
            elif child.ready is not None:
                self._pause_s = FIRST_PAUSE_S
                return child
            elif time.monotonic() - self._started_s > START_LIMIT_S:
                logger.warning("the device process was not ready after %g s and was killed", START_LIMIT_S)
                child.kill()
            else:
                end.wait(LOOK_PERIOD_S)
        return None

    def stop(self) -> None:
        """End the child for good."""
        if self._child is not None:
            self._child.end()

    def _bury(self, child: DeviceChild, ended: Ended) -> None:
        """Let another take its place: at once, or later if it was never ready."""
        self._child = None
        if child.ready is not None:
            logger.warning("the device process %s; another starts", ended.cause)
            return
        logger.warning("the device process %s before it was ready; another starts in %g s", ended.cause, self._pause_s)
        self._start_at_s = time.monotonic() + self._pause_s
        self._pause_s = min(LONGEST_PAUSE_S, 2 * self._pause_s)
