"""How tissue moved from one used frame to the next: optical flow, lifted to 3D by stereo depth, as tracks start a clip.

Symbols: N Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.motion.lifted import CoarseFrame, Flows, PointGrid, lifted
from intrasplat.motion.tracks import FLOW_WIDTH, MIN_GRID_SIDE
from intrasplat.splat.constants import SH_C0

Floats = NDArray[np.float32]
NOISE_PX, DEPTH_NOISE_PX = 0.2, 0.3
"""Motion across the view, and change of disparity, in px of the coarse grid, that are as likely noise as motion."""
COLOUR_NOISE = 3 / 255
"""Change of a cell's colour, in [0, 1], from the model's last picture to the next frame that is as likely noise."""
MAX_OFF = 0.2
"""Relative difference of depth from which on the model shows something else than the recorded frame, and a Gaussian is
not part of the surface that flow follows."""


class FlowStart:
    """Follows tissue from each frame to the next one."""

    def __init__(self, first: DepthClip) -> None:
        camera = first.intrinsics
        least = max(1, min(camera.width, camera.height) // MIN_GRID_SIDE)
        self._grid = PointGrid(first, min(-(-camera.width // FLOW_WIDTH), least))
        self._last = CoarseFrame(first, 0, self._grid)
        self._focal = camera.fx / self._grid.step
        assert first.right is not None
        baseline_mm = np.linalg.norm(first.right.world_from_camera[0, :3, 3] - first.world_from_camera[0, :3, 3])
        self._focal_baseline = self._focal * float(baseline_mm)

    def _beyond_noise(self, displacement_mm: Floats, start: CoarseFrame) -> Floats:
        """The displacement [h, w, 3], less where it is as small as the errors of flow and of stereo."""
        camera, z = displacement_mm @ start.axes, np.maximum(start.depth_mm, 1e-3)
        lateral = camera[..., :2] - camera[..., 2:] * self._grid.rays[..., :2]
        squared = np.square(lateral).sum(-1) * np.square(self._focal / z)
        disparity = np.square(camera[..., 2] * self._focal_baseline / (z * z))
        camera[..., :2] = lateral * _share_beyond(NOISE_PX, squared)[..., None]
        camera[..., 2] *= _share_beyond(DEPTH_NOISE_PX, disparity)
        camera[..., :2] += camera[..., 2:] * self._grid.rays[..., :2]
        return np.asarray(camera @ start.axes.T, np.float32)

    def look_at(self, shown: DepthClip) -> None:
        """Follow from the last frame as the model shows it, so that errors do not add up.

        Where its depth is not near that of the recorded frame, such as behind an instrument, the recorded one counts.
        """
        recorded_mm, self._last = self._last.depth_mm, CoarseFrame(shown, 0, self._grid)
        self._last.correct_depth(recorded_mm, np.abs(self._last.depth_mm - recorded_mm) > MAX_OFF * recorded_mm)

    def to(self, clip: DepthClip) -> Carried:
        """The motion from the last frame to this clip's, which becomes the last one."""
        last, new = self._last, CoarseFrame(clip, 0, self._grid)
        displacement_mm, colour, _ = lifted(last, new, *Flows(last).to(new))
        self._last = new
        colour = colour * _share_beyond(COLOUR_NOISE, np.square(colour).mean(-1, keepdims=True))
        return Carried(last, self._beyond_noise(displacement_mm, last), np.asarray(colour, np.float32))


def _share_beyond(noise: float, squared: NDArray[np.floating]) -> NDArray[np.floating]:
    """The share of a change that is more than noise, from its square; both in one unit."""
    return np.asarray(squared / (squared + noise**2))


@dataclass(frozen=True, eq=False)
class Carried:
    """Displacement in mm (world) and change of colour [h, w, 3] of a frame's cells to the next frame."""

    start: CoarseFrame
    displacement_mm: Floats
    colour: Floats

    def of(self, means_mm: Floats) -> tuple[Floats, Floats]:
        """Displacement in mm and change of the constant harmonic, [3, N] each, of Gaussians; 0 off the surface.

        means_mm: [N, 3] centres in the first frame, world.
        """
        start = self.start
        x, y, z = ((means_mm - start.place_mm) @ start.axes).T
        z = np.maximum(z, np.float32(1e-3))
        column, row = start.grid.cells_at(x / z, y / z)
        height, width = self.colour.shape[:2]
        row = np.clip(np.rint(row), 0, height - 1).astype(np.intp)
        column = np.clip(np.rint(column), 0, width - 1).astype(np.intp)
        moved_mm, colour = (np.ascontiguousarray(each[row, column].T) for each in (self.displacement_mm, self.colour))
        depth_mm = start.depth_mm[row, column]
        is_there = np.abs(z - depth_mm) <= MAX_OFF * depth_mm
        return moved_mm * is_there, np.asarray(colour * (is_there / np.float32(SH_C0)), np.float32)
