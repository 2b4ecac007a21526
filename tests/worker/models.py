"""A small tissue-like wall of Gaussians, frames to train it on, and rates, for tests that take training steps.

Symbols: N Gaussians, H W pixels. Lengths in optimiser units.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from worker.evaluate.variants.hexplane import HexPlane
from worker.model.deformation import GaussianFdm, SharedBasis
from worker.model.gaussians import Gaussians, initial_gaussians
from worker.model.loss import LossSettings
from worker.model.optimize import StepRates
from worker.raster import Camera
from worker.raster.cpu import padded
from worker.raster.cpu.model import CpuModel
from worker.raster.model import Model
from worker.raster.step import StepSums, Target, TrainingFrame, camera_vector

WIDTH, HEIGHT = 64, 48
RATES = StepRates(
    mean=2e-3,
    quaternion=3e-3,
    log_scale=4e-3,
    opacity=5e-3,
    colour=6e-3,
    gloss=8e-3,
    sh_rest=1e-3,
    motion_mean=7e-3,
    motion_quaternion=7e-3,
    motion_log_scale=7e-3,
    motion_colour=7e-3,
    motion_gloss=7e-3,
    eps=1e-15,
)
"""Motion has one rate for all its channels, as a deformation without kernels of its own needs."""
PAPER = LossSettings(normalised_depth=False)
NORMALISED = LossSettings(depth_weight=20.0, colour_huber_delta=0.02, depth_huber_delta=1e-3)


@dataclass(frozen=True, eq=False)
class Picture:
    """rgb [H, W, 3] uint8, tissue [H, W] bool, depth [H, W] in units, 0 = invalid; seen at time t."""

    t: float
    rgb: NDArray[np.uint8]
    tissue: NDArray[np.bool_]
    depth: NDArray[np.float32]

    def target(self) -> Target:
        """As the kernels read it: padded to whole vectors."""
        columns = ((0, 0), (0, padded(WIDTH) - WIDTH))
        inverse = np.divide(1, self.depth, out=np.zeros_like(self.depth), where=self.depth > 0)
        return Target(
            rgb=np.pad(self.rgb.transpose(2, 0, 1), ((0, 0), *columns)).ravel(),
            weight=np.pad(self.tissue.astype(np.uint8) * 255, columns).ravel(),
            inverse_depth=np.pad(inverse, columns).ravel(),
        )

    def seen_from(self, camera: NDArray[np.float64]) -> TrainingFrame:
        """As a step takes it."""
        measured = self.tissue & (self.depth > 0)
        return TrainingFrame(camera, self.t, self.target, int(self.tissue.sum()), int(measured.sum()))


def endoscope(sideways: float = 0.0) -> Camera:
    """A camera that looks along z, moved sideways by so many units."""
    pose = np.eye(4)
    pose[0, 3] = -sideways
    return Camera(0.9 * WIDTH, 0.95 * WIDTH, 0.49 * WIDTH, 0.52 * HEIGHT, WIDTH, HEIGHT, pose)


def wall(*, stride: int = 3, sh_degree: int = 0, opacity: float = 0.6, seed: int = 0) -> Gaussians:
    """Gaussians on a bent surface 60 units away, one for every stride-th pixel and a margin, of smooth colours."""
    random = np.random.default_rng(seed)
    i, j = np.mgrid[-4 : HEIGHT + 4 : stride, -4 : WIDTH + 4 : stride].reshape(2, -1) + 0.5
    camera = endoscope()
    z = 60 + 3 * np.sin(j / 11) + 2 * np.cos(i / 9)
    points = np.stack([(j - camera.cx) / camera.fx * z, (i - camera.cy) / camera.fy * z, z], axis=1)
    rgb = 0.5 + 0.3 * np.stack([np.sin(j / 13), np.cos(i / 7), np.sin((i + j) / 17)], axis=1)
    start = initial_gaussians(points, rgb, sh_degree=sh_degree, opacity=opacity)
    turned = start.quaternion + torch.tensor(random.normal(0, 0.3, (len(points), 4)), dtype=torch.float32)
    stretched = start.log_scale + torch.tensor(random.normal(0, 0.3, (len(points), 3)), dtype=torch.float32)
    return dataclasses.replace(start, quaternion=turned, log_scale=stretched)


def training_frames(count: int = 3, *, seed: int = 1) -> list[Picture]:
    """Frames of something else than the wall: noise, with holes in tissue and depth."""
    random = np.random.default_rng(seed)
    frames = []
    for k in range(count):
        coarse = random.integers(0, 256, (HEIGHT // 4, WIDTH // 4, 3), dtype=np.uint8)
        depth = random.uniform(50, 70, (HEIGHT, WIDTH)) * (random.uniform(size=(HEIGHT, WIDTH)) > 0.2)
        frames.append(
            Picture(
                t=0.3 + 0.4 * k / count,
                rgb=coarse.repeat(4, 0).repeat(4, 1),
                tissue=random.uniform(size=(HEIGHT, WIDTH)) > 0.15,
                depth=depth.astype(np.float32),
            )
        )
    return frames


def frame_of(gaussians: Gaussians, t: float) -> Picture:
    """The frame that shows exactly these Gaussians at time t, with their depth where they are solid."""
    still = SharedBasis.initial(len(gaussians), bases=1)
    red, green, blue, summed, alpha = CpuModel(gaussians, still, WIDTH, HEIGHT).render(camera_vector(endoscope()), t)
    rgb = np.clip(np.stack([red, green, blue], axis=-1) * 255, 0, 255).round().astype(np.uint8)
    solid = alpha > 0.5
    depth = np.where(solid, summed / np.where(solid, alpha, 1), 0).astype(np.float32)
    return Picture(t, rgb, np.ones((HEIGHT, WIDTH), bool), depth)


def moving_hexplane(gaussians: Gaussians) -> HexPlane:
    """A small field of offsets that is not zero."""
    bounds = torch.stack([gaussians.mean.amin(0), gaussians.mean.amax(0)])
    field = HexPlane.initial(bounds, seed=2, space_cells=(5, 9), time_cells=4, features=3)
    random = torch.Generator().manual_seed(3)
    for name, each in field.parameters().items():
        if name.startswith("plane") and name.endswith("t"):
            each.add_(0.3 * torch.randn(each.shape, generator=random))
    field.layers[-1][0].normal_(0, 0.05, generator=random)
    return field


def moving_shared(gaussians: Gaussians) -> SharedBasis:
    """Three bases, all of them alive at every frame's time."""
    start = SharedBasis.initial(len(gaussians), bases=3, colour=True)
    weight = 0.1 * torch.randn(start.weight.shape, generator=torch.Generator().manual_seed(4))
    return dataclasses.replace(start, weight=weight)


def moving_fdm(gaussians: Gaussians) -> GaussianFdm:
    """Wide bases of every Gaussian's own."""
    start = GaussianFdm.initial(len(gaussians), bases=4, width=0.3)
    weight = 0.1 * torch.randn(start.weight.shape, generator=torch.Generator().manual_seed(5))
    return dataclasses.replace(start, weight=weight)


def take_steps(
    model: Model,
    frames: list[Picture],
    *,
    loss: LossSettings = PAPER,
    rates: StepRates = RATES,
    first: int = 1,
    sh_degree: int = 0,
    camera: Camera | None = None,
) -> list[StepSums]:
    """One step on every frame, iterations counted from first."""
    seen_from = camera_vector(camera or endoscope())
    sums = [
        model.step([each.seen_from(seen_from)], loss, rates, iteration, sh_degree)
        for iteration, each in enumerate(frames, start=first)
    ]
    return [each for each in sums if each is not None]
