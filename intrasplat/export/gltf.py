"""Export the Gaussians at one moment as binary glTF with the extension KHR_gaussian_splatting (ratified).

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

from __future__ import annotations

import numpy as np

from intrasplat.export.glb import Glb, to_gltf
from intrasplat.export.target import as_bytes, splats_at
from intrasplat.scene.scene import TrainedScene

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0
"""glTF's mode of a primitive that is drawn as points."""

TURNED = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Factors of the 16 real harmonics when y and z change signs: -1 for those that are odd in y and z together."""


def export_gltf(scene: TrainedScene, t: float) -> bytes:
    """GLB of N points in metres, +Y up. Programs that do not know the extension show coloured points.

    ROTATION is a unit xyzw quaternion, SCALE the standard deviations in metres, OPACITY in [0, 1]; colours are sRGB as
    shown. The numbers themselves, harmonics included, are rotated into glTF's axes; the node has no rotation.
    """
    splats, glb = splats_at(scene, t), Glb()
    w, x, y, z = splats.quaternion.T
    # Rotate by 180 degrees about x: (0, 1, 0, 0) (w, x, y, z) = (-x, w, -z, y), in wxyz.
    rotation = np.stack([w, -z, y, -x], axis=1)
    rgba = np.concatenate([as_bytes(splats.colour), as_bytes(splats.opacity)[:, None]], axis=1)
    attributes = {
        "POSITION": glb.add(to_gltf(splats.mean_mm), bounds=True),
        "COLOR_0": glb.add(rgba, unit=True),
        f"{EXTENSION}:ROTATION": glb.add(rotation),
        f"{EXTENSION}:SCALE": glb.add(splats.scale_mm * np.float32(1e-3)),
        f"{EXTENSION}:OPACITY": glb.add(splats.opacity),
    }
    harmonics = splats.sh * TURNED[: splats.sh.shape[1], None]
    for index in range(harmonics.shape[1]):
        degree = int(np.sqrt(index))
        name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index - degree**2}"
        attributes[name] = glb.add(np.ascontiguousarray(harmonics[:, index]))
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: extension}}
    return glb.file(primitive, (EXTENSION,))
