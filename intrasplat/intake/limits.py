"""Size limits of a clip. The service checks them at upload, the library during decoding.

A 166 kB file can decode to 18 GB, so sizes are checked in the header and again during decoding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from intrasplat.errors import LimitError
from intrasplat.machine.memory_limit import memory_bytes

MIN_SIDE_PX = 16  # minimum for stereo matching and the rasteriser's tiles

CLIP_BYTES_PER_PIXEL = 18
"""Bytes per pixel and frame for both eyes during reconstruction; one eye alone takes half.

Each eye takes 9 in the DepthClip: rgb 3, depth_mm 4, depth_confidence 1, tissue 1. Training frames are views of it. If
stereo computes the depth, frame by frame, the clip lies in files; a clip that has depth is first in memory as a whole.
"""

MAX_CLIP_BYTES = 8 * 1024**3  # of a clip in files, on any machine: more frames would train for too long

MAX_MEMORY_BYTES = MAX_CLIP_BYTES  # of a clip with depth, on any machine
MEMORY_PARTS = 2  # a clip may take 1 / MEMORY_PARTS of memory_bytes(); the rest is for the model

EYES = 2  # of a stereo clip; the largest accepted picture contains both

MAX_POSES_BYTES = 1 << 16, 1024  # of poses_bounds.npy: its header, and each frame's 17 numbers
MAX_POSE_FILE_BYTES = 16 * 2**20  # a file of poses has some 100 bytes a frame
MAX_FOV_MASK_BYTES = 16 * 2**20  # a PNG of two areas has some kB
MAX_CALIBRATION_BYTES = 250_000  # a calibration has a few kB, or some ten with its calibration points
MAX_IMAGE_BYTES = 1 << 20, 8  # of a PNG or JPEG: its metadata, and each pixel as uncompressed 16-bit RGBA


def memory_for_clip_bytes() -> int:
    """Maximum memory of a clip on this machine: half of the machine's or the container's, at most 8 GiB."""
    there = memory_bytes()
    return MAX_MEMORY_BYTES if there is None else min(MAX_MEMORY_BYTES, there // MEMORY_PARTS)


def _ignore() -> None:
    """Do nothing."""


@dataclass(frozen=True)
class ClipLimits:
    """Limits of the clips that this machine accepts.

    frames            frames of a clip
    duration_s        duration by the frame times
    pixels_per_frame  pixels of one recorded picture (both eyes when they share it); default: two eyes of 3840x2160
    clip_bytes        bytes of the whole clip during reconstruction (CLIP_BYTES_PER_PIXEL)
    decoded_bytes     memory of a clip that has depth, computed likewise, and inflated size of a whole archive;
                      default: memory_for_clip_bytes()
    on_picture        called after each decoded picture, from any thread, as a sign of progress
    """

    frames: int = 1000
    duration_s: float = 600.0
    pixels_per_frame: int = 2 * 3840 * 2160
    clip_bytes: int = MAX_CLIP_BYTES
    decoded_bytes: int = field(default_factory=memory_for_clip_bytes)
    on_picture: Callable[[], None] = field(default=_ignore, compare=False)

    def numbers(self) -> dict[str, float]:
        """The limits by name, for another process."""
        names = ("frames", "duration_s", "pixels_per_frame", "clip_bytes", "decoded_bytes")
        return {name: getattr(self, name) for name in names}

    def check_duration(self, field: str, label: str, duration_s: float) -> None:
        """LimitError if a clip lasts too long."""
        if duration_s > self.duration_s:
            raise LimitError(
                field, f"{label} lasts {duration_s:.1f} s; the limit is {self.duration_s:g} s.", "Cut a shorter clip."
            )

    def check_frame(self, field: str, label: str, width: int, height: int) -> None:
        """LimitError if a picture of width x height pixels is too small or too large."""
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

    def check_clip(
        self,
        field: str,
        label: str,
        frames: int,
        width: int,
        height: int,
        eyes: int = 2,
        *,
        has_depth: bool = False,
    ) -> None:
        """LimitError if `frames` pictures of width x height pixels are too many or too large.

        eyes: number of eyes in a picture; 2 if it is not known yet.
        has_depth: the clip is in memory as a whole, not in files.
        """
        if frames > self.frames:
            raise LimitError(
                field, f"{label} has {frames} frames or more; the limit is {self.frames}.", "Cut a shorter clip."
            )
        if eyes == 1 and width * height > self.pixels_per_frame // EYES:
            problem = f"an eye of {label} has {width}x{height} pixels; the limit is {self.pixels_per_frame // EYES}."
            raise LimitError(field, problem, "Scale the clip down.")
        bytes_per_frame = width * height * CLIP_BYTES_PER_PIXEL // eyes
        place, allowed = ("memory", self.decoded_bytes) if has_depth else ("disk", self.clip_bytes)
        if frames * bytes_per_frame > allowed:
            fitting = allowed // bytes_per_frame
            raise LimitError(
                field,
                f"{label} has at least {frames} frames of {width}x{height} pixels; they take "
                f"{_mebibytes(frames * bytes_per_frame)} of {place}, and the limit of "
                f"{_mebibytes(allowed)} holds {fitting}.",
                f"Cut it to {fitting} frames, or scale it down." if fitting else "Scale it down.",
            )


def _mebibytes(count: int) -> str:
    return f"{count / 2**20:.1f} MiB"
