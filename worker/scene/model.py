"""A stored scene as a model that renders."""

from __future__ import annotations

from worker.raster.backend import CPU, Device, make_model
from worker.raster.model import Model
from worker.scene.scene import Scene


def model_of(scene: Scene, device: Device = CPU) -> Model:
    """The scene's Gaussians and their motion in the form that the device renders."""
    size = scene.intrinsics.width, scene.intrinsics.height
    return make_model(scene.gaussians, scene.deformation, *size, device)
