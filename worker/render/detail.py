"""Levels of detail for pictures that somebody waits for while there is no time: fewer pixels, and fewer Gaussians.

Each Gaussian takes its time at any resolution, so fewer pixels alone are hardly faster.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from worker.model.gaussians import Gaussians
from worker.scene.scene import Scene

GROWTH = 0.8
"""The standard deviations grow by this x sqrt(n) where one of n Gaussians is left. By sqrt(n) they would cover as much
as all did; less is sharper, by 1.0 dB."""


@dataclass(frozen=True)
class Detail:
    """What is drawn: one of `pixels` in a row and in a column, and one of `gaussians`."""

    pixels: int
    gaussians: int


LEVELS = (Detail(1, 1), Detail(2, 2), Detail(4, 6))
"""From all to the coarsest."""

_thinned: WeakKeyDictionary[Scene, dict[int, Scene]] = WeakKeyDictionary()


def thinned(scene: Scene, one_of: int) -> Scene:
    """The scene with one of so many Gaussians, each larger; it is made once, and kept as long as the scene is.

    Neighbours in space are close in the order of the Gaussians, of pixels in training and of a space-filling curve in a
    finished scene, so those that are left cover all evenly. The
    tensors are views of the scene's.
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
