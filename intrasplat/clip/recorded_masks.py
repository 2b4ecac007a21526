"""Converts masks from the rectified eye's pixels to the recording's pixels."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True)
class Rectification:
    """The rectification of the recorded left eye: parameters of cv2.initUndistortRectifyMap."""

    camera: tuple[tuple[float, ...], ...]
    distortion: tuple[float, ...]
    rotation: tuple[tuple[float, ...], ...]
    projection: tuple[tuple[float, ...], ...]

    @classmethod
    def parsed(cls, value: dict[str, Any]) -> Rectification:
        """The rectification from numbers() after storage as JSON. KeyError, TypeError."""
        matrices = {name: tuple(map(tuple, value[name])) for name in ("camera", "rotation", "projection")}
        return cls(distortion=tuple(value["distortion"]), **matrices)

    def numbers(self) -> dict[str, Any]:
        """The parameters by name, for JSON."""
        return asdict(self)

    def maps(self, height: int, width: int) -> Maps:
        """Columns and rows [H, W] of each recorded pixel in the rectified picture, as cv2.remap expects them."""
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2)
        camera, rotation, projection = map(np.array, (self.camera, self.rotation, self.projection))
        distortion = np.array(self.distortion)
        rectified = cv2.undistortPoints(pixels.astype(np.float64), camera, distortion, R=rotation, P=projection)
        x, y = np.moveaxis(rectified.reshape(height, width, 2).astype(np.float32), -1, 0)
        return np.ascontiguousarray(x), np.ascontiguousarray(y)


def as_recorded(mask: NDArray[np.bool_], maps: Maps) -> NDArray[np.bool_]:
    """A rectified eye's mask [H, W] in recorded pixels. Pixels that rectification cut off copy the border."""
    moved = cv2.remap(mask.astype(np.uint8), *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved > 0)
