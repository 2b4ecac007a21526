"""Export the Gaussians at one moment as a .splat file: 32 bytes each, for viewers in a browser."""

from __future__ import annotations

import numpy as np

from intrasplat.export.target import as_bytes, splats_at
from intrasplat.scene.scene import TrainedScene

ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def export_splat(scene: TrainedScene, t: float) -> bytes:
    """Rows of position and standard deviations (mm, OpenCV axes), red green blue opacity, and the quaternion wxyz as
    128 + 128 q. The most visible ones come first, as in other converters: a viewer may draw while it loads.
    """
    splats = splats_at(scene, t)
    rows = np.empty(len(splats.mean_mm), ROW)
    rows["position"], rows["scale"] = splats.mean_mm, splats.scale_mm
    rows["rgba"][:, :3], rows["rgba"][:, 3] = as_bytes(splats.colour), as_bytes(splats.opacity)
    rows["rotation"] = np.clip(np.rint(splats.quaternion * 128 + 128), 0, 255)
    shown = splats.opacity * splats.scale_mm.prod(axis=1)
    return rows[np.argsort(-shown, kind="stable")].tobytes()
