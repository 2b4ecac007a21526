"""What correct.py feeds the kernels: frames of noise, motions that move, and buffers full of NaN."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tests.worker.raster.scenes import SplatScene, pixels_near_a_cut
from worker.evaluate.variants.polynomial import PolynomialFourier
from worker.evaluate.variants.quartic import QuarticFdm
from worker.model.deformation import Deformation, GaussianFdm, SharedBasis
from worker.model.layout import CAMERA
from worker.model.loss import LossSettings, training_loss
from worker.raster import reference
from worker.raster.cpu import padded
from worker.raster.cuda.rasterizer import CudaRasterizer
from worker.raster.step import Target, TrainingFrame
from worker.stereo.matching import MatchPlan

LOSS = LossSettings(depth_weight=20.0, colour_huber_delta=0.05, depth_huber_delta=1e-3)
NOT_BUFFERS = frozenset({"ok", "needed", "_borders", "_camera", "_state", "_opacity_logit"})
"""Of a rasteriser's tensors: what outlives a projection, a constant, and its caller's."""


class Noise:
    """A frame of noise with holes in tissue and depth: for the loss in torch, for a step, and for the rasteriser."""

    def __init__(self, scene: SplatScene, seed: int) -> None:
        random = np.random.default_rng(seed)
        shape = (scene.camera.height, scene.camera.width)
        self._rgb = random.integers(0, 256, (*shape, 3), dtype=np.uint8)
        self._tissue = random.uniform(size=shape) > 0.15
        self._depth = np.where(random.uniform(size=shape) > 0.2, random.uniform(50, 70, shape), 0.0).astype(np.float32)
        self._left_out = pixels_near_a_cut(scene) if len(scene.mean) > 1 else np.zeros(shape, bool)
        self._tissue &= ~self._left_out
        self._inverse = np.where(self._depth > 0, 1 / np.maximum(self._depth, 1), 0).astype(np.float32)
        self._inverse *= self._tissue

    @property
    def on_device(self) -> tuple[Tensor, Tensor, Tensor]:
        """rgb, weight, inverse depth as the rasteriser takes them."""
        rgb = torch.from_numpy(np.ascontiguousarray(self._rgb.transpose(2, 0, 1)))
        return rgb, torch.from_numpy(self._tissue * np.uint8(255)), torch.from_numpy(self._inverse)

    def frame(self, t: float, camera: NDArray[np.float64]) -> TrainingFrame:
        """As a step takes it, its rows padded."""
        height, width = self._tissue.shape
        stride = padded(width)
        rgb, weight = np.zeros((3, height, stride), np.uint8), np.zeros((height, stride), np.uint8)
        inverse = np.zeros((height, stride), np.float32)
        rgb[:, :, :width], weight[:, :width] = self._rgb.transpose(2, 0, 1), self._tissue * np.uint8(255)
        inverse[:, :width] = self._inverse
        target = Target(rgb.ravel(), weight.ravel(), inverse.ravel())
        return TrainingFrame(camera, t, lambda: target, *self._counts)

    @property
    def _counts(self) -> tuple[int, int]:
        return int(self._tissue.sum()), int((self._inverse > 0).sum())

    @property
    def settings(self) -> Tensor:
        """[5] float32, as the blend takes them."""
        frame = self.frame(0.0, np.zeros(CAMERA))
        return torch.from_numpy(frame.loss_settings(LOSS))

    def gradients(self, scene: SplatScene) -> dict[str, Tensor]:
        """Of the loss, in float64, to what the rasteriser takes: log-scales and logits."""
        live = scene.to(torch.float64)
        log_scale, logit = live.scale.log().requires_grad_(), torch.logit(live.opacity).requires_grad_()
        mean, quaternion, colour = (each.clone().requires_grad_() for each in (live.mean, live.quaternion, live.colour))
        seen = reference.rasterize(mean, quaternion, log_scale.exp(), torch.sigmoid(logit), colour, scene.camera)
        true = torch.where(torch.from_numpy(self._inverse > 0), torch.from_numpy(self._depth).double(), 0.0)
        loss = training_loss(
            seen.rgb, seen.depth, seen.alpha, torch.from_numpy(self._rgb) / 255.0, true, torch.from_numpy(self._tissue),
            LOSS,
        )  # fmt: skip
        leaves = {"mean": mean, "quaternion": quaternion, "log-scale": log_scale, "opacity": logit, "colour": colour}
        found = torch.autograd.grad(loss.total, list(leaves.values()))
        return dict(zip(leaves, found, strict=True))


def poison(rasterizer: CudaRasterizer) -> None:
    """Fill every buffer with what no computation may read: NaN, and the largest integer."""
    held = {name: each for name, each in vars(rasterizer).items() if name not in NOT_BUFFERS}
    for each in [*held.values(), *vars(rasterizer.gradients).values()]:
        if isinstance(each, Tensor):
            each.fill_(float("nan") if each.is_floating_point() else torch.iinfo(each.dtype).max)


def stirred_motion(kind: str, count: int, random: torch.Generator) -> Deformation:
    """A deformation of this kind that moves."""

    def stirred(tensor: Tensor) -> Tensor:
        return tensor + 0.05 * torch.randn(tensor.shape, generator=random)

    if kind.startswith("fdm"):
        form = QuarticFdm if kind == QuarticFdm.kind else GaussianFdm
        fdm = form.initial(count, bases=3, width=0.3)
        return form(*(stirred(each) for each in fdm.parameters().values()))
    if kind == "pfs":
        polynomial = PolynomialFourier.initial(count, weights=6)
        return dataclasses.replace(polynomial, weight=stirred(polynomial.weight))
    shared = SharedBasis.initial(count, bases=5, colour=True)
    return dataclasses.replace(shared, weight=stirred(shared.weight))


def stereo_pairs(
    count: int, width: int, height: int, seed: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32], MatchPlan]:
    """Left and right [F, H, W] of textured planes, their disparity [H, W] in px, and where to look for it."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    near, far = 0.09 * width, 0.04 * width
    disparity = far + (near - far) * (0.4 * x / width + 0.6 * y / height)
    beyond = int(near) + 2
    left, right = (np.zeros((count, height, width), np.uint8) for _ in range(2))
    for k in range(count):
        drawn = np.full((height, width + 2 * beyond), 110.0, np.float32)
        for sigma_px, contrast in ((1.2, 18.0), (3.0, 15.0), (10.0, 25.0)):
            layer = cv2.GaussianBlur(random.standard_normal(drawn.shape).astype(np.float32), (0, 0), sigma_px)
            drawn += contrast * layer / layer.std()
        for eye, at in ((left, x + beyond - disparity), (right, x + beyond)):
            eye[k] = np.clip(cv2.remap(drawn, at, y, cv2.INTER_CUBIC), 0, 255).round()
    return left, right, disparity, MatchPlan(far - 2, near + 2)
