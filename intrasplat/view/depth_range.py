"""The depth range of a scene's false colours, the same for the whole clip, so that nothing flickers.

Symbols: N Gaussians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import to_camera
from intrasplat.clip import spread
from intrasplat.picture import check_depth_ends
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.model import Model
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from intrasplat.view.out_of_view import seen_by_endoscope

SAMPLED_FRAMES = 8
"""Number of trained frames that are sampled, evenly spread."""
PERCENTILES = (5.0, 95.0)
"""Percentiles of the Gaussians' depths that bound the range, so that what is much nearer or farther, such as the edge
of an organ, does not flatten the rest of the picture."""


@dataclass(frozen=True)
class DepthRange:
    """Depth range before the endoscope in whole mm, and the clip's median depth, which orbits rotate about."""

    near_mm: float
    far_mm: float
    median_mm: float

    @classmethod
    def of(cls, scene: TrainedScene, model: Model) -> Self:
        frames = spread(scene.trained_frames, SAMPLED_FRAMES)
        counts = scene.seen.numpy() > 0 if bool(scene.seen.any()) else np.ones(len(scene.gaussians), np.bool_)
        seen = (seen_by_endoscope(scene, model, frame) for frame in frames)
        depths_mm = np.concatenate([z_mm[in_view & counts] for z_mm, in_view in seen])
        median_mm = MEDIAN_DEPTH_UNITS / scene.units_per_mm
        near_mm, far_mm = np.percentile(depths_mm, PERCENTILES) if len(depths_mm) else (median_mm, median_mm)
        near_mm = math.floor(near_mm)
        return cls(near_mm, max(math.ceil(far_mm), near_mm + 1), median_mm)

    def before(self, world_from_camera: NDArray[np.float64] | None) -> tuple[float, float]:
        """Nearest and farthest depth in mm before a camera [4, 4] mm: the endoscope's range, shifted by as much as the
        middle of the tissue is nearer or farther. None: the endoscope itself.
        """
        if world_from_camera is None:
            return self.near_mm, self.far_mm
        middle_mm = to_camera(np.array([[0.0, 0.0, self.median_mm]]), world_from_camera)[0, 2]
        moved_mm = round(float(middle_mm) - self.median_mm)
        return self.near_mm + moved_mm, self.far_mm + moved_mm

    def chosen(
        self, world_from_camera: NDArray[np.float64] | None, near_mm: float | None, far_mm: float | None
    ) -> tuple[float, float]:
        """As before(), with the ends that a caller chooses; None: that of the range.

        Raises:
            InputError: the far end is not beyond the near one.
        """
        own_near_mm, own_far_mm = self.before(world_from_camera)
        near_mm, far_mm = own_near_mm if near_mm is None else near_mm, own_far_mm if far_mm is None else far_mm
        check_depth_ends(near_mm, far_mm)
        return near_mm, far_mm
