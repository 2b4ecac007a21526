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


class FlowStart:
    """Follows tissue from each frame to the next one."""

    def __init__(self, first: DepthClip) -> None:
        camera = first.intrinsics
        least = max(1, min(camera.width, camera.height) // MIN_GRID_SIDE)
        self._grid = PointGrid(first, min(-(-camera.width // FLOW_WIDTH), least))
        self._last = CoarseFrame(first, 0, self._grid)

    def to(self, clip: DepthClip, means_mm: Floats) -> tuple[Floats, Floats]:
        """Displacement in mm and change of the constant harmonic, [3, N] each, of Gaussians from the last frame to this
        clip's, which becomes the last one.

        means_mm: [N, 3] centres in the last frame, world.
        """
        last, new = self._last, CoarseFrame(clip, 0, self._grid)
        displacement_mm, colour, _ = lifted(last, new, *Flows(last).to(new))
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
