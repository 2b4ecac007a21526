"""Scenes in whole numbers, rounded where every number matters the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from intrasplat.scene.compact import Compact
from intrasplat.scene.quantize import Rounding, prepare, rounding
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.deformation import SharedBasis
from intrasplat.splat.layout import VALUES
from intrasplat.train.rate_distortion import RoundedModel

TIMES = tuple(np.arange(6) / 6)


def effect_of(count: int) -> NDArray[np.float64]:
    """Every number of every Gaussian matters the same."""
    return np.ones((VALUES, count))


def shared(scene: TrainedScene) -> SharedBasis:
    assert isinstance(scene.deformation, SharedBasis)
    return scene.deformation


def rounding_of(scene: TrainedScene, step: float = 1e-3, effect: NDArray[np.float64] | None = None) -> Rounding:
    chosen, motion = effect_of(len(scene.gaussians)) if effect is None else effect, shared(scene)
    weight = motion.weight.permute(2, 1, 0).numpy()
    return rounding(prepare(scene.gaussians, motion, weight, scene.seen, chosen, TIMES), step)


def rounded(scene: TrainedScene, step: float = 1e-3, effect: NDArray[np.float64] | None = None) -> Compact:
    return rounding_of(scene, step, effect).compact()


def compacted(scene: TrainedScene, step: float = 1e-3) -> TrainedScene:
    return RoundedModel(rounding_of(scene, step), step, loss_db=0.0, frames=1).stored(scene).scene
