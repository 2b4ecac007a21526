"""The smoke that lay before the tissue when it was recorded, in a view.

Symbols: H W pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.scene.scene import TrainedScene
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.confidence import places_in_endoscope

Floats = NDArray[np.float32]
Camera = tuple[Intrinsics, NDArray[np.float64]]


def smoke_share(scene: TrainedScene, t: float, depth_mm: Floats, camera: Camera) -> Floats:
    """[H, W] share of the tissue's light, in [0, 1], that the smoke of model time t takes in a view.

    Each pixel has the smoke that the endoscope's picture has at the point that it shows, as thick as its own distance.

    Args:
        depth_mm: [H, W] camera z of the view; the share is 0 where it is 0.
        camera: intrinsics and world_from_camera [4, 4], mm, of the view.
    """
    veil, own = scene.veil, scene.intrinsics
    if veil is None:
        return np.zeros_like(depth_mm)
    column, row = places_in_endoscope(depth_mm, camera, (own, endoscope_pose(scene, t)))
    thickness = veil.at(t * scene.frame_count)
    x = (column + np.float32(0.5)) * np.float32(thickness.shape[1] / own.width) - np.float32(0.5)
    y = (row + np.float32(0.5)) * np.float32(thickness.shape[0] / own.height) - np.float32(0.5)
    there = cv2.remap(thickness, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return 1 - veil.arriving(np.asarray(there, np.float32), depth_mm)


def with_smoke(scene: TrainedScene, t: float, rgb: Floats, depth_mm: Floats, camera: Camera) -> Floats:
    """Colours [H, W, 3] in [0, 1] of a view behind its smoke; as given where there is none. Arguments as above."""
    return rgb if scene.veil is None else scene.veil.drawn_over(rgb, 1 - smoke_share(scene, t, depth_mm, camera))
