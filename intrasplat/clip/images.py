"""PNG and JPEG frames. Their size is checked in the header before decoding.

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.files import FileTree
from intrasplat.clip.types import RgbFrame
from intrasplat.errors import InputError
from intrasplat.intake.limits import MAX_IMAGE_BYTES
from intrasplat.intake.sniff import JPEG_MAGIC, PNG_MAGIC, png_size
from intrasplat.notices import Notice

MAX_16_BIT = (1 << 16) - 1
_HEADER_BYTES = 1 << 16  # a JPEG's size comes after its metadata blocks, each of up to 64 kB
_PNG_END = b"IEND\xaeB`\x82"
_JPEG_END = b"\xff\xd9"  # after the start of the scan: thumbnails before it have ends of their own
_JPEG_SCAN = 0xDA
_JPEG_NOT_SIZES = frozenset({0xC4, 0xC8, 0xCC})  # markers in the range of frame headers that are no frame headers


@dataclass(frozen=True)
class ImageSequence:
    """T images of one size as a sequence of RGB frames, which can be read repeatedly."""

    tree: FileTree
    names: tuple[str, ...]
    height: int
    width: int
    frame_times_s: NDArray[np.float64] | None = None  # images carry no time
    notices: tuple[Notice, ...] = ()
    damaged: tuple[int, ...] = ()
    pixel_aspect: float = 1.0
    white: int = MAX_16_BIT
    """The value of white in 16-bit pictures (bit_depth.py)."""

    @property
    def frame_count(self) -> int:
        return len(self.names)

    @property
    def label(self) -> str:
        return self.tree.label

    def frames(self) -> Iterator[RgbFrame]:
        """The frames, RGB uint8 [H, W, 3], from the first on. InputError if an image is damaged."""
        for name in self.names:
            yield self.picture(name)

    def picture(self, name: str) -> RgbFrame:
        """One frame, RGB uint8 [H, W, 3]. InputError if it is damaged."""
        return as_rgb(self.decode(name), self.white)

    def decode(self, name: str) -> NDArray[Any]:
        """The pixels as stored, with their size checked: [H, W] or [H, W, channels], uint8 or uint16, BGR order."""
        metadata_bytes, pixel_bytes = MAX_IMAGE_BYTES
        data = self.tree.read(name, metadata_bytes + pixel_bytes * self.width * self.height)
        image = decode_image(data, self.tree.field, name)
        if image.shape[:2] != (self.height, self.width):
            raise InputError(self.tree.field, f"{name} changed while it was read.", "Do not write to the clip.")
        self.tree.limits.on_picture()
        return image


def open_images(tree: FileTree, names: tuple[str, ...]) -> ImageSequence:
    """The images as a sequence, after a check of every header. InputError if sizes differ; LimitError."""
    if not names:
        raise InputError(tree.field, f"{tree.label} holds no PNG or JPEG images.", "Give the frames as PNG files.")
    width, height = _size_of(tree, names[0])
    tree.limits.check_frame(tree.field, names[0], width, height)
    tree.limits.check_clip(tree.field, tree.label, len(names), width, height)
    for name in names[1:]:
        if (size := _size_of(tree, name)) != (width, height):
            raise InputError(
                tree.field,
                f"{name} is {size[0]}x{size[1]} pixels, {names[0]} is {width}x{height}.",
                "Give all frames in one size.",
            )
    return ImageSequence(tree, names, height, width)


def decode_image(data: bytes, field: str, name: str) -> NDArray[Any]:
    """Pixels of a PNG or JPEG as stored (BGR order); bytes after its end do not count. InputError if damaged."""
    whole = _PNG_END in data if data.startswith(PNG_MAGIC) else data.find(_JPEG_END, _jpeg_scan(data)) >= 0
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if whole else None
    if image is None:
        if whole and (bits := _jpeg_bits(data)) not in (None, 8):
            raise InputError(field, f"{name} is a JPEG of {bits} bits a colour.", "Write it as a PNG of 16 bits.")
        raise InputError(field, f"{name} is damaged or cut short.", "Write the image again.")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(field, f"{name} has pixels of type {image.dtype}.", "Give 8-bit or 16-bit images.")
    return np.asarray(image)


def as_rgb(image: NDArray[Any], white: int = MAX_16_BIT) -> RgbFrame:
    """A decoded image as RGB uint8 [H, W, 3]: grey is repeated, alpha dropped, 16 bit scaled so that white is 255."""
    if image.dtype == np.uint16:
        image = ((np.minimum(image, white).astype(np.uint32) * 255 + white // 2) // white).astype(np.uint8)
    to_rgb = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    return np.asarray(cv2.cvtColor(image, to_rgb[1 if image.ndim == 2 else image.shape[2]]))


def as_levels(image: NDArray[Any]) -> NDArray[np.uint8]:
    """A decoded mask as uint8 [H, W] or [H, W, 3]: without alpha, 16 bit scaled to 8 unless all are below 256."""
    levels = image if image.ndim == 2 else image[:, :, :3]
    if image.dtype == np.uint16 and levels.max() > 255:
        levels = levels // 257
    return levels.astype(np.uint8)


def as_depth_mm(image: NDArray[Any], field: str, name: str) -> NDArray[np.float32]:
    """A decoded depth image as float32 [H, W] in mm; 0 = invalid. InputError if it is a colour picture."""
    if image.ndim == 3:
        if not (image[:, :, 0] == image[:, :, 1]).all() or not (image[:, :, 0] == image[:, :, 2]).all():
            raise InputError(
                field, f"{name} is a colour picture.", "Give depth as grey PNG, millimetres in each pixel."
            )
        image = image[:, :, 0]
    return image.astype(np.float32)


def _size_of(tree: FileTree, name: str) -> tuple[int, int]:
    """(width, height) from the header."""
    header = tree.head(name, 32)
    size = png_size(header)
    if size is None and header.startswith(JPEG_MAGIC):
        size = jpeg_size(tree.head(name, 4 * _HEADER_BYTES))
    if size is None:
        problem = f"{name} is empty (0 bytes)." if not header else f"{name} is not a PNG or JPEG image."
        raise InputError(tree.field, problem, "Write the image again, as PNG.")
    return size


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) of a JPEG; walks the marker segments up to the frame header (ITU T.81, B.2)."""
    if (at := _jpeg_frame(data)) is None:
        return None
    return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")


def _jpeg_bits(data: bytes) -> int | None:
    """Bits of a colour in a JPEG; None if it has no frame header."""
    at = _jpeg_frame(data)
    return None if at is None else data[at + 4]


def _jpeg_frame(data: bytes) -> int | None:
    """Where the frame header of a JPEG starts."""
    found = (at for at, marker in _jpeg_segments(data) if 0xC0 <= marker <= 0xCF and marker not in _JPEG_NOT_SIZES)
    return next(found, None)


def _jpeg_scan(data: bytes) -> int:
    """Where the pixels of a JPEG start; its length if there are none."""
    return next((at for at, marker in _jpeg_segments(data) if marker == _JPEG_SCAN), len(data))


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """(place, marker) of each segment before the pixels, which come after the marker _JPEG_SCAN."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        yield at, data[at + 1]
        if data[at + 1] == _JPEG_SCAN:
            return
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
