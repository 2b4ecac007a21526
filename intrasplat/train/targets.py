"""The training frames as targets of the loss: rows padded to whole vectors, depth in optimiser units.

Symbols: T frames, H W pixels; stride = W rounded up to whole vectors.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip, Eye
from intrasplat.clip.types import PIXELS
from intrasplat.errors import InputError
from intrasplat.splat.camera import Camera
from intrasplat.splat.cpu import padded
from intrasplat.splat.metrics import COVERED_ALPHA, psnr_tissue
from intrasplat.splat.step import Target, TrainingFrame, camera_vector

MEDIAN_DEPTH_UNITS = 60.0
"""The median valid depth of the training frames in optimiser units; the learning rates refer to this unit."""


def units_per_mm(clip: DepthClip, train: Sequence[int]) -> float:
    """Optimiser units per millimetre, from the training frames' valid tissue depths.

    Raises:
        InputError: no training frame has valid depth on tissue.
    """
    sampled = []
    for i in train:
        sampled.append(clip.depth_mm[i][::4, ::4][clip.tissue[i][::4, ::4]])
        clip.let_go(i)
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

    side and dim are its factors of the gloss (intrasplat/splat/camera.py).
    """
    camera_from_world: NDArray[np.float64] = np.linalg.inv(world_from_camera).astype(np.float64)
    camera_from_world[:3, 3] *= scale
    k = intrinsics
    return Camera(k.fx, k.fy, k.cx, k.cy, k.width, k.height, camera_from_world, side, dim)


def solid_depth_mm(depth: NDArray[np.float32], alpha: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    """[H, W] camera z in mm of a render: sum(w z) / sum(w) / scale, 0 where alpha < COVERED_ALPHA."""
    solid = alpha >= COVERED_ALPHA
    return np.where(solid, depth / np.where(solid, alpha, 1) / scale, 0).astype(np.float32)


MIN_DEPTH_MM = np.float32(1e-3)
"""Any number above 0: pixels without depth are masked after the division."""


MAX_RESIDENT_BYTES = 512 << 20
"""An eye whose frames take more memory releases each frame after use, which takes half a millisecond."""


class TrainingFrames:
    """Colour, tissue, inverse depth and camera of every training frame of one eye.

    A frame's target is computed again for every step that uses it. That takes a few hundredths of the step; storing all
    targets would take as much memory as the clip.
    """

    def __init__(self, eye: Eye, train: Sequence[int], scale: float, side: float = 0.0) -> None:
        """scale: optimiser units per millimetre; side: Camera.side of the eye's cameras, for the gloss."""
        self.eye, self.indices, self.scale, self.t = eye, list(train), scale, eye.t
        self.cameras = {
            index: camera_vector(camera_in_units(eye.intrinsics, eye.world_from_camera[index], scale, side))
            for index in range(eye.frame_count)
        }
        self._lets_go = sum(getattr(eye, name).nbytes for name in PIXELS) > MAX_RESIDENT_BYTES
        self._frames = {index: self._frame(index) for index in self.indices}
        self._digest: str | None = None

    def _frame(self, index: int) -> TrainingFrame:
        counts = int(self.eye.tissue[index].sum()), int(_measured(self.eye, index).sum())
        self.eye.let_go(index)
        # A partial instead of a bound method: a reference cycle would keep the eye's files on disk after the job.
        make_target = partial(_target, self.eye, index, self.scale, self._lets_go)
        return TrainingFrame(self.cameras[index], float(self.t[index]), make_target, *counts)

    def frame(self, index: int) -> TrainingFrame:
        """Frame `index` as a training step needs it, the same object every time."""
        return self._frames[index]

    def picture(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """The frame itself: rgb [H, W, 3] and tissue [H, W]. KeyError if it is no training frame."""
        if index not in self._frames:
            raise KeyError(index)
        return self.eye.rgb[index], self.eye.tissue[index]

    def psnr_tissue_db(self, index: int, image: NDArray[np.float32]) -> float:
        """psnr_tissue in dB of a model's render [5, H, W] against frame `index`; NaN without tissue."""
        found = psnr_tissue(image[:3].transpose(1, 2, 0), *self.picture(index))
        if self._lets_go:
            self.eye.let_go(index)
        return found

    def digest(self) -> str:
        """A hash of everything that training reads of the eye; equal for two runs on the same frames.

        CRC-32 of each array is enough to tell frames apart and takes a fraction of the time of SHA-256.
        """
        if self._digest is None:
            found = hashlib.sha256(f"{self.indices} {self.scale!r} {self.eye.rgb.shape}".encode())
            for index in self.indices:
                eye = self.eye
                for values in (eye.rgb[index], eye.tissue[index], eye.depth_mm[index], self.cameras[index]):
                    found.update(zlib.crc32(np.ascontiguousarray(values).data).to_bytes(4, "little"))
                eye.let_go(index)
            self._digest = found.hexdigest()
        return self._digest


def _measured(eye: Eye, index: int) -> NDArray[np.bool_]:
    return np.asarray(eye.tissue[index] & (eye.depth_mm[index] > 0))


def _target(eye: Eye, index: int, scale: float, lets_go: bool) -> Target:
    height, width = eye.tissue.shape[1:]
    rgb = np.zeros((3, height, padded(width)), np.uint8)
    weight, inverse_depth = np.zeros_like(rgb[0]), np.zeros(rgb.shape[1:], np.float32)
    for plane, channel in zip(rgb, cv2.split(eye.rgb[index]), strict=True):
        plane[:, :width] = channel
    np.multiply(eye.tissue[index].view(np.uint8), np.uint8(255), out=weight[:, :width])
    inside = inverse_depth[:, :width]  # dividing everywhere and masking afterwards is faster than a masked division
    np.divide(np.float32(1 / scale), np.maximum(eye.depth_mm[index], MIN_DEPTH_MM), out=inside)
    inside *= _measured(eye, index)
    if lets_go:
        eye.let_go(index)
    return Target(rgb.ravel(), weight.ravel(), inverse_depth.ravel())
