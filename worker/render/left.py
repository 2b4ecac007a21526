"""What has left the view: a scene shows its last known state, and trusts that less.

Nobody sees how tissue moves while it is out of view. What the model shows of it is the state in which it was seen last,
or will be seen next.

Symbols: N Gaussians, S sampled frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from worker.input.camera import to_camera
from worker.input.clip import spread
from worker.raster.model import Model
from worker.scene.scene import Scene

SAMPLED_FRAMES = 32
"""Trained frames looked at, evenly spread, for which Gaussians they have in view."""
FADES_IN_S = 0.4
"""After so long out of view, trust has fallen by 1 - 1/e of what it can lose."""
LEFT_TRUST = 0.4
"""Share of the trust that remains of what left the view long ago."""


@dataclass(frozen=True, eq=False)
class OutOfView:
    """When each Gaussian was in the endoscope's view.

    seen_s          [S] seconds of the frames looked at, rising
    before, after   [S + 1, N] seconds of the last of them before each interval, and of the first after it, that has the
                    Gaussian in view; infinite where none has. Interval s ends at frame s.
    """

    seen_s: NDArray[np.float32]
    before: NDArray[np.float32]
    after: NDArray[np.float32]

    @classmethod
    def of(cls, scene: Scene, model: Model) -> Self | None:
        """None if the camera never moves."""
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
        """[N] trust at a time, of values [N] that are trust where they are positive."""
        interval = int(np.searchsorted(self.seen_s, time_s))
        away_s = np.minimum(time_s - self.before[interval], self.after[interval] - time_s)
        away_s -= self._gap_s(interval)
        kept = LEFT_TRUST + (1 - LEFT_TRUST) * np.exp(-np.maximum(away_s, 0) / np.float32(FADES_IN_S))
        return np.where(values > 0, values * kept, values).astype(np.float32)

    def _gap_s(self, interval: int) -> float:
        """The length of an interval: what is in view at either end of it was not away for longer."""
        first, last = max(interval - 1, 0), min(interval, len(self.seen_s) - 1)
        return float(self.seen_s[last] - self.seen_s[first])


def seen_by_endoscope(scene: Scene, model: Model, frame: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """[N] depths of the centres, in mm, before the endoscope at a frame, and whether they lie within its view."""
    points_mm = model.deformed_mean(frame / scene.frame_count).T / np.float32(scene.units_per_mm)
    k, (x, y, z) = scene.intrinsics, to_camera(points_mm, scene.world_from_camera[frame]).T
    ahead = np.maximum(z, 1e-6)
    column, row = k.fx * x / ahead + k.cx, k.fy * y / ahead + k.cy
    return z, np.asarray((z > 0) & (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height))
