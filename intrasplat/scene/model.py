"""A stored scene as a model that renders."""

from __future__ import annotations

from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.backend import CPU, Device, make_model
from intrasplat.splat.model import Model


def model_of(scene: TrainedScene, device: Device = CPU) -> Model:
    """The scene's Gaussians and their motion in the form that the device renders."""
    size = scene.intrinsics.width, scene.intrinsics.height
    return make_model(scene.gaussians, scene.deformation, *size, device)
