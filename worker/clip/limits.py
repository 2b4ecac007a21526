"""How large a clip may be.

A 166 kB file can decode to 18 GB, so sizes are checked in the header and again while decoding.
"""

from __future__ import annotations

from dataclasses import dataclass

from contract.errors import LimitError

SMALLEST_SIDE_PX = 16  # below this neither stereo matching nor a tile of the rasteriser has anything to work on


@dataclass(frozen=True)
class ClipLimits:
    """What this machine accepts.

    frames            frames of a clip
    pixels_per_frame  pixels of one recorded picture (both eyes when they share it); default: two eyes of 3840x2160
    decoded_bytes     bytes of the whole clip once decoded, and of everything in an archive once inflated
    """

    frames: int = 1000
    pixels_per_frame: int = 2 * 3840 * 2160
    decoded_bytes: int = 8 * 1024**3

    def check_frame(self, field: str, label: str, width: int, height: int) -> None:
        """LimitError unless a picture of width x height pixels is acceptable."""
        if width < SMALLEST_SIDE_PX or height < SMALLEST_SIDE_PX:
            raise LimitError(
                field,
                f"{label} is {width}x{height} pixels.",
                f"Give frames of at least {SMALLEST_SIDE_PX} pixels on each side.",
            )
        if width * height > self.pixels_per_frame:
            raise LimitError(
                field,
                f"{label} is {width}x{height} pixels, {width * height} in all; the limit is {self.pixels_per_frame}.",
                "Scale the clip down.",
            )

    def check_clip(self, field: str, label: str, frames: int, bytes_per_frame: int) -> None:
        """LimitError unless `frames` decoded frames of bytes_per_frame bytes each are acceptable."""
        if frames > self.frames:
            raise LimitError(
                field, f"{label} has {frames} frames or more; the limit is {self.frames}.", "Cut a shorter clip."
            )
        if frames * bytes_per_frame > self.decoded_bytes:
            raise LimitError(
                field,
                f"{label} decodes to {frames * bytes_per_frame} bytes ({frames} frames); "
                f"the limit is {self.decoded_bytes}.",
                "Cut a shorter clip or scale it down.",
            )
