"""Encode a rendered layer as a file: png and npy are exact; jpeg and webp are for viewing only.

            png                         npy                   jpeg, webp
rgb         8 bit                       uint8 [H, W, 3]       8 bit
depth       16 bit, 0.01 mm, 0 invalid  float32 mm [H, W]     false colour, near bright, invalid black
confidence  8 bit, 255 = 1              float32 [H, W]        false colour, high bright
smoke       8 bit, 255 = 1              float32 [H, W]        false colour, thick bright
error       8 bit, levels               float32 levels, NaN   false colour, darker blue, brighter orange

False colours are those of intrasplat/colours.py; those of errors end at BRIGHTEST_ERROR levels.

If unseen pixels are marked, rgb and all false colours show a hatch there, and exact files of the other layers are 0.
Where nothing is compared, an error is NaN, 0 in png, and hatched.
Then png and webp of rgb have an alpha channel, UNSEEN_ALPHA (practically transparent) there and 255 elsewhere. Programs
without alpha show the hatch.
"""

from __future__ import annotations

import io
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.colours import COLOUR_TABLE, ERROR_COLOURS
from intrasplat.picture import BRIGHTEST_ERROR, ImageFormat, Layer, Unseen
from intrasplat.view.unseen import hatched

DEPTH_PNG_PER_MM = 100.0
DEFAULT_QUALITY = 90
FOR_EYES = frozenset({ImageFormat.JPEG, ImageFormat.WEBP})
UNSEEN_ALPHA = {ImageFormat.PNG: 0, ImageFormat.WEBP: 1}
"""Alpha of an unseen pixel, of 255, in the formats with alpha. webp's encoder discards colours under alpha 0 at any
quality, and stores those under alpha 1."""
PNG_COMPRESSION = 1
"""Fast rather than small: renders are sent over the loopback or a hospital's own network."""

FALSE_COLOURS = np.frombuffer(COLOUR_TABLE, np.uint8).reshape(256, 1, 3)[:, :, ::-1].copy()
"""The false colours [256, 1, 3] in OpenCV's order, BGR."""
_ENDS = np.frombuffer(ERROR_COLOURS, np.uint8).reshape(3, 3)[:, ::-1]
_CHANNELS = [np.interp(np.arange(256), (0, 127.5, 255), each) for each in _ENDS.T]
SIGNED_COLOURS = np.asarray(np.rint(np.stack(_CHANNELS, axis=-1))[:, None], np.uint8)
"""The false colours of errors, from -1 to 1, likewise."""


class Layers(Protocol):
    """The images of one render."""

    @property
    def rgb(self) -> NDArray[np.uint8]: ...

    @property
    def depth_mm(self) -> NDArray[np.float32]: ...

    @property
    def confidence(self) -> NDArray[np.float32]: ...

    @property
    def smoke(self) -> NDArray[np.float32]: ...

    @property
    def unseen(self) -> NDArray[np.bool_]: ...


def encode_layer(
    frame: Layers,
    layer: Layer,
    image_format: ImageFormat,
    quality: int = DEFAULT_QUALITY,
    unseen: Unseen = Unseen.MARK,
    *,
    depth_range_mm: tuple[float, float] | None = None,
    error: NDArray[np.float32] | None = None,
) -> bytes:
    """The bytes of a file with one layer of a frame.

    Args:
        quality: 1 to 100, for jpeg and webp.
        depth_range_mm: nearest and farthest depth of the false colours; jpeg and webp of depth need it.
        error: [H, W] signed levels, NaN where nothing is compared (error.py); layer error needs it.
    """
    if layer is Layer.ERROR:
        if error is None:
            raise ValueError("layer error needs the errors")
        return _encode_error(error, image_format, quality)
    marked = frame.unseen if unseen is Unseen.MARK else None
    if layer is Layer.RGB:
        return _encode_colour(frame.rgb, marked, image_format, quality)
    values = _values(frame, layer)
    if marked is not None:
        values = np.where(marked, np.float32(0), values)
    if image_format is ImageFormat.NPY:
        return _npy(values)
    if image_format in FOR_EYES:
        coloured = _in_false_colours(values, layer, depth_range_mm)
        return _image(coloured if marked is None else hatched(coloured, marked), image_format, quality)
    if layer is Layer.DEPTH:
        steps = np.clip(np.rint(values * DEPTH_PNG_PER_MM), 0, np.iinfo(np.uint16).max)
        return _image(steps.astype(np.uint16), image_format, quality)
    return _image(np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8), image_format, quality)


def _encode_error(levels: NDArray[np.float32], image_format: ImageFormat, quality: int) -> bytes:
    if image_format is ImageFormat.NPY:
        return _npy(np.abs(levels))
    missing, known = np.isnan(levels), np.asarray(np.nan_to_num(levels), np.float32)
    if image_format in FOR_EYES:
        shares = np.asarray((known / BRIGHTEST_ERROR + 1) / 2, np.float32)
        coloured = _coloured(shares, SIGNED_COLOURS)
        return _image(hatched(coloured, missing), image_format, quality)
    return _image(np.rint(np.abs(known)).astype(np.uint8), image_format, quality)


def _values(frame: Layers, layer: Layer) -> NDArray[np.float32]:
    """[H, W] of a layer of one channel."""
    if layer is Layer.DEPTH:
        return frame.depth_mm
    return frame.smoke if layer is Layer.SMOKE else frame.confidence


def _encode_colour(
    rgb: NDArray[np.uint8], marked: NDArray[np.bool_] | None, image_format: ImageFormat, quality: int
) -> bytes:
    """marked: pixels to hatch, and to make transparent if the format has alpha; None: none."""
    if marked is not None:
        rgb = hatched(rgb, marked)
    if image_format is ImageFormat.NPY:
        return _npy(rgb)
    if marked is None or image_format not in UNSEEN_ALPHA:
        return _image(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), np.uint8), image_format, quality)
    pixels = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGRA), np.uint8)
    pixels[..., 3] = np.where(marked, np.uint8(UNSEEN_ALPHA[image_format]), np.uint8(255))
    return _image(pixels, image_format, quality)


def _in_false_colours(
    values: NDArray[np.float32], layer: Layer, depth_range_mm: tuple[float, float] | None
) -> NDArray[np.uint8]:
    """BGR uint8 [H, W, 3]."""
    if layer is not Layer.DEPTH:
        return _coloured(values)
    if depth_range_mm is None:
        raise ValueError("depth in false colours needs depth_range_mm")
    near_mm, far_mm = depth_range_mm
    coloured = _coloured((np.float32(far_mm) - values) / np.float32(far_mm - near_mm))
    coloured[values <= 0] = 0
    return coloured


def _coloured(shares: NDArray[np.float32], colours: NDArray[np.uint8] = FALSE_COLOURS) -> NDArray[np.uint8]:
    """BGR uint8 [H, W, 3] of numbers, which are clamped to [0, 1]."""
    steps = np.rint(np.clip(shares, 0, 1) * 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(steps, colours), np.uint8)


def _image(pixels: NDArray[np.uint8] | NDArray[np.uint16], image_format: ImageFormat, quality: int) -> bytes:
    parameter, value = {
        ImageFormat.JPEG: (cv2.IMWRITE_JPEG_QUALITY, quality),
        ImageFormat.WEBP: (cv2.IMWRITE_WEBP_QUALITY, quality),
    }.get(image_format, (cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION))
    done, encoded = cv2.imencode(f".{image_format.value}", pixels, [parameter, value])
    if not done:
        raise RuntimeError(f"OpenCV could not encode {pixels.shape} as {image_format.value}")
    return bytes(encoded.tobytes())


def _npy(values: NDArray[np.uint8] | NDArray[np.float32]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=False)
    return buffer.getvalue()
