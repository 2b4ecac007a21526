"""Compile every kernel before the first clip, so that no job waits for it."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch

from intrasplat.splat.camera import Camera
from intrasplat.splat.cpu.model import CpuModel
from intrasplat.splat.cpu.rasterizer import padded
from intrasplat.splat.deformation import Deformation, GaussianFdm, SharedBasis
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.optimize import StepRates
from intrasplat.splat.step import Target, TrainingFrame, camera_vector

_COUNT, _WIDTH, _HEIGHT = 8, 16, 16
_RATES = StepRates(*[1e-3] * 13)


def compile_kernels(on_progress: Callable[[float], None] = lambda share: None) -> float:
    """Compile the kernels of every preset for this processor, or load them from the cache; returns seconds.

    It makes tiny steps and renders with every kind of motion and colour, and the unfused gradients. So every kernel is
    compiled for the types of arrays that it is called with. A second call takes little time.

    Args:
        on_progress: called with the share done, in (0, 1], after each of a few parts of different length.
    """
    start = time.perf_counter()
    camera = camera_vector(Camera(20.0, 20.0, 8.0, 8.0, _WIDTH, _HEIGHT, np.eye(4)))
    motions: list[tuple[Deformation, int]] = [
        (SharedBasis.initial(_COUNT, bases=2, colour=True), 0),
        (GaussianFdm.initial(_COUNT, bases=2), 3),
    ]
    models = [CpuModel(_gaussians(degree), motion, _WIDTH, _HEIGHT) for motion, degree in motions]
    parts: list[Callable[[], object]] = [
        lambda: models[0].project(camera, 0.5, 0),
        lambda: models[0].render(camera, 0.5),
        lambda: _step(models[0], camera, 0),
        lambda: models[0].rasterizer.cotangent_backward(np.zeros((5, _HEIGHT, _WIDTH), np.float32)),
        lambda: models[1].render(camera, 0.5),
        lambda: _step(models[1], camera, 3),
    ]
    for done, part in enumerate(parts, start=1):
        part()
        on_progress(done / len(parts))
    return time.perf_counter() - start


def _gaussians(sh_degree: int) -> Gaussians:
    """A few Gaussians in front of the camera."""
    return Gaussians(
        mean=torch.tensor([[0.0, 0.0, 60.0]]).repeat(_COUNT, 1),
        quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(_COUNT, 1),
        log_scale=torch.ones(_COUNT, 3),
        opacity_logit=torch.zeros(_COUNT),
        sh=torch.zeros(_COUNT, (sh_degree + 1) ** 2, 3),
    )


def _step(model: CpuModel, camera: np.ndarray, sh_degree: int) -> None:
    pixels = _HEIGHT * padded(_WIDTH)
    weight, inverse_depth = np.full(pixels, 255, np.uint8), np.full(pixels, 1 / 60, np.float32)
    target = Target(np.zeros(3 * pixels, np.uint8), weight, inverse_depth)
    frame = TrainingFrame(camera, 0.5, lambda: target, pixels, pixels)
    model.step([frame], LossSettings(), _RATES, 1, sh_degree)
