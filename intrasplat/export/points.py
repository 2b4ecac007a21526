"""Export the Gaussians' centres at one moment as a coloured point cloud."""

from __future__ import annotations

import numpy as np

from intrasplat.export.ply import ply_head, structured
from intrasplat.export.target import as_bytes, splats_at
from intrasplat.scene.scene import TrainedScene


def export_points(scene: TrainedScene, t: float) -> bytes:
    """Binary PLY of N points: x y z (mm, OpenCV axes), red green blue, alpha (opacity), and trust in [0, 1] (`seen`).

    A point is a Gaussian's centre. It lies below the tissue's surface by about the Gaussian's size.
    """
    splats = splats_at(scene, t)
    colour = as_bytes(splats.colour)
    rows = structured(
        [
            *((axis, splats.mean_mm[:, index]) for index, axis in enumerate("xyz")),
            *((name, colour[:, index]) for index, name in enumerate(("red", "green", "blue"))),
            ("alpha", as_bytes(splats.opacity)),
            ("trust", np.asarray(scene.seen.numpy(), np.float32)),
        ]
    )
    kinds = {"f": "float", "u": "uchar"}
    properties = [(kinds[rows.dtype[name].kind], name) for name in rows.dtype.names or ()]
    comment = f"intrasplat t={t:g}, millimetres, OpenCV axes of the first frame's camera"
    return ply_head(comment, len(rows), properties) + rows.tobytes()
