"""Reduce the trust in tissue that is out of the endoscope's view.

Nobody sees how tissue moves while it is out of view. The model shows the state in which it was seen last, or will be
seen next.

Symbols: N Gaussians, S sampled frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import to_camera
from intrasplat.clip import spread
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.model import Model

SAMPLED_FRAMES = 32
"""Number of trained frames, evenly spread, that are checked for the Gaussians in view."""
FADES_IN_S = 0.4
"""Time constant out of view: by then trust has lost 1 - 1/e of what it can lose."""
REMAINING_TRUST = 0.4
"""Share of the trust that remains after a long time out of view."""


@dataclass(frozen=True, eq=False)
class OutOfView:
    """When each Gaussian was in the endoscope's view.

    seen_s          [S] seconds of the sampled frames, rising
    before, after   [S + 1, N] seconds of the last sampled frame before each interval, and of the first one after it,
                    with the Gaussian in view; infinite where there is none. Interval s ends at frame s.
    """

    seen_s: NDArray[np.float32]
    before: NDArray[np.float32]
    after: NDArray[np.float32]

    @classmethod
    def of(cls, scene: TrainedScene, model: Model) -> Self | None:
        """Find out when each Gaussian of a scene was in view; None if the camera never moves."""
        if (scene.world_from_camera == scene.world_from_camera[0]).all():
            return None
        frames = spread(scene.trained_frames, SAMPLED_FRAMES)
        seen_s = np.array([scene.frame_times_s[frame] for frame in frames], np.float32)
        in_view = np.stack([seen_by_endoscope(scene, model, frame)[1] for frame in frames])
        nothing = np.full((1, in_view.shape[1]), np.inf, np.float32)
        known = np.where(in_view, seen_s[:, None], np.float32(np.nan))
        before = np.fmax.accumulate(np.concatenate([-nothing, known]))
        after = np.fmin.accumulate(np.concatenate([known, nothing])[::-1])[::-1]
        return cls(seen_s, before, after)

    def faded(self, values: NDArray[np.float32], time_s: float) -> NDArray[np.float32]:
        """[N] values at a time, from values [N] whose positive entries are trust: those are reduced."""
        interval = int(np.searchsorted(self.seen_s, time_s))
        away_s = np.minimum(time_s - self.before[interval], self.after[interval] - time_s)
        away_s -= self._gap_s(interval)
        remaining = REMAINING_TRUST + (1 - REMAINING_TRUST) * np.exp(-np.maximum(away_s, 0) / np.float32(FADES_IN_S))
        return np.where(values > 0, values * remaining, values).astype(np.float32)

    def _gap_s(self, interval: int) -> float:
        """The length of an interval: a Gaussian in view at either end was not out of view for longer."""
        first, last = max(interval - 1, 0), min(interval, len(self.seen_s) - 1)
        return float(self.seen_s[last] - self.seen_s[first])


def seen_by_endoscope(scene: TrainedScene, model: Model, frame: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """[N] depths of the Gaussians' centres before the endoscope at a frame, in mm, and whether they are in its view."""
    points_mm = model.deformed_mean(frame / scene.frame_count).T / np.float32(scene.units_per_mm)
    k, (x, y, z) = scene.intrinsics, to_camera(points_mm, scene.world_from_camera[frame]).T
    ahead = np.maximum(z, 1e-6)
    column, row = k.fx * x / ahead + k.cx, k.fy * y / ahead + k.cy
    return z, np.asarray((z > 0) & (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height))
