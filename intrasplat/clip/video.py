"""A video file as a sequence of RGB frames of known number and times.

PyAV is loaded with the first video (clip/video_survey.py): only the decoding process needs it.

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.files import FileTree, scratch_folder
from intrasplat.clip.types import RgbFrame
from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.notices import Notice

if TYPE_CHECKING:
    from intrasplat.clip.fields import Interlacing

MAX_CACHE_BYTES = 512 << 20


class CachedFrames:
    """Decoded frames of a video, cached in an unnamed file, so that the pass that counts them need not be repeated.

    It stores MAX_CACHE_BYTES at most: for a longer video, decoding twice is cheaper than the disk space.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._shape: tuple[int, ...] = ()
        self._count = 0

    def add(self, frame: RgbFrame) -> bool:
        """Store the next frame [H, W, 3]. False if it exceeds the limit, the disk is full, or sizes differ."""
        if (self._count + 1) * frame.nbytes > MAX_CACHE_BYTES or frame.shape != (self._shape or frame.shape):
            return False
        self._shape, self._count = frame.shape, self._count + 1
        try:
            return self._file.write(frame.data) == frame.nbytes
        except OSError:
            return False

    def frame(self, index: int) -> RgbFrame:
        """A stored frame."""
        frame = np.empty(self._shape, np.uint8)
        os.preadv(self._file.fileno(), [frame.data], index * frame.nbytes)
        return frame


@dataclass(frozen=True)
class VideoFile:
    """A video with known frame count and times: a sequence of T RGB frames, which can be read repeatedly.

    frame_times_s  [T] seconds from frame 0; None: the container has no usable times
    sources        [T] number of the decoded frame to show; a damaged frame shows a sound one before it
    damaged        indices of damaged frames
    pixel_aspect   width / height of a pixel by the container
    interlacing    frames to deinterlace; None: none
    cached         the decoded frames; None: each call of frames() decodes anew
    """

    path: Path
    field: str
    label: str
    height: int
    width: int
    frame_times_s: NDArray[np.float64] | None
    limits: ClipLimits
    sources: tuple[int, ...]
    damaged: tuple[int, ...] = ()
    pixel_aspect: float = 1.0
    interlacing: Interlacing | None = None
    notices: tuple[Notice, ...] = ()
    cached: CachedFrames | None = None

    @property
    def frame_count(self) -> int:
        return len(self.sources)

    def frames(self) -> Iterator[RgbFrame]:
        """The frames, RGB uint8 [H, W, 3], from the first on. InputError if they end early."""
        if self.cached is not None:
            for source in self.sources:
                self.limits.on_picture()
                yield self.cached.frame(source)
            return
        from intrasplat.clip.video_survey import rgb_frames

        decoded = enumerate(rgb_frames(self))
        index, frame = -1, np.empty((0, 0, 3), np.uint8)
        for shown, source in enumerate(self.sources):
            while index < source:
                found = next(decoded, None)
                if found is None:
                    problem = f"{self.label} ends after {shown} frames the second time it is read."
                    raise InputError(self.field, problem, "Do not write to the clip.")
                index, frame = found
            self.limits.on_picture()
            yield frame


def open_video(path: Path, field: str, limits: ClipLimits, label: str | None = None) -> VideoFile:
    """The video, with its frames counted, timed and checked for damage and interlacing.

    Raises:
        InputError: it is not a video, its codec is not allowed, it ends early, or most of it is damaged.
        LimitError: it is too large.
    """
    from intrasplat.clip.video_survey import survey

    return survey(path, field, limits, label or path.name)


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
