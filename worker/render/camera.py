"""The rasteriser's camera of a view of a scene, and what that view shows of the gloss.

Wet tissue mirrors the lamp elsewhere for each eye. A Gaussian's gloss is how much brighter the right eye saw it than
the left one; between the eyes a view takes its share of it. Where the lamp's image lies for anybody else is not known:
with the distance from both eyes the view turns to the mean of the two, which is the best guess.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from contract.wire.report import RightEye
from worker.input.camera import Intrinsics
from worker.raster import Camera
from worker.raster.step import camera_vector
from worker.scene.scene import Scene
from worker.train.targets import camera_in_units

MAX_SIDE = 1 << 20
"""Pixels as fine as the recording's along a side; a lens of 180 degrees needs fewer."""
FADING = 1.0
"""Distance from the line between the eyes, in baselines, at which the gloss has faded to exp(-1/2)."""


def endoscope_pose(scene: Scene, t: float) -> NDArray[np.float64]:
    """world_from_camera [4, 4] (mm) of the endoscope's left eye at model time t, between frames interpolated."""
    poses, count = scene.world_from_camera, scene.frame_count
    place = min(max(t * count, 0.0), count - 1.0)
    before = min(int(place), max(count - 2, 0))
    if count == 1 or np.array_equal(poses[before], poses[before + 1]):
        return np.array(poses[before])
    share = place - before
    pose = np.eye(4)
    pose[:3, :3] = Slerp([0.0, 1.0], Rotation.from_matrix(poses[before : before + 2, :3, :3]))(share).as_matrix()
    pose[:3, 3] = (1 - share) * poses[before, :3, 3] + share * poses[before + 1, :3, 3]
    return pose


def right_eye(scene: Scene, t: float, told: RightEye) -> tuple[NDArray[np.float64], Intrinsics]:
    """world_from_camera [4, 4] (mm) and lens of the endoscope's right eye at model time t, as a report tells of it."""
    lens = dataclasses.replace(scene.intrinsics, fx=told.fx_px, fy=told.fy_px, cx=told.cx_px, cy=told.cy_px)
    return endoscope_pose(scene, t) @ np.array(told.left_from_right).reshape(4, 4), lens


def view_camera(
    scene: Scene,
    t: float,
    world_from_camera: NDArray[np.float64],
    intrinsics: Intrinsics,
    *,
    highlights: bool = True,
) -> NDArray[np.float64]:
    """The camera vector (worker/raster/step.py) of a view [4, 4] mm at model time t."""
    side, dim = gloss_seen(scene, t, world_from_camera[:3, 3], highlights=highlights)
    camera = camera_in_units(intrinsics, world_from_camera, scene.units_per_mm, side, dim)
    return camera_vector(_as_enlarged(camera, scene, t, world_from_camera, intrinsics))


def _as_enlarged(
    camera: Camera, scene: Scene, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics
) -> Camera:
    """The camera, told by how much it enlarges the recording (docs/rasterizer.md, "Pixels of the recording")."""
    own, recorder = scene.intrinsics, nearest_recorder(scene, t, world_from_camera[:3, 3])
    enlarged = intrinsics.fx / own.fx, intrinsics.fy / own.fy
    if np.array_equal(recorder[:3, 2:], world_from_camera[:3, 2:]) and max(enlarged) <= 1:
        return camera  # to the last bit what training saw
    x, y, z = recorder[:3, 2].tolist()
    origin = -float(recorder[:3, 2] @ recorder[:3, 3]) * scene.units_per_mm
    return dataclasses.replace(camera, enlarged=enlarged, recorded_depth=(x, y, z, origin))


def nearest_recorder(scene: Scene, t: float, centre_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """world_from_camera [4, 4] (mm) of the endoscope, at model time t or at a trained frame, where it was nearest to a
    place [3]."""
    own, trained = endoscope_pose(scene, t), scene.world_from_camera[scene.trained_frames]
    apart_mm = np.linalg.norm(trained[:, :3, 3] - centre_mm, axis=1)
    nearest = int(apart_mm.argmin())
    return own if np.linalg.norm(own[:3, 3] - centre_mm) <= apart_mm[nearest] else np.array(trained[nearest])


def as_recorded(camera: Intrinsics, own: Intrinsics) -> Intrinsics:
    """The same view in pixels as fine as the recording's, whose lens is `own`: in these, confidence is calibrated.

    A field of view that is wider than any lens shows has at most MAX_SIDE of them along a side.
    """
    sides = camera.width * own.fx / camera.fx, camera.height * own.fy / camera.fy
    width, height = (max(round(min(side, MAX_SIDE)), 1) for side in sides)
    sampled = camera.resized(width, height)
    is_own = np.allclose([*sampled.numbers().values()], [*own.numbers().values()], rtol=1e-9)
    return own if is_own else sampled


def gloss_seen(
    scene: Scene, t: float, centre_mm: NDArray[np.float64], *, highlights: bool = True
) -> tuple[float, float]:
    """side and dim (worker/raster/__init__.py) of a camera whose centre [3] is in the world, mm."""
    if scene.right_eye_mm is None:
        return 0.0, 0.0
    if not highlights:
        return 0.0, 0.5
    left_eye = endoscope_pose(scene, t)
    baseline_mm = left_eye[:3, :3] @ np.array(scene.right_eye_mm)
    from_left_mm = centre_mm - left_eye[:3, 3]
    length_mm = float(np.linalg.norm(baseline_mm))
    along = min(max(float(from_left_mm @ baseline_mm) / length_mm**2, 0.0), 1.0)
    away = float(np.linalg.norm(from_left_mm - along * baseline_mm)) / length_mm
    known = float(np.exp(-0.5 * (away / FADING) ** 2))
    return known * (along - 0.5), 0.0
