"""Levels of detail for renders that must be fast: fewer pixels, and fewer Gaussians.

The time per Gaussian hardly depends on the resolution, so fewer pixels alone are hardly faster.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.gaussians import Gaussians

GROWTH = 0.8
"""The standard deviations grow by GROWTH x sqrt(n) where one of n Gaussians is drawn. With sqrt(n) they would cover as
much as all Gaussians; less is sharper, by 1.0 dB."""


@dataclass(frozen=True)
class Level:
    """A level of coarseness: draw one of `pixels` pixels along each side, and one of `gaussians` Gaussians."""

    pixels: int
    gaussians: int


LEVELS = (Level(1, 1), Level(2, 2), Level(4, 6))
"""From full detail to the coarsest level."""

_thinned: WeakKeyDictionary[TrainedScene, dict[int, TrainedScene]] = WeakKeyDictionary()


def thinned(scene: TrainedScene, one_of: int) -> TrainedScene:
    """The scene with one of `one_of` Gaussians, each larger. The result is cached as long as the scene exists.

    The order of the Gaussians (of pixels in training, of a space-filling curve in a finished scene) puts neighbours in
    space close together, so the remaining ones cover the scene evenly. The tensors are views of the scene's.
    """
    if one_of == 1:
        return scene
    made = _thinned.setdefault(scene, {})
    if one_of not in made:
        left = {name: each[::one_of] for name, each in scene.gaussians.tensors().items()}
        left["log_scale"] = left["log_scale"] + math.log(max(1.0, GROWTH * math.sqrt(one_of)))
        made[one_of] = dataclasses.replace(
            scene,
            gaussians=Gaussians(**left),
            deformation=scene.deformation.select(slice(None, None, one_of)),
            seen=scene.seen[::one_of],
            stored=None,
        )
    return made[one_of]
