"""A scene at one moment as a file that splat viewers open.

Symbols: N Gaussians, K = (degree + 1)^2 coefficients a colour channel.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from worker.scene.scene import Scene


def export_ply(scene: Scene, t: float) -> bytes:
    """Binary PLY of the Gaussians deformed to model time t, in the property order that splat viewers read.

    x y z in mm of the world (the endoscope's camera of frame 0, OpenCV axes); nx ny nz 0; f_dc and f_rest (all
    coefficients of red, then green, then blue); opacity as a logit; scale as natural logarithms of mm; rot a unit wxyz
    quaternion. Viewers apply exp, sigmoid and the harmonics themselves.

    Raises:
        ValueError: t is not a finite number.
    """
    if not math.isfinite(t):
        raise ValueError(f"t must be a finite number, not {t}")
    with torch.no_grad():
        moved = scene.deformation.deform(scene.gaussians, t)
        rotation = torch.nn.functional.normalize(moved.quaternion, dim=-1)
        rest = moved.sh[:, 1:].transpose(1, 2).flatten(1)
        columns = [
            moved.mean / scene.units_per_mm,
            torch.zeros_like(moved.mean),
            moved.sh[:, 0],
            rest,
            moved.opacity_logit[:, None],
            moved.log_scale - math.log(scene.units_per_mm),
            rotation,
        ]
        table = torch.cat([each.to(torch.float32) for each in columns], dim=1).cpu().numpy()
    names = [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{channel}" for channel in range(3)),
        *(f"f_rest_{index}" for index in range(rest.shape[1])),
        "opacity",
        *(f"scale_{axis}" for axis in range(3)),
        *(f"rot_{part}" for part in range(4)),
    ]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment intrasplat t={t:g}, millimetres, OpenCV axes of the first frame's camera",
        f"element vertex {len(table)}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    return "\n".join(header).encode("ascii") + np.ascontiguousarray(table, dtype="<f4").tobytes()
