"""The light in which the endoscope recorded a moment, as factors of the model's even and steady light.

Symbols: H W pixels, h of H rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.motion.vignetting import rays
from intrasplat.scene.scene import TrainedScene
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from intrasplat.view.camera import endoscope_pose


@dataclass(frozen=True, eq=False)
class EndoscopeLight:
    """The light of model time t for a view from a pose [4, 4] mm through a lens."""

    scene: TrainedScene
    t: float
    world_from_camera: NDArray[np.float64]
    lens: Intrinsics

    def factors(self, depth_mm: NDArray[np.float32], rows: slice = slice(None)) -> NDArray[np.float32] | None:
        """Factors of R G B, [3] or [h, W, 3], of rows whose depth is depth_mm [h, W]; None: all are 1.

        A pixel is as bright as the endoscope recorded the place that it shows. A pixel without depth (0) counts as at
        the clip's median depth.
        """
        gains, vignetting = self.scene.gains(self.t), self.scene.vignetting
        if vignetting is None:
            return gains
        far_mm = np.where(depth_mm > 0, depth_mm, MEDIAN_DEPTH_UNITS / self.scene.units_per_mm)
        eye_from_camera = np.linalg.inv(self._eye()) @ self.world_from_camera
        places_mm = rays(self.lens, rows) * far_mm[..., None]
        seen = vignetting.brightness(places_mm @ eye_from_camera[:3, :3].T + eye_from_camera[:3, 3])[..., None]
        return seen if gains is None else seen * gains

    def _eye(self) -> NDArray[np.float64]:
        """world_from_camera of the eye whose pictures the view is compared with: the nearest."""
        left, right_mm = endoscope_pose(self.scene, self.t), self.scene.right_eye_mm
        if right_mm is None:
            return left
        right = left.copy()
        right[:3, 3] += left[:3, :3] @ np.array(right_mm)
        apart_mm = [float(np.linalg.norm(eye[:3, 3] - self.world_from_camera[:3, 3])) for eye in (left, right)]
        return left if apart_mm[0] <= apart_mm[1] else right
