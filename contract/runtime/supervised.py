"""`Supervised`: one child process that this process starts, watches, restarts and stops."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from intrasplat.commands.exits import LAST_WORDS_VARIABLE, ExitCode, take_last_words
from intrasplat.errors import UnavailableError
from intrasplat.machine.processes import die_with_parent

FIRST_PAUSE_S = 0.5
MAX_PAUSE_S = 30.0
"""The longest pause before a process that was never healthy is started again; the pause doubles each time."""


@dataclass(frozen=True)
class ProcessEnd:
    """How a child ended. pause_s: seconds until the next one starts; 0 when it has started already."""

    status: int
    cause: str
    """The status in words that follow the child's name, such as "was killed by SIGTERM"."""
    pause_s: float


class Supervised:
    """A child process that is started again whenever it ends.

    A healthy process is replaced at once, any other after a pause that doubles up to MAX_PAUSE_S. The child has a
    session of its own: Ctrl-C reaches this process alone, which then ends the child in order.

    Args:
        name: the child's name in messages.
        command: the program and its arguments.
        environment: the child's environment; None: that of this process.
        last_words: the file to which the child writes the UnavailableError that ended it
            (intrasplat/commands/exits.py); None: only its exit status counts.
        log: the file that receives stdout and stderr; None: the child uses those of this process.
        pipes: connect stdin and stdout to this process. The child is asked to end by closing its stdin, not by SIGTERM.
        dies_with_parent: kill the child when the thread that started it ends (Linux only).
        grace_s: how long the child may take to end before it is killed.
        healthy_after_s: a child that has run for this long is healthy; mark_healthy() says so earlier.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        *,
        last_words: Path | None = None,
        log: Path | None = None,
        pipes: bool = False,
        dies_with_parent: bool = True,
        grace_s: float = 15.0,
        healthy_after_s: float = math.inf,
    ) -> None:
        self.name = name
        self._command = list(command)
        self._environment = dict(os.environ if environment is None else environment)
        self._last_words = last_words
        if last_words is not None:
            self._environment[LAST_WORDS_VARIABLE] = str(last_words)
        self._log = log
        self._pipes = pipes
        self._dies_with_parent = dies_with_parent
        self._grace_s = grace_s
        self._healthy_after_s = healthy_after_s
        self._process: subprocess.Popen[bytes] | None = None
        self._healthy = False
        self._was_healthy = False
        self._killed = False
        self._pause_s = FIRST_PAUSE_S
        self._started_s = 0.0
        self._start_at_s = 0.0

    @property
    def process(self) -> subprocess.Popen[bytes] | None:
        """The process that watch() started last, with its pipes; None before, during a pause and after stop()."""
        return self._process

    @property
    def process_id(self) -> int | None:
        """The id of the process; None if it does not run."""
        return self._process.pid if self._process else None

    @property
    def age_s(self) -> float:
        """Seconds since the process was started."""
        return time.monotonic() - self._started_s

    def watch(self) -> ProcessEnd | None:
        """Start the child unless it runs or a pause lasts. Returns how the last one ended, once. Call it often.

        Raises:
            UnavailableError: the child ended because it lacks something, and no child was ever healthy. It is the error
                that the child wrote. It is not raised for what may come back by itself (may_return).
        """
        ended = self._end_of_process()
        if self._process is None and time.monotonic() >= self._start_at_s:
            self._start()
        return ended

    def mark_healthy(self) -> None:
        """Mark the running process as healthy: if it ends, the next one starts at once."""
        self._healthy = self._was_healthy = True
        self._pause_s = FIRST_PAUSE_S

    def ask_to_end(self) -> None:
        """Close the child's stdin if that is a pipe, else send SIGTERM; do not wait."""
        if self._process is None:
            return
        if self._process.stdin is None:
            self._process.terminate()
        else:
            _close(self._process.stdin)

    def kill(self) -> None:
        """Kill the child and wait until it is gone; watch() then returns how it ended."""
        if self._process is not None:
            self._killed = True
            self._process.kill()
            self._process.wait()

    def stop(self) -> None:
        """Ask the child to end, kill it after grace_s, and wait until it is gone."""
        if self._process is None:
            return
        self.ask_to_end()
        try:
            self._process.wait(self._grace_s)
        except subprocess.TimeoutExpired:
            self.kill()
        self._process = None
        self._clear_last_words()

    def _start(self) -> None:
        self._clear_last_words()  # of a child whose parent was killed before it could read them
        with contextlib.ExitStack() as files:
            log = files.enter_context(self._log.open("ab")) if self._log else None
            self._process = subprocess.Popen(
                self._command,
                env=self._environment,
                stdin=subprocess.PIPE if self._pipes else subprocess.DEVNULL,
                stdout=subprocess.PIPE if self._pipes else log,
                stderr=log,
                start_new_session=True,
                preexec_fn=die_with_parent if self._dies_with_parent else None,
            )
        self._started_s = time.monotonic()
        self._healthy = self._killed = False

    def _end_of_process(self) -> ProcessEnd | None:
        """How the process ended, None if it has not. Sets when the next one starts."""
        status = self._process.poll() if self._process else None
        if self._process is None or status is None:
            return None
        if self._process.stdin is not None:
            _close(self._process.stdin)
        self._process = None
        if self.age_s > self._healthy_after_s:
            self.mark_healthy()
        cause = "was killed by its supervisor" if self._killed else cause_of(status)
        pause_s = 0.0 if self._healthy else self._pause_s
        if not self._healthy:
            self._pause_s = min(MAX_PAUSE_S, 2 * self._pause_s)
        self._start_at_s = time.monotonic() + pause_s
        if self._last_words is not None and status == ExitCode.UNAVAILABLE:
            self._raise_if_it_cannot_work(take_last_words(self._last_words))
        return ProcessEnd(status, cause, pause_s)

    def _raise_if_it_cannot_work(self, lack: UnavailableError | None) -> None:
        """Raise the child's error, unless what it lacks may come back. lack: None if the child wrote no error."""
        if lack is None:
            problem = (
                f"The {self.name} ended with status {ExitCode.UNAVAILABLE:d}: something that it needs is not there."
            )
            lack = UnavailableError(problem, "Its messages are above; try `intrasplat doctor`.")
        if not self._was_healthy and not lack.may_return:
            raise lack

    def _clear_last_words(self) -> None:
        if self._last_words is not None:
            self._last_words.unlink(missing_ok=True)


def _close(pipe: IO[bytes]) -> None:
    with contextlib.suppress(BrokenPipeError):
        pipe.close()


def cause_of(status: int) -> str:
    """Why a process ended with this status, in words that follow its name."""
    number = -status if status < 0 else status - 128  # a shell in between adds 128
    if number == signal.SIGKILL:
        return "was killed by SIGKILL (was there not enough memory?)"
    if number in set(signal.Signals):
        return f"was killed by {signal.Signals(number).name}"
    return f"ended with status {status}"
