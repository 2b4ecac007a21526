"""The confined process that reads a source, seen from the process that wants its pairs.

Whatever it writes is checked. Its pairs lie in a file in memory, which is read, not mapped.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.decode.contained import MALFORMED, lines_of, start_process
from intrasplat.decode.guard import Allowance
from intrasplat.intake.limits import MIN_SIDE_PX
from intrasplat.live.connecting import Connection
from intrasplat.live.reader import MAX_FAULT_CHARACTERS
from intrasplat.live.state import FeedReason

logger = logging.getLogger(__name__)

PROGRAM = ("-m", "intrasplat.live.child")
MEMORY_BYTES = 3 << 30  # address space of libraries, decoder and packets that wait
MAX_FILE_BYTES = 2 << 30
MAX_CPU_S = 86_400  # of all cores together; the process that exceeds it is replaced
MAX_DEATH_S = 0.5  # between the end of its output and its exit
PACKINGS = ("sbs", "tb", "two")
CHANNELS = 3


@dataclass(frozen=True)
class Numbers:
    """What the process reported last. See intrasplat/live/reader.py."""

    received: int = 0
    sequence: int = 0
    lag_s: float = 0.0
    is_slow: bool = False
    last_at: float | None = None
    problem: FeedReason | None = None
    shape: tuple[int, int, str, float] | None = None
    codec: str = ""
    place: tuple[float, float] | None = None
    """Source time and arrival of the newest pair."""
    epoch: int = 0
    parts: int = 0
    recording: FeedReason | None = None


@dataclass(frozen=True)
class HandedOver:
    """A pair as the process handed it over. epoch counts jumps of the clock within the connection."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    source_s: float
    arrived_at: float
    sequence: int
    epoch: int


class ReadingProcess:
    """A process that reads one connection. Its kernel kills it when the thread ends that made it.

    numbers     what it reported last
    end_reason  why it ended; None while it reads
    """

    def __init__(self, connection: Connection, request: dict[str, Any], folder: Path | None, max_pixels: int) -> None:
        """Start it. folder: where it records; None: it has a folder of its own for nothing."""
        self.numbers = Numbers()
        self.end_reason: FeedReason | None = None
        self.end_text = ""
        self._max_pixels = max_pixels
        self._own_folder = folder is None
        self._folder = folder or Path(tempfile.mkdtemp(prefix="intrasplat-")).resolve()
        self._pairs = _memory_file()
        self._wanted = 0
        self._pair: dict[str, Any] | None = None
        self._answered = threading.Condition()
        self._asking = threading.Lock()
        self._sending = threading.Lock()
        try:
            self._process = start_process(PROGRAM, self._folder, (*connection.passed, self._pairs))
        except BaseException:
            os.close(self._pairs)
            self._remove_folder()
            raise
        connection.close_passed()
        allowance = Allowance(MEMORY_BYTES, MAX_FILE_BYTES, MAX_CPU_S)
        more = {"open": connection.request, "pairs": self._pairs, "max_pixels": max_pixels, "parent": os.getpid()}
        more["connected_at"] = connection.made_at
        self._send(request | more | {"allowance": asdict(allowance) | request.get("allowance", {})})

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def reports(self) -> Iterator[None]:
        """Take its lines as they come; yields after each, and every 0.1 s without one, until it has ended."""
        try:
            for line in lines_of(self._process):
                if line is not None:
                    self._take(json.loads(line))
                if self.end_reason is None:
                    yield
                if self.end_reason is not None:
                    break
        except MALFORMED:
            self._end(FeedReason.DECODER_ENDED, "the process that reads the source talks nonsense")
        if self.end_reason is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(MAX_DEATH_S)
            text = f"the process that reads the source ended (status {self._process.returncode})"
            self._end(FeedReason.DECODER_ENDED, text)

    def newest(self, after: int, timeout_s: float) -> HandedOver | None:
        """The newest pair after sequence `after`; None if there is none in time, or the process has ended."""
        deadline_s = time.monotonic() + timeout_s
        if not self._asking.acquire(timeout=max(timeout_s, 0.0)):
            return None
        try:
            return self._newest(after, deadline_s)
        finally:
            self._asking.release()

    def _newest(self, after: int, deadline_s: float) -> HandedOver | None:
        with self._answered:
            self._wanted, self._pair = self._wanted + 1, None
        self._send({"want": self._wanted, "after": after})
        with self._answered:
            while self._pair is None and self.end_reason is None and (left_s := deadline_s - time.monotonic()) > 0:
                self._answered.wait(left_s)
            pair = self._pair
            self._wanted += pair is None  # an answer from now on is for nobody
        try:
            return None if pair is None else self._read(pair)
        except (*MALFORMED, OSError):
            self._end(FeedReason.DECODER_ENDED, "the process that reads the source hands over no pictures")
            return None

    def stop(self, limit_s: float) -> None:
        """Ask it to complete its recording and to end; then close it."""
        self._send({"end": True})
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(limit_s)
        self.close(FeedReason.BY_HAND, "")

    def close(self, reason: FeedReason, text: str) -> None:
        """End it if it still runs, for this reason."""
        self._end(reason, text)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with self._sending, contextlib.suppress(OSError, ValueError):
                assert pipe is not None
                pipe.close()
        self._remove_folder()
        with self._asking:
            if self._pairs >= 0:
                os.close(self._pairs)
                self._pairs = -1

    def _remove_folder(self) -> None:
        if self._own_folder:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _end(self, reason: FeedReason, text: str) -> None:
        with self._answered:
            if self.end_reason is None:
                self.end_reason, self.end_text = reason, text
            self._answered.notify_all()

    def _send(self, line: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        with self._sending, contextlib.suppress(BrokenPipeError, ValueError):  # reports() finds the cause
            self._process.stdin.write(json.dumps(line).encode() + b"\n")
            self._process.stdin.flush()

    def _take(self, line: Any) -> None:
        """Note a line. Raises one of MALFORMED for nonsense."""
        if not isinstance(line, dict):
            raise ValueError("a line that is no object")
        if "received" in line:
            self._note(line)
        if "fault" in line:
            logger.error("the process that reads a source failed: %r", str(line["fault"])[:MAX_FAULT_CHARACTERS])
        if "end" in line:
            self._end(FeedReason(line["end"]), str(line["text"])[:MAX_FAULT_CHARACTERS])
        elif "pair" in line:
            with self._answered:
                if line["pair"]["want"] == self._wanted:
                    self._pair = dict(line["pair"])
                    self._answered.notify_all()

    def _note(self, line: dict[str, Any]) -> None:
        shape = line["shape"]
        if shape is not None:
            height, width, packing, aspect = int(shape[0]), int(shape[1]), str(shape[2]), float(shape[3])
            self._check_size(height, width)
            if packing not in PACKINGS or not 0.1 < aspect < 10:
                raise ValueError("no shape")
            shape = (height, width, packing, aspect)
        last_at = None if line["last_at"] is None else min(_finite(line["last_at"]), time.time())
        self.numbers = Numbers(
            received=max(0, int(line["received"])),
            sequence=int(line["sequence"]),
            lag_s=max(0.0, _finite(line["lag_s"])),
            is_slow=bool(line["slow"]),
            last_at=last_at,
            problem=line["problem"] and FeedReason(line["problem"]),
            shape=shape,
            codec=str(line["codec"])[:20],
            place=line["place"] and (_finite(line["place"][0]), min(_finite(line["place"][1]), time.time())),
            epoch=max(0, int(line["epoch"])),
            parts=int(line["parts"]),
            recording=line["recording"] and FeedReason(line["recording"]),
        )

    def _check_size(self, height: int, width: int) -> None:
        if min(height, width) < MIN_SIDE_PX // 2 or height * width > self._max_pixels:
            raise ValueError(f"eyes of {width} x {height} pixels")

    def _read(self, pair: dict[str, Any]) -> HandedOver:
        height, width = int(pair["height"]), int(pair["width"])
        self._check_size(height, width)
        eyes = np.empty((2, height, width, CHANNELS), np.uint8)
        left, place = eyes.reshape(-1).data, 0
        while left:
            read = os.preadv(self._pairs, [left], place)
            if not read:
                raise ValueError("the pair's file is too short")
            left, place = left[read:], place + read
        arrived_at, epoch = min(_finite(pair["arrived_at"]), time.time()), int(pair["epoch"])
        return HandedOver(eyes[0], eyes[1], _finite(pair["source_s"]), arrived_at, int(pair["sequence"]), epoch)


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("a number that is not finite")
    return number


def _memory_file() -> int:
    """A file in memory where the system has them, else an unnamed one."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("intrasplat-pairs", os.MFD_CLOEXEC)
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
