"""Converts our coordinate frames to Slicer's: points, cameras and pictures of a scene in RAS, mm.

Our world, and every camera, has OpenCV's axes (x right, y down, z forward). They are taken as LPS axes (x to the left,
y to the posterior, z to the superior), so RAS is (-x, -y, z), as for the files that Slicer reads as LPS.

Symbols: H W pixels (row i, column j), D depth of the plane on which a picture is shown (mm).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from intrasplat_client.views import PictureCamera

Matrix = NDArray[np.float64]

RAS_FROM_WORLD: Matrix = np.diag([-1.0, -1.0, 1.0, 1.0])
"""A rotation by 180 degrees about z, which is its own inverse."""

SLICE_MM = 1.0
"""Thickness of a picture, which is a volume of one slice, in mm."""


def turned(pose: Matrix) -> Matrix:
    """Convert a rigid motion [4, 4] from our frame to Slicer's, or from Slicer's to ours."""
    return RAS_FROM_WORLD @ pose @ RAS_FROM_WORLD


def points_in_ras(points_mm: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert points [N, 3] from our world to RAS, mm."""
    return points_mm * RAS_FROM_WORLD.diagonal()[:3].astype(np.float32)


def world_from_camera(camera: PictureCamera) -> Matrix:
    """The pose of a picture's camera, [4, 4], mm."""
    return np.array([*camera.world_from_camera, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)


def ras_from_ijk(camera: PictureCamera, depth_mm: float) -> Matrix:
    """Where the pixels of a picture lie in RAS: on the plane z = D of its camera, each on the ray that it shows.

    [4, 4] takes (column j, row i, 0, 1), the centre of a pixel, to mm. Rows run down, as they do in the picture.
    """
    across_mm, down_mm = depth_mm / camera.fx, depth_mm / camera.fy
    camera_from_ijk = np.array(
        [
            [across_mm, 0.0, 0.0, (0.5 - camera.cx) * across_mm],
            [0.0, down_mm, 0.0, (0.5 - camera.cy) * down_mm],
            [0.0, 0.0, SLICE_MM, depth_mm],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return np.asarray(RAS_FROM_WORLD @ world_from_camera(camera) @ camera_from_ijk, np.float64)
