"""How tissue moved from one used frame to the next: optical flow, lifted to 3D by stereo depth, as tracks start a clip.

Symbols: N Gaussians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import to_camera
from intrasplat.clip import DepthClip
from intrasplat.motion.lifted import CoarseFrame, Flows, PointGrid, lifted
from intrasplat.motion.tracks import FLOW_WIDTH, MIN_GRID_SIDE
from intrasplat.splat.constants import SH_C0

Floats = NDArray[np.float32]
import os
NOISE_PX, DEPTH_NOISE_PX = map(float,os.environ.get("NP","0,0").split(","))


class FlowStart:
    """Follows tissue from each frame to the next one."""

    def __init__(self, first: DepthClip) -> None:
        camera = first.intrinsics
        least = max(1, min(camera.width, camera.height) // MIN_GRID_SIDE)
        self._grid = PointGrid(first, min(-(-camera.width // FLOW_WIDTH), least))
        self._last = CoarseFrame(first, 0, self._grid)
        self._focal = camera.fx / self._grid.step
        baseline_mm = np.linalg.norm(first.right.world_from_camera[0, :3, 3] - first.world_from_camera[0, :3, 3])
        self._focal_baseline = self._focal * float(baseline_mm)

    def _beyond_noise(self, displacement_mm: Floats, start: CoarseFrame) -> Floats:
        """The displacement [h, w, 3], less where it is as small as the errors of flow and of stereo."""
        if not NOISE_PX:
            return displacement_mm
        camera, z = displacement_mm @ start.axes, np.maximum(start.depth_mm, 1e-3)
        lateral = camera[..., :2] - camera[..., 2:] * self._grid.rays[..., :2]
        squared = np.square(lateral).sum(-1) * np.square(self._focal / z)
        disparity = np.square(camera[..., 2] * self._focal_baseline / (z * z))
        camera[..., :2] = lateral * (squared / (squared + NOISE_PX**2))[..., None]
        camera[..., 2] *= disparity / (disparity + DEPTH_NOISE_PX**2)
        camera[..., :2] += camera[..., 2:] * self._grid.rays[..., :2]
        return np.asarray(camera @ start.axes.T, np.float32)

    def to(self, clip: DepthClip, means_mm: Floats) -> tuple[Floats, Floats]:
        """Displacement in mm and change of the constant harmonic, [3, N] each, of Gaussians from the last frame to this
        clip's, which becomes the last one.

        means_mm: [N, 3] centres in the last frame, world.
        """
        last, new = self._last, CoarseFrame(clip, 0, self._grid)
        displacement_mm, colour, _ = lifted(last, new, *Flows(last).to(new))
        displacement_mm = self._beyond_noise(displacement_mm, last)
        self._last = new
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = last.axes, last.place_mm
        x, y, z = to_camera(means_mm, pose).T
        z = np.maximum(z, 1e-3)
        column, row = self._grid.cells_at((x / z).astype(np.float32), (y / z).astype(np.float32))
        height, width = colour.shape[:2]
        row = np.clip(np.rint(row), 0, height - 1).astype(np.intp)
        column = np.clip(np.rint(column), 0, width - 1).astype(np.intp)
        moved_mm = np.ascontiguousarray(displacement_mm[row, column].T)
        return moved_mm, np.ascontiguousarray(colour[row, column].T) / np.float32(SH_C0)
