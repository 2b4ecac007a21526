"""How large a clip may be, to the service that takes it in and the worker that reads it.

A 166 kB file can decode to 18 GB, so sizes are checked in the header and again while decoding.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from contract.wire.errors import LimitError

if TYPE_CHECKING:
    from contract.runtime.settings import Settings

MIN_SIDE_PX = 16  # below this neither stereo matching nor a tile of the rasteriser has anything to work on

HELD_BYTES_PER_PIXEL = 18
"""Memory that a pixel of one eye takes in every frame while a clip is reconstructed.

9 in the DepthClip (rgb 3, depth_mm 4, depth_confidence 1, tissue 1), 8 in the training frames made from it (rgb 3,
weight 1, inverse depth 4), and 1 for their padding; before these exist, masks and the grey right eye take less.
"""

MAX_MEMORY_BYTES = 8 * 1024**3  # a clip may take, however much there is: more frames than this train for too long
MEMORY_SHARE = 2  # a clip may take one part in this many of the machine's memory; the model and its gradients need room

EYES = 2  # of a stereo clip; the largest picture accepted holds both

MAX_POSES_BYTES = 1 << 16, 1024  # of poses_bounds.npy: its header, and a frame's 17 numbers with ample room
MAX_CALIBRATION_BYTES = 1_000_000  # a calibration has a few kB; anything larger is another file
MAX_IMAGE_BYTES = 1 << 20, 8  # of a PNG or JPEG: its metadata, and a pixel of 16-bit RGBA stored uncompressed


def memory_for_clip_bytes() -> int:
    """What a clip may take of this machine's memory: half of it, at most 8 GiB."""
    try:
        memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not every system tells
        return MAX_MEMORY_BYTES
    return min(MAX_MEMORY_BYTES, memory_bytes // MEMORY_SHARE) if memory_bytes > 0 else MAX_MEMORY_BYTES


def _ignore() -> None:
    """What is done after each picture by default."""


@dataclass(frozen=True)
class ClipLimits:
    """What this machine accepts.

    frames            frames of a clip
    duration_s        seconds that a clip lasts, by its frame times
    pixels_per_frame  pixels of one recorded picture (both eyes when they share it); default: two eyes of 3840x2160
    decoded_bytes     memory of the whole clip while it is reconstructed (HELD_BYTES_PER_PIXEL), and bytes of everything
                      in an archive once inflated; default: half of this machine's memory, at most 8 GiB
    on_picture        called after each picture that is decoded, from any thread: whoever waits knows that it goes on
    """

    frames: int = 1000
    duration_s: float = 600.0
    pixels_per_frame: int = 2 * 3840 * 2160
    decoded_bytes: int = field(default_factory=memory_for_clip_bytes)
    on_picture: Callable[[], None] = field(default=_ignore, compare=False)

    @classmethod
    def of(cls, settings: Settings) -> ClipLimits:
        """Those of an installation; its limit on one eye's pixels allows a picture of two."""
        return cls(settings.max_frames, settings.max_clip_s, EYES * settings.max_frame_pixels)

    def numbers(self) -> dict[str, float]:
        """The limits by their names, as another process may be told them."""
        return {name: getattr(self, name) for name in ("frames", "duration_s", "pixels_per_frame", "decoded_bytes")}

    def check_duration(self, field: str, label: str, duration_s: float) -> None:
        """LimitError unless a clip may last so long."""
        if duration_s > self.duration_s:
            raise LimitError(
                field, f"{label} lasts {duration_s:.1f} s; the limit is {self.duration_s:g} s.", "Cut a shorter clip."
            )

    def check_frame(self, field: str, label: str, width: int, height: int) -> None:
        """LimitError unless a picture of width x height pixels is acceptable."""
        if width < MIN_SIDE_PX or height < MIN_SIDE_PX:
            raise LimitError(
                field,
                f"{label} is {width}x{height} pixels.",
                f"Give frames of at least {MIN_SIDE_PX} pixels on each side.",
            )
        if width * height > self.pixels_per_frame:
            raise LimitError(
                field,
                f"{label} is {width}x{height} pixels, {width * height} in all; the limit is {self.pixels_per_frame}.",
                "Scale the clip down.",
            )

    def check_clip(self, field: str, label: str, frames: int, width: int, height: int, eyes: int = 2) -> None:
        """LimitError unless `frames` pictures of width x height pixels are acceptable.

        eyes is how many share a picture, of which one is held; 2 where that is not known yet.
        """
        if frames > self.frames:
            raise LimitError(
                field, f"{label} has {frames} frames or more; the limit is {self.frames}.", "Cut a shorter clip."
            )
        if eyes == 1 and width * height > self.pixels_per_frame // EYES:
            problem = f"an eye of {label} has {width}x{height} pixels; the limit is {self.pixels_per_frame // EYES}."
            raise LimitError(field, problem, "Scale the clip down.")
        bytes_per_frame = width * height * HELD_BYTES_PER_PIXEL // eyes
        if frames * bytes_per_frame > self.decoded_bytes:
            fitting = self.decoded_bytes // bytes_per_frame
            raise LimitError(
                field,
                f"{label} has at least {frames} frames of {width}x{height} pixels; they take "
                f"{_mebibytes(frames * bytes_per_frame)} of memory, and the limit of "
                f"{_mebibytes(self.decoded_bytes)} holds {fitting}.",
                f"Cut it to {fitting} frames, or scale it down." if fitting else "Scale it down.",
            )


def _mebibytes(count: int) -> str:
    return f"{count / 2**20:.1f} MiB"
