"""Records packets as they come into fragmented mp4 files of some seconds, which begin at key frames."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.error

from intrasplat.files.disk_errors import DISK_FULL_ERRNOS
from intrasplat.live.parts import part_name
from intrasplat.live.state import FeedReason

RECORDABLE = ("h264", "hevc", "vp9", "mjpeg")
TICK = Fraction(1, 90_000)
FRAGMENTED = {"movflags": "frag_keyframe+empty_moov+default_base_moof"}
MAX_WAITING_BYTES = 64 << 20
RETRY_S = 5.0
"""After the disk failed."""
MAX_PART_BYTES = 512 << 20
"""A part that grows larger ends, and recording goes on at the next key frame."""
WRITTEN = ".writing"


@dataclass(frozen=True)
class Recorded:
    """A packet's data and its times on the feed's clock."""

    data: bytes
    is_key: bool
    pts_s: float
    dts_s: float
    epoch: int
    arrived_at: float


Template = Callable[[Any], Any]
"""Adds the stream of the packets to a container that is written."""


class Recorder:
    """A thread that writes parts into a folder. problem: why nothing is recorded at the moment."""

    def __init__(self, folder: Path, part_s: float, number: int, segment: int) -> None:
        """number, segment: of the first part."""
        self._folder, self._part_s, self._number, self._segment = folder, part_s, number, segment
        self.problem: FeedReason | None = None
        self.parts = 0
        self._template: Template | None = None
        self._queue: queue.SimpleQueue[Recorded | None] = queue.SimpleQueue()
        self._waiting_bytes, self._lock = 0, threading.Lock()
        self._part: _Part | None = None
        self._retry_at = 0.0
        self._lost = False
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)

    @property
    def is_started(self) -> bool:
        """Whether `start` was called."""
        return self._template is not None or self.problem is FeedReason.NOT_RECORDABLE

    def start(self, codec: str, template: Template) -> None:
        """Record packets of this codec from now on."""
        if codec not in RECORDABLE:
            self.problem = FeedReason.NOT_RECORDABLE
            return
        self._template = template
        self._thread.start()

    def add(self, packet: Recorded) -> None:
        """Record a packet. It is left out, and all until the next key frame, if the disk is too slow."""
        if self._template is None:
            return
        with self._lock:
            if self._waiting_bytes + len(packet.data) > MAX_WAITING_BYTES:
                self._lost, self.problem = True, FeedReason.DISK_SLOW
                return
            self._waiting_bytes += len(packet.data)
        self._queue.put(packet)

    def finish(self, limit_s: float) -> None:
        """Complete the part that is being written."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join(limit_s)

    def _run(self) -> None:
        while (packet := self._queue.get()) is not None:
            with self._lock:
                self._waiting_bytes -= len(packet.data)
                lost, self._lost = self._lost, False
            self._guarded(lambda packet=packet, lost=lost: self._write(packet, lost))  # type: ignore[misc]
        self._guarded(self._end_part)

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except (OSError, av.error.FFmpegError, ValueError) as error:
            full = getattr(error, "errno", None) in DISK_FULL_ERRNOS
            self.problem = FeedReason.DISK_FULL if full else FeedReason.DISK_FAILS
            self._retry_at = time.monotonic() + RETRY_S
            part, self._part = self._part, None
            if part is not None:
                part.discard()

    def _write(self, packet: Recorded, lost: bool) -> None:
        part = self._part
        if part is not None:
            is_long = packet.is_key and packet.dts_s - part.first.dts_s >= self._part_s
            if lost or is_long or packet.epoch != part.first.epoch or part.written_bytes > MAX_PART_BYTES:
                self._end_part()
        if self._part is None:
            if not packet.is_key or time.monotonic() < self._retry_at:
                return
            assert self._template is not None
            self._part = _Part(self._folder / f"{self._number}{WRITTEN}", packet, self._template)
            self._number += 1
        self._part.write(packet)

    def _end_part(self) -> None:
        part, self._part = self._part, None
        if part is None:
            return
        try:
            part.complete(self._number - 1, self._segment + part.first.epoch)
        except BaseException:
            part.discard()
            raise
        self.problem = None
        self.parts += 1


class _Part:
    """One file while it is written."""

    def __init__(self, path: Path, first: Recorded, template: Template) -> None:
        self._path, self.first, self._last = path, first, first
        self._end_s, self._dts = first.pts_s, -1
        self._sink = _Sink(path)
        try:
            self._container = av.open(self._sink, "w", format="mp4", options=FRAGMENTED)
            self._stream = template(self._container)
        except BaseException:
            self.discard()
            raise

    @property
    def written_bytes(self) -> int:
        """Bytes of the file so far."""
        return self._sink.written_bytes

    def write(self, packet: Recorded) -> None:
        """Append a packet."""
        muxed: av.Packet[Any] = av.Packet(packet.data)
        self._dts = max(self._dts + 1, round((packet.dts_s - self.first.dts_s) / TICK))
        muxed.dts, muxed.time_base = self._dts, TICK
        muxed.pts = max(self._dts, round((packet.pts_s - self.first.dts_s) / TICK))
        muxed.is_keyframe, muxed.stream = packet.is_key, self._stream
        self._container.mux(muxed)
        self._last, self._end_s = packet, max(self._end_s, packet.pts_s)

    def complete(self, number: int, segment: int) -> None:
        """Put the file on disk under its name. OSError: the disk refuses."""
        self._container.close()
        self._sink.complete()
        name = part_name(number, segment, self.first.pts_s, self._end_s, self.first.arrived_at, self._last.arrived_at)
        self._path.rename(self._path.with_name(name))

    def discard(self) -> None:
        """Remove the file."""
        with contextlib.suppress(Exception):
            self._container.close()
        with contextlib.suppress(Exception):
            self._sink.file.close()
        with contextlib.suppress(OSError):
            self._path.unlink()


class _Sink:
    """A file as FFmpeg writes it: only forward."""

    def __init__(self, path: Path) -> None:
        self.file = path.open("wb")
        self.written_bytes = 0

    def write(self, data: bytes) -> int:
        """Append bytes."""
        self.written_bytes += len(data)
        return self.file.write(data)

    def complete(self) -> None:
        """Close the file when it is on disk. OSError: the disk refuses."""
        self.file.flush()
        os.fsync(self.file.fileno())
        self.file.close()
