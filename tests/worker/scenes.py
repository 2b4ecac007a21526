"""Small scenes of every kind of deformation, with random numbers in every tensor."""

from __future__ import annotations

import numpy as np
import torch

from worker.evaluate.variants.hexplane import HexPlane
from worker.evaluate.variants.polynomial import PolynomialFourier
from worker.evaluate.variants.quartic import QuarticFdm
from worker.input.camera import Intrinsics
from worker.model.deformation import Deformation, GaussianFdm, SharedBasis
from worker.model.gaussians import Gaussians
from worker.scene.scene import Scene

KINDS = ("fdm-gaussian", "fdm-quartic", "shared", "pfs", "hexplane")
FRAMES = 6


def random_scene(kind: str = "shared", *, count: int = 11, sh_degree: int = 0, seed: int = 0) -> Scene:
    """A scene of `count` Gaussians whose motion is of this kind and not zero."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random)

    gaussians = Gaussians(
        mean=normal(count, 3) + torch.tensor([0.0, 0.0, 60.0]),
        quaternion=normal(count, 4),
        log_scale=normal(count, 3),
        opacity_logit=normal(count),
        sh=normal(count, (sh_degree + 1) ** 2, 3),
    )
    intrinsics = Intrinsics(width=64, height=48, fx=80.0, fy=81.0, cx=31.5, cy=24.25)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(FRAMES)
    return Scene(
        gaussians=gaussians,
        deformation=_deformation(kind, gaussians, random),
        intrinsics=intrinsics,
        world_from_camera=poses,
        frame_times_s=np.arange(FRAMES) / 29.97,
        units_per_mm=60 / 83.7,
        preset="fast",
        trained_t=(0.0, 2 / 6, 1 / 3),
        seen=torch.rand(count, generator=random),
        seed=seed,
        settings={"bases": 9, "rates": {"mean": 1.6e-3}},
    )


def _deformation(kind: str, gaussians: Gaussians, random: torch.Generator) -> Deformation:
    count = len(gaussians)
    weight = 0.1 * torch.randn(count, 10, 5, generator=random)
    if kind.startswith("fdm-"):
        form = QuarticFdm if kind == QuarticFdm.kind else GaussianFdm
        start = form.initial(count, bases=5, width=0.1)
        return form(weight, start.centre, start.width)
    if kind == "shared":
        start_shared = SharedBasis.initial(count, bases=5)
        return SharedBasis(weight, start_shared.centre, start_shared.width)
    if kind == "pfs":
        return PolynomialFourier(weight)
    bounds = torch.stack([gaussians.mean.amin(0), gaussians.mean.amax(0)])
    planes = HexPlane.initial(bounds, seed=1, space_cells=(4, 6), time_cells=3, features=2)
    planes.layers[-1][0].normal_(0, 0.1, generator=random)
    return planes
