"""Reads video files with one of three decoders and no other.

OpenCV bundles many decoders, some of which had security holes. A whitelist of codecs only affects FFmpeg's probe, so
each allowed decoder is forced by name, in turn.

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.files import FileTree, scratch_folder
from intrasplat.clip.types import RgbFrame
from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.video_header import CODECS, REMEDY, check_video, is_matroska
from intrasplat.notices import Notice, NoticeCode

MAX_MISSING_FRAMES = 1  # containers that store a duration instead of a count round it
FALLBACK_RATE_HZ = 30.0
MAX_CACHE_BYTES = 512 << 20

_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm"
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_LOG_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"
_SILENT = 0  # OpenCV's own messages
_QUIET = "-8"  # AV_LOG_QUIET: hides the messages of decoders that refuse a file
_environment_lock = threading.Lock()  # OpenCV reads the options from the environment, which all threads share


class CachedFrames:
    """Decoded frames of a video, cached in an unnamed file, so that the pass that counts them need not be repeated.

    It stores MAX_CACHE_BYTES at most: for a longer video, decoding twice is cheaper than the disk space.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._shape: tuple[int, ...] = ()
        self._count = 0

    def add(self, frame: NDArray[np.uint8]) -> bool:
        """Store the next frame [H, W, 3], BGR. False if it exceeds the limit, the disk is full, or sizes differ."""
        if (self._count + 1) * frame.nbytes > MAX_CACHE_BYTES or frame.shape != (self._shape or frame.shape):
            return False
        self._shape, self._count = frame.shape, self._count + 1
        try:
            return self._file.write(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB).data) == frame.nbytes
        except OSError:
            return False

    def frame(self, index: int) -> RgbFrame:
        """A stored frame, RGB."""
        frame = np.empty(self._shape, np.uint8)
        os.preadv(self._file.fileno(), [frame.data], index * frame.nbytes)
        return frame


@dataclass(frozen=True)
class VideoFile:
    """A video with known frame count and times: a sequence of T RGB frames, which can be read repeatedly."""

    path: Path
    field: str
    label: str
    decoder: str
    frame_count: int
    height: int
    width: int
    frame_times_s: NDArray[np.float64] | None  # None: the container has no usable times
    limits: ClipLimits
    warnings: tuple[Notice, ...] = ()
    cached: CachedFrames | None = None  # None: each call of frames() decodes anew

    def frames(self) -> Iterator[RgbFrame]:
        """The frames, RGB uint8 [H, W, 3], from the first on. InputError if frames change size or end early."""
        if self.cached is not None:
            for index in range(self.frame_count):
                self.limits.on_picture()
                yield self.cached.frame(index)
            return
        with _capture(self.path, self.decoder) as capture:
            for index in range(self.frame_count):
                good, frame = capture.read() if capture is not None else (False, None)
                if not good or frame is None:
                    raise _cut_short(self.field, self.label, index, self.frame_count)
                if frame.shape[:2] != (self.height, self.width):
                    raise InputError(
                        self.field,
                        f"frame {index} of {self.label} is {frame.shape[1]}x{frame.shape[0]} pixels, "
                        f"the first is {self.width}x{self.height}.",
                        "Encode the clip in one size.",
                    )
                self.limits.on_picture()
                yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)


def open_video(path: Path, field: str, limits: ClipLimits, label: str | None = None) -> VideoFile:
    """The video, with its frames counted and timed. They are decoded later.

    Raises InputError if it is not a video, its codec is not allowed, or it ends early; LimitError if it is too large.
    """
    label = label or path.name
    codec = check_video(path, field, label, limits).codec
    # the declared codec only sets the order, to avoid failed attempts
    for decoder in sorted(CODECS, key=lambda decoder: codec not in CODECS[decoder]):
        with _capture(path, decoder) as capture:
            if capture is not None:
                return _survey(capture, path, field, limits, label, decoder)
    problem = f"{label} cannot be decoded: it is damaged, or its codec is none of {', '.join(CODECS)}."
    raise InputError(field, problem, REMEDY)


def open_video_in(tree: FileTree, name: str) -> VideoFile:
    """A video in a folder or zip. A copy from a zip is removed with the VideoFile."""
    path = tree.path(name)
    if path is not None:
        return open_video(path, tree.field, tree.limits, label=name)
    folder = scratch_folder()
    try:
        path = folder / f"video{Path(name).suffix.lower()}"
        tree.copy_to(name, path)
        video = open_video(path, tree.field, tree.limits, label=name)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    weakref.finalize(video, shutil.rmtree, folder, ignore_errors=True)
    return video


def _survey(capture: Any, path: Path, field: str, limits: ClipLimits, label: str, decoder: str) -> VideoFile:
    """The video, after a check of its header and one pass over all frames, which alone gives exact number and times."""
    width, height = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    declared = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))  # negative when the container has no duration
    rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
    limits.check_frame(field, label, width, height)
    limits.check_clip(field, label, declared, width, height)
    times_ms: list[float] = []
    cached: CachedFrames | None = CachedFrames()
    while capture.grab():
        times_ms.append(float(capture.get(cv2.CAP_PROP_POS_MSEC)))
        limits.on_picture()
        if cached is not None or len(times_ms) == 1:
            good, frame = capture.retrieve()
            if len(times_ms) == 1:  # a rotated clip differs in size from its header
                height, width = frame.shape[:2] if good else (height, width)
            cached = cached if cached is not None and good and cached.add(frame) else None
        limits.check_clip(field, label, len(times_ms), width, height)
    times_s = _times_s(times_ms, rate_hz)
    limits.check_duration(field, label, 0.0 if times_s is None or len(times_s) == 0 else float(times_s[-1]))
    whole = len(times_ms) + MAX_MISSING_FRAMES >= declared
    if not times_ms or not (whole or _whole_despite_count(path, decoder, declared, times_s, rate_hz, limits)):
        raise _cut_short(field, label, len(times_ms), declared)
    unknown = f"{field}: the video names no frame count, a missing end would not be noticed"
    warnings = () if declared else (Notice.warning(NoticeCode.FRAME_COUNT_UNKNOWN, unknown),)
    return VideoFile(path, field, label, decoder, len(times_ms), height, width, times_s, limits, warnings, cached)


def _whole_despite_count(
    path: Path, decoder: str, declared: int, times_s: NDArray[np.float64] | None, rate_hz: float, limits: ClipLimits
) -> bool:
    """Whether a video with fewer frames than `declared` is complete.

    For Matroska, `declared` is the duration times the nominal rate. With a variable frame rate, frames may be fewer if
    they last to the end. An mp4 that was cut without re-encoding has hidden frames outside its edit list, which count.
    """
    if is_matroska(path):
        if times_s is None or len(times_s) < 2:
            return False
        return bool(declared / rate_hz - times_s[-1] <= (1 + MAX_MISSING_FRAMES) * np.diff(times_s).max())
    with _capture(path, decoder, "|advanced_editlist;0") as capture:
        found = 0
        while capture is not None and found < declared and capture.grab():
            found += 1
            limits.on_picture()
    return found + MAX_MISSING_FRAMES >= declared


def _times_s(times_ms: list[float], rate_hz: float) -> NDArray[np.float64] | None:
    """Seconds from frame 0: by the container's time stamps if they rise, else by its frame rate, else None."""
    times_s = (np.asarray(times_ms, dtype=np.float64) - (times_ms[0] if times_ms else 0.0)) / 1000.0
    if len(times_s) > 1 and np.isfinite(times_s).all() and (np.diff(times_s) > 0).all():
        return times_s
    if np.isfinite(rate_hz) and 0 < rate_hz <= 1000:
        return np.arange(len(times_ms)) / rate_hz
    return None


@contextmanager
def _capture(path: Path, decoder: str, more_options: str = "") -> Iterator[Any | None]:
    """An OpenCV capture bound to one decoder and to local files, or None when that decoder refuses the file."""
    options = f"protocol_whitelist;file|format_whitelist;{_CONTAINERS}|codec_whitelist;{decoder}|video_codec;{decoder}"
    with _environment_lock:
        before = {name: os.environ.get(name) for name in (_OPTIONS, _LOG_LEVEL)}
        log_level = cv2.utils.logging.getLogLevel()
        os.environ.update({_OPTIONS: options + more_options, _LOG_LEVEL: before[_LOG_LEVEL] or _QUIET})
        cv2.utils.logging.setLogLevel(_SILENT)
        try:
            capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(log_level)
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value
    try:
        yield capture if capture.isOpened() else None
    finally:
        capture.release()


def _cut_short(field: str, label: str, found: int, declared: int) -> InputError:
    problem = f"{label} ends after {found} frames; its header says {declared}."
    return InputError(field, problem, "The file is cut short or damaged: copy or export it again.")
