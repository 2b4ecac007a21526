"""The inputs and results of a training step, for every device.

Symbols: H W pixels; stride = W rounded up to whole vectors of the CPU's kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from intrasplat.splat.camera import Camera
from intrasplat.splat.layout import HEIGHT, POSE, WIDTH
from intrasplat.splat.loss import LossSettings


def camera_vector(camera: Camera) -> NDArray[np.float64]:
    """[CAMERA] float64: the camera as the kernels read it (intrasplat/splat/layout.py)."""
    given = camera.camera_from_world
    matrix = given.detach().double().cpu().numpy() if isinstance(given, torch.Tensor) else given
    pose = np.asarray(matrix, np.float64)[:3].ravel()
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
    return np.concatenate([intrinsics, [camera.side, camera.dim], camera.enlarged, camera.recorded_depth, pose])


def image_size(camera: NDArray[np.float64]) -> tuple[int, int]:
    """W, H of a camera vector."""
    return int(camera[WIDTH]), int(camera[HEIGHT])


def camera_centre(camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3] world position of the camera of a camera vector, units."""
    pose = camera[POSE:].reshape(3, 4)
    return np.asarray(-pose[:, :3].T @ pose[:, 3])


@dataclass(frozen=True, eq=False)
class Target:
    """The frame that a render is compared with, its rows padded to the stride."""

    rgb: NDArray[np.uint8]  # [3 * H * stride]
    weight: NDArray[np.uint8]  # [H * stride], 255 = tissue
    inverse_depth: NDArray[np.float32]  # [H * stride], 1 / units, 0 = none


@dataclass(frozen=True, eq=False)
class TrainingFrame:
    """One frame to train on. It equals only itself, so a device may cache its copy of the target by the object.

    camera           camera_vector, in optimiser units
    t                model time
    make_target      computes the target, on the host
    tissue_pixels    how many pixels are tissue
    measured_pixels  how many of those have a depth
    """

    camera: NDArray[np.float64]
    t: float
    make_target: Callable[[], Target]
    tissue_pixels: int
    measured_pixels: int

    @property
    def target(self) -> Target:
        """The target, computed again at each access."""
        return self.make_target()

    def loss_settings(self, loss: LossSettings) -> NDArray[np.float32]:
        """[5] the factors of the blend (cpu/blend.py, _loss): each loss is a mean over its valid pixels."""
        return np.array(
            [
                loss.colour_weight / (3 * max(self.tissue_pixels, 1)),
                loss.depth_weight / max(self.measured_pixels, 1),
                1 / max(loss.colour_huber_delta, 1e-30),
                1 / max(loss.depth_huber_delta, 1e-30),
                float(loss.normalised_depth),
            ],
            np.float32,
        )


@dataclass(frozen=True)
class StepSums:
    """Sums over the tissue pixels, before the update, of the steps since the last StepSums; on the CPU of one step.

    visible  Gaussians in view of any frame of a step; the least of several steps
    """

    colour_l1: float
    depth_l1: float
    squared_error: float
    holes: float
    visible: int
