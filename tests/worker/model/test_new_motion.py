"""A motion from outside the tree: one call of register_motion, and it trains, is stored, loaded and rendered."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from contract.wire.options import ReconstructionOptions
from tests.worker.phantoms import phantom_clip
from worker.methods.method import DensifySettings
from worker.methods.registry import PRESETS
from worker.model.deformation import AtRest, Deformation, LinearDeformation, add_offsets, register_motion
from worker.model.gaussians import Gaussians
from worker.model.layout import CHANNELS
from worker.pipeline import reconstruct
from worker.render.view import render_frame
from worker.scene.checkpoint import load_scene
from worker.train.hooks import TrainingHooks
from worker.train.request import ReconstructionRequest


@dataclass(frozen=True, eq=False)
class ConstantVelocity(Deformation):
    """mean(t) = mean + velocity t, trained by torch.

    velocity [N, 3]  units a clip
    """

    velocity: Tensor

    kind = "constant-velocity"
    min_bases = 0

    @classmethod
    def at_rest(cls, gaussians: Gaussians, start: AtRest) -> ConstantVelocity:
        return cls(torch.zeros_like(gaussians.mean))

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        still = self.velocity.new_zeros(len(gaussians), CHANNELS - 3)
        return add_offsets(gaussians, torch.cat([self.velocity * t, still], dim=1))

    def parameters(self) -> dict[str, Tensor]:
        return {"velocity": self.velocity}

    def select(self, rows: Tensor) -> ConstantVelocity:
        return ConstantVelocity(self.velocity[rows])


@dataclass(frozen=True, eq=False)
class LinearDrift(LinearDeformation):
    """psi(t) = weight t, every channel; by the kernels, for it is linear."""

    kind = "linear-drift"

    @classmethod
    def at_rest(cls, gaussians: Gaussians, start: AtRest) -> LinearDrift:
        return cls(torch.zeros(len(gaussians), CHANNELS, 1))

    def basis(self, t: float) -> Tensor:
        return torch.tensor([t])


@pytest.mark.parametrize("motion", [ConstantVelocity, LinearDrift], ids=lambda motion: motion.kind)
def test_a_motion_from_outside_is_trained_stored_loaded_and_rendered(motion: type[Deformation], tmp_path: Path) -> None:
    register_motion(motion)
    clip = phantom_clip()
    preset = dataclasses.replace(
        PRESETS["paper"],
        name=motion.kind,
        deformation=motion.kind,
        bases=1,
        # new Gaussians within the run, so that the motion is asked for more rows
        densify=DensifySettings(from_iteration=5, every=5),
    )
    request = ReconstructionRequest(clip, ReconstructionOptions(iterations=12), own_preset=preset, device="cpu")
    report = reconstruct(request, tmp_path, TrainingHooks())
    scene = load_scene(tmp_path)
    assert type(scene.deformation) is motion
    assert scene.preset == report.preset == motion.kind
    assert all(bool(each.any()) for each in scene.deformation.parameters().values()), "nothing has moved"
    moved = [scene.deformation.deform(scene.gaussians, t) for t in (0.0, 0.9)]
    assert torch.equal(moved[0].mean, scene.gaussians.mean)
    assert not torch.equal(moved[1].mean, scene.gaussians.mean)
    image = render_frame(scene, 0.9).rgb
    assert np.isfinite(image).all()
    assert image.any()
