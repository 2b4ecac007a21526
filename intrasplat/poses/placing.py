"""Places a clip's cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip


def placed(clip: DepthClip, world_from_camera: NDArray[np.float64]) -> DepthClip:
    """The clip with these poses [T, 4, 4] of the left eye, mm; the right eye moves along."""
    right = clip.right
    if right is not None:
        left_from_right = np.linalg.inv(clip.world_from_camera[0]) @ right.world_from_camera[0]
        right = replace(right, world_from_camera=world_from_camera @ left_from_right)
    return replace(clip, world_from_camera=world_from_camera, right=right)
