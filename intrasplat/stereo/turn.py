"""Rotation and zoom of the right eye's camera against its calibration, and the homographies that follow.

Symbols: H W pixels of one eye. `calibrated`: the right eye's camera without rotation; its picture is the rectified one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from intrasplat.camera import Intrinsics

Rgb = NDArray[np.uint8]  # [H, W, 3] or grey [H, W]
AnyImage = NDArray[Any]  # [H, W]

MIN_CORRECTION_PX = 0.05  # less is within the measurement error
MIN_MOVED_PX = 0.5  # below it no whole pixel moves


@dataclass(frozen=True)
class EyeRotation:
    """The right eye's camera relative to the calibrated one. The principal point's column, which depth uses, is fixed.

    lower_px     rows by which its picture lies lower than the left one's
    pitch_rad, yaw_rad, roll_rad  rotation about its own x, y, z axes
    zoom         relative increase of its focal length
    """

    lower_px: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    roll_rad: float = 0.0
    zoom: float = 0.0

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Rotation [3, 3] left_from_right: the directions of the right eye's axes."""
        rotation: NDArray[np.float64] = Rotation.from_rotvec([self.pitch_rad, self.yaw_rad, self.roll_rad]).as_matrix()
        return rotation

    def camera(self, calibrated: Intrinsics) -> Intrinsics:
        """The right eye's camera; `calibrated` is its camera without rotation."""
        k, (x, y, z) = calibrated, self.rotation.T @ (0.0, 0.0, 1.0)
        fx, fy = k.fx * (1 + self.zoom), k.fy * (1 + self.zoom)
        return replace(k, fx=fx, fy=fy, cx=k.cx - fx * float(x / z), cy=k.cy + self.lower_px - fy * float(y / z))

    def from_rectified(self, calibrated: Intrinsics) -> NDArray[np.float64]:
        """Homography [3, 3] from array positions in the rectified right picture to those in the recorded one.

        The third coordinate is the ratio of a point's depth in the rotated eye to that in the calibrated one.
        """
        return _from_rectified(self, calibrated)

    def moved_px(self, calibrated: Intrinsics) -> float:
        """The largest displacement, px, of a point of the picture's border by the rotation."""
        return _moved_px(self, calibrated)

    def rectified(self, image: Rgb, calibrated: Intrinsics) -> Rgb:
        """The recorded right picture as the calibrated eye would show it; unchanged if the correction is tiny."""
        if self.moved_px(calibrated) < MIN_CORRECTION_PX:
            return image
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        matrix, size = self.from_rectified(calibrated), (calibrated.width, calibrated.height)
        redrawn: Rgb = cv2.warpPerspective(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return redrawn

    def recorded(self, image: AnyImage, calibrated: Intrinsics) -> AnyImage:
        """An image in the calibrated eye's pixels, resampled (nearest) to the recorded picture's; 0 outside."""
        if self.moved_px(calibrated) < MIN_MOVED_PX:
            return image
        matrix, size = self.from_rectified(calibrated), (calibrated.width, calibrated.height)
        moved: AnyImage = cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_NEAREST)
        return moved

    def depth_factor(self, calibrated: Intrinsics) -> NDArray[np.float32]:
        """Ratio [H, W] of depth in the rotated eye to depth in the calibrated one, in the calibrated eye's pixels."""
        return _depth_factor(self, calibrated)


@lru_cache(16)  # all frames of a clip have the same rotation
def _from_rectified(turn: EyeRotation, calibrated: Intrinsics) -> NDArray[np.float64]:
    matrix = _matrix(turn.camera(calibrated)) @ turn.rotation.T @ np.linalg.inv(_matrix(calibrated))
    matrix.flags.writeable = False
    return matrix


@lru_cache(16)
def _moved_px(turn: EyeRotation, calibrated: Intrinsics) -> float:
    if turn == EyeRotation():
        return 0.0
    x, y = (np.array([0, 0.5, 1]) * side for side in (calibrated.width, calibrated.height))
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    moved = cv2.perspectiveTransform(places, turn.from_rectified(calibrated))
    return float(np.linalg.norm(moved - places, axis=2).max())


@lru_cache(1)
def _depth_factor(turn: EyeRotation, calibrated: Intrinsics) -> NDArray[np.float32]:
    a, b, c = turn.from_rectified(calibrated)[2]
    x, y = np.arange(calibrated.width), np.arange(calibrated.height)[:, None]
    factor = np.asarray(a * x + b * y + c, np.float32)
    factor.flags.writeable = False
    return factor


def _matrix(camera: Intrinsics) -> NDArray[np.float64]:
    """Camera matrix [3, 3] for array positions, whose pixel centres are whole numbers."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1.0]])
