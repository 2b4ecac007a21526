"""Run as a program: compile, then train and render in every way, and say whether that compiled anything more.

Prints the shares of progress that compile_kernels told, and the kernels that were compiled only later.
"""

from __future__ import annotations

import importlib
import json
from functools import partial

import numpy as np
import torch
from numba.core.dispatcher import Dispatcher

from worker.evaluate.variants.polynomial import PolynomialFourier
from worker.evaluate.variants.quartic import QuarticFdm
from worker.model.deformation import Deformation, GaussianFdm, SharedBasis
from worker.model.gaussians import Gaussians
from worker.model.loss import LossSettings
from worker.model.optimize import StepRates
from worker.raster import Camera
from worker.raster.cpu import compile_kernels, rasterize
from worker.raster.cpu.model import CpuModel
from worker.raster.step import Target, TrainingFrame, camera_vector

COUNT, WIDTH, HEIGHT = 50, 37, 35


def compiled() -> dict[str, int]:
    """How many forms of each kernel there are in this process."""
    modules = [importlib.import_module(f"worker.raster.cpu.{name}") for name in ("project", "bins", "blend", "update")]
    modules.append(importlib.import_module("worker.raster.cpu.harmonics"))
    found = {name: value for module in modules for name, value in vars(module).items() if isinstance(value, Dispatcher)}
    return {name: len(kernel.overloads) for name, kernel in found.items()}


def gaussians(sh_degree: int) -> Gaussians:
    random = torch.Generator().manual_seed(1)
    spread = torch.tensor([20.0, 20.0, 5.0])
    return Gaussians(
        mean=(torch.rand(COUNT, 3, generator=random) - 0.5) * spread + torch.tensor([0.0, 0.0, 60.0]),
        quaternion=torch.randn(COUNT, 4, generator=random),
        log_scale=torch.zeros(COUNT, 3),
        opacity_logit=torch.zeros(COUNT),
        sh=torch.randn(COUNT, (sh_degree + 1) ** 2, 3, generator=random),
    )


def use_everything() -> None:
    """What the presets call: fused steps and renders of every motion, densification's take, the rivals' autograd."""
    view = Camera(80.0, 80.0, 18.0, 17.0, WIDTH, HEIGHT, np.eye(4))
    camera = camera_vector(view)
    motions: list[tuple[Deformation, int]] = [
        (SharedBasis.initial(COUNT, bases=3), 0),
        (SharedBasis.initial(COUNT, bases=3, colour=True), 0),
        (PolynomialFourier.initial(COUNT), 3),
        (GaussianFdm.initial(COUNT), 3),
        (QuarticFdm.initial(COUNT), 2),
    ]
    for motion, degree in motions:
        model = CpuModel(gaussians(degree), motion, WIDTH, HEIGHT)
        pixels = HEIGHT * model.rasterizer.stride
        rgb, weight = np.full(3 * pixels, 100, np.uint8), np.full(pixels, 255, np.uint8)
        inverse = np.ones(pixels, np.float32)
        for iteration in range(1, 5):
            frame = TrainingFrame(camera, 0.3 * iteration % 1, partial(Target, rgb, weight, inverse), pixels, pixels)
            loss = LossSettings(normalised_depth=bool(iteration % 2))
            model.step([frame], loss, StepRates(*[1e-3] * 13), iteration, min(degree, iteration - 1))
            model.take(np.arange(model.count)[::-1].copy(), np.zeros(model.count, np.bool_))
        model.render(camera, 0.4)
    one = gaussians(0)
    mean = one.mean.requires_grad_()
    rendered = rasterize(mean, one.quaternion, one.scale, one.opacity, one.sh[:, 0], view)
    torch.autograd.grad((rendered.rgb.sum() + rendered.depth.sum()), [mean])


def main() -> None:
    shares: list[float] = []
    compile_kernels(shares.append)
    before = compiled()
    use_everything()
    later = [name for name, forms in compiled().items() if forms != before[name]]
    print(json.dumps({"shares": shares, "later": later}))


if __name__ == "__main__":
    main()
