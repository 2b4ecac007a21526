"""A scene that looks like a surface: a bent sheet of two colours."""

from __future__ import annotations

import dataclasses

import torch

from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.gaussians import Gaussians, sh_from_rgb
from tests.intrasplat.scenes import random_scene

SIDE = 60


def tissue() -> TrainedScene:
    """A bent sheet of red and green tissue 60 units before the camera that moves towards it, and a speck before it."""
    base = random_scene()
    across, down = torch.meshgrid(torch.linspace(-30, 30, SIDE), torch.linspace(-25, 25, SIDE), indexing="ij")
    x, y = across.ravel(), down.ravel()
    mean = torch.stack([x, y, 60 + 0.006 * (x * x + y * y)], dim=1)
    mean = torch.cat([mean, torch.tensor([[0.0, 0.0, 30.0]])])
    count = len(mean)
    rgb = torch.full((count, 3), 0.2)
    rgb[:, 0] += 0.6 * (mean[:, 0] > 0)
    rgb[:, 1] += 0.6 * (mean[:, 0] <= 0)
    size = torch.full((count, 3), 0.9)
    size[:, 2], size[-1] = 0.05, 0.2
    gaussians = Gaussians(
        mean=mean,
        quaternion=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        log_scale=size.log(),
        opacity_logit=torch.full((count,), 4.0),
        sh=sh_from_rgb(rgb)[:, None],
    )
    start = SharedBasis.initial(count, bases=5)
    weight = torch.zeros(count, *start.weight.shape[1:])
    weight[:, 2] = 1.0  # z
    return dataclasses.replace(
        base,
        gaussians=gaussians,
        deformation=SharedBasis(weight, start.centre, start.width),
        seen=torch.full((count,), 0.9),
    )
