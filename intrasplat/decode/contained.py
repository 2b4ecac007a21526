"""Runs and monitors the decoding process. The caller always gets a result or a typed error."""

from __future__ import annotations

import contextlib
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
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from intrasplat.decode.guard import Allowance
from intrasplat.errors import Cancelled, ErrorCode, InputError, LimitError, UnavailableError
from intrasplat.files.disk import Disk
from intrasplat.files.disk_errors import StoreFullError
from intrasplat.machine.processes import Silence, starved_s

MAX_SILENCE_S = 10.0  # without another picture; the largest frame allowed takes well under a second
MAX_TOTAL_S = 1800.0  # the largest clip allowed takes minutes
MAX_ANSWER_BYTES = 4 << 20  # of a line of the answer; it grows with warnings, not with frames
POLL_S = 0.1  # a stop is noticed within this time
MAX_EXIT_S = 5.0  # between answer and exit; a process that lives on could change the arrays that the caller maps
MAX_DEATH_S = 0.5  # between the end of its output and its exit, without an answer
END = b"\n"  # marks the end of the output; no line is empty

PROGRAM = ("-m", "intrasplat.decode.child")
NONSENSE = "the decoder talks nonsense"
MALFORMED = (ValueError, KeyError, TypeError, OverflowError, RecursionError)  # raised by malformed answers
MEMORY_REMEDY = "Cut it shorter or scale it down, or give the worker's machine or container more memory."
REMEDY = "Export it again as H.264 in mp4, or give its frames as PNG in a zip."
_PACKAGES = Path(__file__).resolve().parents[2]  # the folder that contains `intrasplat`
_PASSED_VARIABLES = ("LD_LIBRARY_PATH", "SYSTEMROOT")  # some installations find no libraries without them

logger = logging.getLogger(__name__)

OnReport = Callable[[float], None]


@dataclass(frozen=True)
class Patience:
    """Time limits of the process in seconds: without another picture, in total, and from its answer to its exit.

    The time for which its threads wait for a core makes the first up to STARVED_FACTOR times as long.
    """

    max_silence_s: float = MAX_SILENCE_S
    max_total_s: float = MAX_TOTAL_S
    max_exit_s: float = MAX_EXIT_S


class DecoderKilledError(UnavailableError):
    """Something outside killed the decoding process, such as the out-of-memory killer: the clip is not the cause."""

    code = ErrorCode.DECODER_KILLED

    def __init__(self) -> None:
        problem = "The system killed the process that decodes the clip, as it does when memory runs out."
        super().__init__(problem, "Free memory on the worker's machine, or send a smaller clip; then retry.")


class Decoder:
    """A decoding process with a folder of its own. It answers one request.

    folder   where it writes its arrays; only this user may enter it, and it is removed with the process
    opened   what it reported about the clip before the first frame; None until then
    frames   number of frames of both eyes that are complete in its files
    result   its result; None until then
    """

    def __init__(self, program: Sequence[str] = PROGRAM) -> None:
        """Start the process. Until it gets a request it only loads its libraries.

        The kernel kills it when the calling thread ends: call this from a thread that lives as long as the process.
        """
        self.folder = Path(tempfile.mkdtemp(prefix="intrasplat-")).resolve()
        self.opened: dict[str, Any] | None = None
        self.frames = 0
        self.result: dict[str, Any] | None = None
        try:
            self._process = start_process(program, self.folder)
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise
        self.close: Callable[[], None] = weakref.finalize(self, _end_and_remove, self._process, self.folder)
        """End the process if it still runs, and remove its folder."""

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def ask(
        self,
        request: dict[str, Any],
        allowance: Allowance,
        on_report: OnReport = lambda share: None,
        should_stop: Callable[[], bool] = lambda: False,
        patience: Patience = Patience(),
    ) -> None:
        """Send the process its request. During later waits, on_report gets the share done until the clip is opened, and
        should_stop is called at least every POLL_S."""
        self._allowance, self._on_report, self._should_stop, self._patience = (
            allowance,
            on_report,
            should_stop,
            patience,
        )
        self._field, self._pictures = "clip", -1
        self._silence = Silence(partial(starved_s, self._process.pid))
        self._advanced_s = time.monotonic()
        self._end_s = self._advanced_s + patience.max_total_s
        self._lines = lines_of(self._process)
        assert self._process.stdin is not None
        asked = request | {"allowance": asdict(allowance), "parent": os.getpid()}
        with contextlib.suppress(BrokenPipeError), self._process.stdin as stdin:  # until_ended() reports the cause
            stdin.write(json.dumps(asked).encode() + b"\n")

    def until_opened(self) -> None:
        """Wait until `opened` or `result` is set. Raises as until_ended."""
        self._wait(lambda: self.opened is not None)

    def until_frame(self, index: int) -> None:
        """Wait until frame `index` is complete in the files, or `result` is set. Raises as until_ended."""
        self._wait(lambda: self.frames > index)

    def until_ended(self) -> dict[str, Any]:
        """The result, once it arrives. An error closes this.

        Raises:
            InputError, LimitError: as the process raised them; or it crashed, hung, or exceeded its allowance.
            Cancelled: should_stop returned True.
            StoreFullError: the disk is full.
            DecoderKilledError: something outside killed it.
        """
        self._wait(lambda: False)
        assert self.result is not None
        return self.result

    def _wait(self, enough: Callable[[], bool]) -> None:
        try:
            while self.result is None and not enough():
                self._take(next(self._lines, END))
                self._check()
        except MALFORMED:
            self.close()
            raise _undecodable(self._field, NONSENSE) from None
        except BaseException:
            self.close()
            raise

    def _take(self, line: bytes | None) -> None:
        """Process a line, or None if none arrived for a while."""
        if line is None:
            return
        message = json.loads(line) if line != END else {}
        if line == END or "result" in message or "error" in message:
            self.result = self._ended(dict(message))
        elif "opened" in message:
            self.opened = self.opened or dict(message["opened"])
        else:
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        self._field = "calibration" if message.get("field") == "calibration" else "clip"
        if int(message["pictures"]) > self._pictures:
            self._pictures, self._advanced_s = int(message["pictures"]), time.monotonic()
            self._silence.end()
        self.frames = max(self.frames, int(message["frames"]))
        if self.opened is None:
            self._on_report(min(1.0, max(0.0, float(message["share"]))))

    def _check(self) -> None:
        if self.result is not None:
            return
        if self._should_stop():
            raise Cancelled("Stopped during stage 'decode'.")
        now_s = time.monotonic()
        if self._silence.is_too_long(now_s - self._advanced_s, self._patience.max_silence_s):
            raise _undecodable(self._field, f"the decoder made no progress for {self._patience.max_silence_s:g} s")
        if now_s > self._end_s:
            raise _undecodable(self._field, f"the decoder took more than {self._patience.max_total_s:g} s")

    def _ended(self, answer: dict[str, Any]) -> dict[str, Any]:
        """The result, from the process's last line (empty if there was none) and its exit status."""
        try:
            self._process.wait(self._patience.max_exit_s if answer else MAX_DEATH_S)
            status = self._process.returncode
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            status = 0
        if not answer and status == -signal.SIGKILL:  # no limit of its own sends SIGKILL
            raise DecoderKilledError
        try:
            return _result(answer or None, status, self._field, self._allowance)
        except InputError as error:
            if Disk(self.folder).is_full():  # whatever failed, the clip is tried again when there is space
                raise _disk_full() from error
            raise


_ready: list[Decoder] = []
"""At most one process that has loaded its libraries and waits for its request."""


def keep_decoder_ready() -> None:
    """Start the next clip's decoding process now if none is waiting. Call it from the thread that will decode."""
    if not _ready:
        _ready.append(Decoder())


def take_decoder() -> Decoder:
    """The waiting process, or a new one."""
    decoder = _ready.pop() if _ready else Decoder()
    return decoder if decoder.is_alive else Decoder()


def start_process(program: Sequence[str], folder: Path, pass_fds: Sequence[int] = ()) -> subprocess.Popen[bytes]:
    """Start Python with these arguments in a folder; it confines itself, and its pipes carry lines.

    pass_fds: file descriptors that it gets. Raises OSError if it cannot be started.
    """
    return subprocess.Popen(
        [sys.executable, "-P", *program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=folder,
        env=_environment_of(folder),
        umask=0o077,
        start_new_session=True,  # the parent handles Ctrl-C
        pass_fds=pass_fds,
    )


def _end_and_remove(process: subprocess.Popen[bytes], folder: Path) -> None:
    if process.poll() is None:
        process.kill()
        process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
    shutil.rmtree(folder, ignore_errors=True)


def lines_of(process: subprocess.Popen[bytes]) -> Iterator[bytes | None]:
    """Whole lines as they arrive; None after POLL_S without a whole line.

    Raises:
        ValueError: a line is longer than MAX_ANSWER_BYTES.
    """
    assert process.stdout is not None
    descriptor = process.stdout.fileno()
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
            raise ValueError("a line without an end")


def _environment_of(folder: Path) -> dict[str, str]:
    """The process's environment. From the parent's it keeps only the variables for finding libraries."""
    kept = {name: os.environ[name] for name in _PASSED_VARIABLES if name in os.environ}
    return kept | {
        "PYTHONPATH": str(_PACKAGES),
        "PYTHONDONTWRITEBYTECODE": "1",
        "LANG": "C.UTF-8",
        "TMPDIR": str(folder),
        "MALLOC_ARENA_MAX": "2",  # each arena takes address space, which is limited
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
        problem = f"its decoder needed more than {allowance.memory_bytes / 2**30:.1f} GiB of memory."
        raise LimitError(field, problem, MEMORY_REMEDY)
    if error["kind"] == "fault":
        return _fault(error, field, allowance)
    if status == -signal.SIGXCPU:
        raise _undecodable(field, f"the decoder took more than {allowance.cpu_s} s of computing")
    name = signal.Signals(-status).name if status < 0 else f"status {status}"
    raise _undecodable(field, f"the decoder crashed ({name})")


def _fault(error: dict[str, Any], field: str, allowance: Allowance) -> dict[str, Any]:
    """Raise an InputError for an unexpected exception of the process, and log where it was raised."""
    if error["errno"] == errno.ENOSPC:
        raise _disk_full()
    if error["errno"] == errno.EFBIG:
        raise _undecodable(field, f"its frames take more than {allowance.file_bytes} bytes")
    logger.error("a fault while a clip was decoded: %s\n%s", error["type"], error["where"])
    raise _undecodable(field, f"the decoder failed ({error['type']})")


def _disk_full() -> StoreFullError:
    problem = "The disk is full: it has no space for the clip's frames."
    return StoreFullError(problem, "Free space on the disk of the data directory.")


def _undecodable(field: str, reason: str) -> InputError:
    return InputError(field, f"it cannot be decoded: {reason}.", REMEDY)
