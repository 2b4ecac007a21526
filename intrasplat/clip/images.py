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

MASK_THRESHOLD = 128  # of 255: masks are binary, but lossy video and resizing make grey edges
_HEADER_BYTES = 1 << 16  # a JPEG's size comes after its metadata blocks, each of up to 64 kB
_PNG_END = b"IEND\xaeB`\x82"
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

    @property
    def frame_count(self) -> int:
        return len(self.names)

    @property
    def label(self) -> str:
        return self.tree.label

    def frames(self) -> Iterator[RgbFrame]:
        """The frames, RGB uint8 [H, W, 3], from the first on. InputError if an image is damaged."""
        for name in self.names:
            yield as_rgb(self.decode(name), self.tree.field, name)

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
    """Pixels of a PNG or JPEG as stored (BGR order). InputError if it is cut short or damaged."""
    whole = _PNG_END in data[-64:] if data.startswith(PNG_MAGIC) else b"\xff\xd9" in data[-64:]
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if whole else None
    if image is None:
        raise InputError(field, f"{name} is damaged or cut short.", "Write the image again.")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(field, f"{name} has pixels of type {image.dtype}.", "Give 8-bit or 16-bit images.")
    return np.asarray(image)


def as_rgb(image: NDArray[Any], field: str, name: str) -> RgbFrame:
    """A decoded image as RGB uint8 [H, W, 3]: grey is repeated, alpha dropped, 16 bit scaled to 8."""
    if image.dtype == np.uint16:
        if 0 < image.max() <= 255:
            raise InputError(
                field, f"{name} stores 8-bit values in 16 bits (largest {image.max()}).", "Write it as 8-bit."
            )
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    to_rgb = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    return np.asarray(cv2.cvtColor(image, to_rgb[1 if image.ndim == 2 else image.shape[2]]))


def as_mask(image: NDArray[Any]) -> NDArray[np.bool_]:
    """A decoded mask as bool [H, W]: True where any colour channel reaches half of its range."""
    threshold = MASK_THRESHOLD * 257 if image.dtype == np.uint16 else MASK_THRESHOLD
    colours = image if image.ndim == 2 else image[:, :, :3].max(axis=2)
    return np.asarray(colours >= threshold)


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
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in _JPEG_NOT_SIZES:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None
