"""A rendered layer as a file: png and npy are exact, jpeg and webp are for eyes.

            png                         npy                   jpeg, webp
rgb         8 bit                       uint8 [H, W, 3]       8 bit
depth       16 bit, 0.01 mm, 0 invalid  float32 mm [H, W]     false colour, near bright, invalid black
confidence  8 bit, 255 = 1              float32 [H, W]        false colour
"""

from __future__ import annotations

import io
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.wire.rendering import ImageFormat, Layer

DEPTH_PNG_PER_MM = 100.0
DEFAULT_QUALITY = 90
FOR_EYES = frozenset({ImageFormat.JPEG, ImageFormat.WEBP})
PNG_COMPRESSION = 1
"""Fast rather than small: renders travel over the loopback or a hospital's own network."""

DEPTH_VIEW_PERCENTILES = (2.0, 98.0)
"""Depths between these fill the false-colour range, so that a few strays do not flatten the picture."""


class Layers(Protocol):
    """The images of one render."""

    @property
    def rgb(self) -> NDArray[np.uint8]: ...

    @property
    def depth_mm(self) -> NDArray[np.float32]: ...

    @property
    def confidence(self) -> NDArray[np.float32]: ...


def encode_layer(frame: Layers, layer: Layer, image_format: ImageFormat, quality: int = DEFAULT_QUALITY) -> bytes:
    """The file's bytes; quality, 1 to 100, is that of jpeg and webp."""
    if image_format is ImageFormat.NPY:
        return _npy(frame, layer)
    if layer is Layer.RGB:
        return _image(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), image_format, quality)
    if image_format in FOR_EYES:
        false_colour = view_depth(frame.depth_mm) if layer is Layer.DEPTH else view_confidence(frame.confidence)
        return _image(false_colour, image_format, quality)
    if layer is Layer.DEPTH:
        steps = np.clip(np.rint(frame.depth_mm * DEPTH_PNG_PER_MM), 0, np.iinfo(np.uint16).max)
        return _image(steps.astype(np.uint16), image_format, quality)
    return _image(np.rint(np.clip(frame.confidence, 0, 1) * 255).astype(np.uint8), image_format, quality)


def view_depth(depth_mm: NDArray[np.float32]) -> NDArray[np.uint8]:
    """False colour, BGR uint8 [H, W, 3]: near is bright, invalid is black."""
    valid = depth_mm > 0
    if not valid.any():
        return np.zeros((*depth_mm.shape, 3), np.uint8)
    near_mm, far_mm = np.percentile(depth_mm[valid], DEPTH_VIEW_PERCENTILES)
    nearness = (far_mm - depth_mm) / max(float(far_mm - near_mm), 1e-6)
    grey = np.rint(np.clip(nearness, 0, 1) * 255).astype(np.uint8)
    coloured = np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_TURBO), np.uint8)
    coloured[~valid] = 0
    return coloured


def view_confidence(confidence: NDArray[np.float32]) -> NDArray[np.uint8]:
    """False colour, BGR uint8 [H, W, 3]: dark where the model saw nothing."""
    grey = np.rint(np.clip(confidence, 0, 1) * 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), np.uint8)


def _image(pixels: NDArray[np.uint8] | NDArray[np.uint16], image_format: ImageFormat, quality: int) -> bytes:
    parameter, value = {
        ImageFormat.JPEG: (cv2.IMWRITE_JPEG_QUALITY, quality),
        ImageFormat.WEBP: (cv2.IMWRITE_WEBP_QUALITY, quality),
    }.get(image_format, (cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION))
    done, encoded = cv2.imencode(f".{image_format.value}", pixels, [parameter, value])
    if not done:
        raise RuntimeError(f"OpenCV could not encode {pixels.shape} as {image_format.value}")
    return bytes(encoded.tobytes())


def _npy(frame: Layers, layer: Layer) -> bytes:
    buffer = io.BytesIO()
    if layer is Layer.RGB:
        np.save(buffer, frame.rgb, allow_pickle=False)
    else:
        np.save(buffer, frame.depth_mm if layer is Layer.DEPTH else frame.confidence, allow_pickle=False)
    return buffer.getvalue()
