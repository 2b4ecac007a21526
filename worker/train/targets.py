"""The training frames as the rasteriser compares with them: padded to whole tiles, in optimiser units.

Symbols: T frames, H W pixels; stride = W rounded up to whole vectors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from contract.wire.errors import InputError
from worker.input.camera import Intrinsics
from worker.input.clip import DepthClip, Eye
from worker.model.metrics import COVERED_ALPHA, psnr_tissue
from worker.raster import Camera
from worker.raster.cpu import padded
from worker.raster.step import Target, TrainingFrame, camera_vector

MEDIAN_DEPTH_UNITS = 60.0
"""The median valid depth of the training frames in optimiser units; Adam's rates are stated in this unit."""


def units_per_mm(clip: DepthClip, train: Sequence[int]) -> float:
    """Optimiser units a millimetre, from the training frames' valid tissue depths.

    Raises:
        InputError: no training frame has valid depth on tissue.
    """
    sampled = [clip.depth_mm[i][::4, ::4][clip.tissue[i][::4, ::4]] for i in train]
    depths = np.concatenate([values[values > 0] for values in sampled])
    if depths.size == 0:
        depths = np.concatenate([clip.depth_mm[i][clip.tissue[i] & (clip.depth_mm[i] > 0)] for i in train])
    if depths.size == 0:
        problem = "no training frame has a valid depth on tissue."
        raise InputError("clip", problem, "Check the calibration and the mask polarity, or hold out fewer frames.")
    return MEDIAN_DEPTH_UNITS / float(np.median(depths))


def camera_in_units(
    intrinsics: Intrinsics, world_from_camera: NDArray[np.float64], scale: float, side: float = 0.0, dim: float = 0.0
) -> Camera:
    """The rasteriser's camera: the pose inverted and its translation in optimiser units.

    side and dim say what it sees of the gloss (worker/raster/__init__.py).
    """
    camera_from_world: NDArray[np.float64] = np.linalg.inv(world_from_camera).astype(np.float64)
    camera_from_world[:3, 3] *= scale
    k = intrinsics
    return Camera(k.fx, k.fy, k.cx, k.cy, k.width, k.height, camera_from_world, side, dim)


def solid_depth_mm(depth: NDArray[np.float32], alpha: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    """[H, W] camera z in mm of a render: sum(w z) / sum(w) out of optimiser units, 0 where the alpha is too thin."""
    solid = alpha >= COVERED_ALPHA
    return np.where(solid, depth / np.where(solid, alpha, 1) / scale, 0).astype(np.float32)


class TrainingFrames:
    """Colour, tissue, inverse depth and camera of every training frame of one eye."""

    def __init__(self, eye: Eye, train: Sequence[int], scale: float, side: float = 0.0) -> None:
        """side: of the eye's cameras, for the gloss."""
        self.eye, self.indices, self.scale = eye, list(train), scale
        self._row = {index: row for row, index in enumerate(self.indices)}
        height, width = eye.rgb.shape[1:3]
        self._width, stride = width, padded(width)
        count = len(self.indices)
        self._rgb = np.zeros((count, 3, height, stride), np.uint8)
        self._weight = np.zeros((count, height, stride), np.uint8)
        self._inverse_depth = np.zeros((count, height, stride), np.float32)
        self.t = eye.t
        self.cameras = {
            index: camera_vector(camera_in_units(eye.intrinsics, eye.world_from_camera[index], scale, side))
            for index in range(eye.frame_count)
        }
        self._frames: dict[int, TrainingFrame] = {}
        for row, index in enumerate(self.indices):
            tissue, depth_mm = eye.tissue[index], eye.depth_mm[index]
            measured = tissue & (depth_mm > 0)
            self._rgb[row, :, :, :width] = eye.rgb[index].transpose(2, 0, 1)
            self._weight[row, :, :width] = np.where(tissue, np.uint8(255), np.uint8(0))
            np.divide(1 / scale, depth_mm, out=self._inverse_depth[row, :, :width], where=measured)
            target = Target(self._rgb[row].ravel(), self._weight[row].ravel(), self._inverse_depth[row].ravel())
            counts = int(tissue.sum()), int(measured.sum())
            self._frames[index] = TrainingFrame(self.cameras[index], float(self.t[index]), target, *counts)

    def frame(self, index: int) -> TrainingFrame:
        """Frame `index` as a training step needs it: views of the arrays, the same object every time."""
        return self._frames[index]

    def picture(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """The frame itself: rgb [H, W, 3] and tissue [H, W]."""
        row, width = self._row[index], self._width
        return self._rgb[row, :, :, :width].transpose(1, 2, 0), self._weight[row, :, :width] > 0

    def psnr_tissue_db(self, index: int, image: NDArray[np.float32]) -> float:
        """Of a model's render [5, H, W] against frame `index`; NaN without tissue."""
        return psnr_tissue(image[:3].transpose(1, 2, 0), *self.picture(index))

    def digest(self) -> str:
        """SHA-256 of everything that training reads of the eye; equal for two runs on the same frames."""
        found = hashlib.sha256(f"{self.indices} {self.scale!r} {self._rgb.shape}".encode())
        cameras = np.stack([self.cameras[index] for index in self.indices])
        for values in (self._rgb, self._weight, self._inverse_depth, cameras):
            found.update(np.ascontiguousarray(values).data)
        return found.hexdigest()
