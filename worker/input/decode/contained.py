"""Runs the decoding process and watches it. The caller always gets a result or a typed error."""

from __future__ import annotations

import errno
import json
import logging
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from contract.wire.errors import Cancelled, InputError, LimitError, UnavailableError
from worker.input.decode.guard import Allowance

MAX_SILENCE_S = 10.0  # without another picture; the largest frame allowed takes well under a second
MAX_TOTAL_S = 1800.0  # the largest clip allowed takes minutes
MAX_ANSWER_BYTES = 4 << 20  # a line of the answer; it grows with warnings, not with frames
POLL_S = 0.1  # a stop is noticed within this time
MAX_EXIT_S = 5.0  # between answer and exit; a process that lives on could change the arrays that the worker maps

PROGRAM = ("-m", "worker.input.decode.child")
NONSENSE = "the decoder talks nonsense"
MALFORMED = (ValueError, KeyError, TypeError, OverflowError, RecursionError)  # what a false answer may raise
REMEDY = "Export it again as H.264 in mp4, or give its frames as PNG in a zip."
_PACKAGES = Path(__file__).resolve().parents[3]  # the folder that holds `worker` and `contract`
_KEPT_VARIABLES = ("LD_LIBRARY_PATH", "SYSTEMROOT")  # some installations find no libraries without them

logger = logging.getLogger("intrasplat.worker")

OnReport = Callable[[float], None]


@dataclass(frozen=True)
class Patience:
    """Limits of the process in seconds: without another picture, in total, and from its answer to its exit."""

    max_silence_s: float = MAX_SILENCE_S
    max_total_s: float = MAX_TOTAL_S
    max_exit_s: float = MAX_EXIT_S


@contextmanager
def private_folder() -> Iterator[Path]:
    """A new folder that only this user may enter; removed with all that is in it."""
    folder = Path(tempfile.mkdtemp(prefix="intrasplat-")).resolve()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def run_contained(
    request: dict[str, Any],
    allowance: Allowance,
    folder: Path,
    on_report: OnReport = lambda share: None,
    should_stop: Callable[[], bool] = lambda: False,
    program: Sequence[str] = PROGRAM,
    patience: Patience = Patience(),
) -> dict[str, Any]:
    """The result of the decoding process, which writes its arrays into `folder`.

    on_report gets the share done. should_stop is called at least every POLL_S.

    Raises:
        InputError, LimitError: as the process raised them; or it crashed, hung, or exceeded its allowance.
        Cancelled: should_stop said so.
        UnavailableError: the disk is full.
    """
    process = subprocess.Popen(
        [sys.executable, "-P", *program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=folder,
        env=_environment(folder),
        umask=0o077,
        start_new_session=True,  # Ctrl-C is for the parent to answer
    )
    assert process.stdin is not None
    watch = _Watch(process, on_report, should_stop, patience)
    try:
        with process.stdin as stdin:
            stdin.write(json.dumps(request | {"allowance": asdict(allowance), "parent": os.getpid()}).encode() + b"\n")
        answer = watch.answer()
    except BrokenPipeError:
        answer = None
    finally:
        _end(process, patience.max_exit_s if watch.answered else 0.0)
        if process.stdout is not None:
            process.stdout.close()
    try:
        return _result(answer, process.returncode, watch.field, allowance)
    except MALFORMED:
        raise _undecodable(watch.field, NONSENSE) from None


def _end(process: subprocess.Popen[bytes], max_exit_s: float) -> None:
    """Wait max_exit_s for the process to exit, then kill it."""
    try:
        process.wait(max_exit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class _Watch:
    """Reads a process's lines. Raises if it is silent, slow or malformed, or if the caller wants to stop."""

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        on_report: OnReport,
        should_stop: Callable[[], bool],
        patience: Patience,
    ) -> None:
        self._process, self._on_report, self._should_stop = process, on_report, should_stop
        self._patience = patience
        self._pictures = -1
        self.field = "clip"
        self.answered = False

    def answer(self) -> dict[str, Any] | None:
        """The last line; None if the process exited without one."""
        end_s = time.monotonic() + self._patience.max_total_s
        self._advanced_s = time.monotonic()
        for line in self._lines():
            if line is None:
                self._check(end_s)
                continue
            try:
                told = json.loads(line)
                if "result" in told or "error" in told:
                    self.answered = True
                    return dict(told)
                self._note(told)
            except MALFORMED:
                raise _undecodable(self.field, NONSENSE) from None
            self._check(end_s)
        return None

    def _note(self, told: dict[str, Any]) -> None:
        self.field = "calibration" if told.get("field") == "calibration" else "clip"
        if int(told["pictures"]) > self._pictures:
            self._pictures, self._advanced_s = int(told["pictures"]), time.monotonic()
        self._on_report(min(1.0, max(0.0, float(told["share"]))))

    def _check(self, end_s: float) -> None:
        if self._should_stop():
            raise Cancelled("Stopped during stage 'decode'.")
        now_s = time.monotonic()
        if now_s - self._advanced_s > self._patience.max_silence_s:
            raise _undecodable(self.field, f"the decoder made no progress for {self._patience.max_silence_s:g} s")
        if now_s > end_s:
            raise _undecodable(self.field, f"the decoder took more than {self._patience.max_total_s:g} s")

    def _lines(self) -> Iterator[bytes | None]:
        """Whole lines as they arrive; None after POLL_S without a whole line."""
        assert self._process.stdout is not None
        descriptor = self._process.stdout.fileno()
        poll = select.poll()
        poll.register(descriptor, select.POLLIN | select.POLLHUP)
        rest = b""
        while True:
            if not poll.poll(POLL_S * 1000):
                yield None
                continue
            piece = os.read(descriptor, 1 << 16)
            if not piece:
                return
            *lines, rest = (rest + piece).split(b"\n")
            yield from lines
            if not lines:
                yield None
            if len(rest) > MAX_ANSWER_BYTES:
                raise _undecodable(self.field, NONSENSE)


def _environment(folder: Path) -> dict[str, str]:
    """The process's environment: of the parent's, only what libraries need to be found."""
    kept = {name: os.environ[name] for name in _KEPT_VARIABLES if name in os.environ}
    return kept | {
        "PYTHONPATH": str(_PACKAGES),
        "PYTHONDONTWRITEBYTECODE": "1",
        "LANG": "C.UTF-8",
        "TMPDIR": str(folder),
        "MALLOC_ARENA_MAX": "2",  # each takes address space, which is limited
        "OPENBLAS_NUM_THREADS": "1",
    }


def _result(answer: dict[str, Any] | None, status: int, field: str, allowance: Allowance) -> dict[str, Any]:
    if answer is not None and "result" in answer:
        return dict(answer["result"])
    error = answer["error"] if answer is not None else {"kind": "ended"}
    if error["kind"] in ("input", "limit"):
        kind = LimitError if error["kind"] == "limit" else InputError
        raise kind(str(error["field"]), str(error["problem"]), str(error["remedy"]))
    if error["kind"] == "memory":
        raise _undecodable(field, f"the decoder needed more than {allowance.memory_bytes / 2**30:.1f} GiB of memory")
    if error["kind"] == "fault":
        return _fault(error, field, allowance)
    if status == -signal.SIGXCPU:
        raise _undecodable(field, f"the decoder took more than {allowance.cpu_s} s of computing")
    name = signal.Signals(-status).name if status < 0 else f"status {status}"
    raise _undecodable(field, f"the decoder crashed ({name})")


def _fault(error: dict[str, Any], field: str, allowance: Allowance) -> dict[str, Any]:
    """Raise for an unexpected exception: an InputError for the caller, its place for the log."""
    if error["errno"] == errno.ENOSPC:
        problem = "The disk is full: the clip's frames found no room."
        raise UnavailableError(problem, "Make room where the data directory lies.")
    if error["errno"] == errno.EFBIG:
        raise _undecodable(field, f"its frames take more than {allowance.file_bytes} bytes")
    logger.error("a fault while a clip was decoded: %s\n%s", error["type"], error["where"])
    raise _undecodable(field, f"the decoder failed ({error['type']})")


def _undecodable(field: str, reason: str) -> InputError:
    return InputError(field, f"it cannot be decoded: {reason}.", REMEDY)
