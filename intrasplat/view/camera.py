"""The rasteriser's camera for a view of a scene, and how much of the gloss that view shows.

Wet tissue reflects the lamp at another place for each eye. A Gaussian's gloss is how much brighter the right eye saw
it than the left one. A view between the eyes interpolates it. Where other cameras would see the reflection is unknown:
with the distance from both eyes, the view fades to the mean of the two, which is the best guess.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from intrasplat.camera import Intrinsics
from intrasplat.errors import LimitError
from intrasplat.picture import IntrinsicsOverride
from intrasplat.pose import MatrixPose, OrbitPose, world_from_camera
from intrasplat.report import RightEye
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.camera import Camera
from intrasplat.splat.step import camera_vector
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS, camera_in_units

MAX_SIDE = 1 << 20
"""Limit of a picture's side in pixels as fine as the recording's; a lens of 180 degrees needs fewer."""
FADING = 1.0
"""Distance from the line between the eyes, in baselines, at which the gloss has faded to exp(-1/2)."""


def endoscope_pose(scene: TrainedScene, t: float) -> NDArray[np.float64]:
    """world_from_camera [4, 4] (mm) of the endoscope's left eye at model time t, interpolated between frames."""
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


def right_eye(scene: TrainedScene, t: float, eye: RightEye) -> tuple[NDArray[np.float64], Intrinsics]:
    """world_from_camera [4, 4] (mm) and lens of the right eye at model time t. eye: what the scene's report says."""
    lens = dataclasses.replace(scene.intrinsics, fx=eye.fx_px, fy=eye.fy_px, cx=eye.cx_px, cy=eye.cy_px)
    return endoscope_pose(scene, t) @ np.array(eye.left_from_right).reshape(4, 4), lens


def view_camera(
    scene: TrainedScene,
    t: float,
    world_from_camera: NDArray[np.float64],
    intrinsics: Intrinsics,
    *,
    highlights: bool = True,
) -> NDArray[np.float64]:
    """The camera vector (intrasplat/splat/step.py) of a view [4, 4] mm at model time t."""
    side, dim = gloss_seen(scene, t, world_from_camera[:3, 3], highlights=highlights)
    camera = camera_in_units(intrinsics, world_from_camera, scene.units_per_mm, side, dim)
    return camera_vector(_as_enlarged(camera, scene, t, world_from_camera, intrinsics))


def _as_enlarged(
    camera: Camera, scene: TrainedScene, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics
) -> Camera:
    """The camera with its enlargement of the recording set (docs/rasterizer.md, "Pixels of the recording")."""
    own, recorder = scene.intrinsics, nearest_recorder(scene, t, world_from_camera[:3, 3])
    enlarged = intrinsics.fx / own.fx, intrinsics.fy / own.fy
    if np.array_equal(recorder[:3, 2:], world_from_camera[:3, 2:]) and max(enlarged) <= 1:
        return camera  # bit-identical to the camera of training
    x, y, z = recorder[:3, 2].tolist()
    origin = -float(recorder[:3, 2] @ recorder[:3, 3]) * scene.units_per_mm
    return dataclasses.replace(camera, enlarged=enlarged, recorded_depth=(x, y, z, origin))


def nearest_recorder(scene: TrainedScene, t: float, centre_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """world_from_camera [4, 4] (mm) of the endoscope where it was nearest to a point [3]: at model time t or at a
    trained frame."""
    own, trained = endoscope_pose(scene, t), scene.world_from_camera[scene.trained_frames]
    apart_mm = np.linalg.norm(trained[:, :3, 3] - centre_mm, axis=1)
    nearest = int(apart_mm.argmin())
    return own if np.linalg.norm(own[:3, 3] - centre_mm) <= apart_mm[nearest] else np.array(trained[nearest])


def as_recorded(camera: Intrinsics, own: Intrinsics) -> Intrinsics:
    """The same view in pixels as fine as the recording's, whose lens is `own`: confidence is calibrated for these.

    A side has at most MAX_SIDE pixels, however wide the field of view.
    """
    sides = camera.width * own.fx / camera.fx, camera.height * own.fy / camera.fy
    width, height = (max(round(min(side, MAX_SIDE)), 1) for side in sides)
    sampled = camera.resized(width, height)
    is_own = np.allclose([*sampled.numbers().values()], [*own.numbers().values()], rtol=1e-9)
    return own if is_own else sampled


def gloss_seen(
    scene: TrainedScene, t: float, centre_mm: NDArray[np.float64], *, highlights: bool = True
) -> tuple[float, float]:
    """side and dim (intrasplat/splat/camera.py) of a camera with this centre [3] in the world, mm."""
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


def pose_of(scene: TrainedScene, pose: MatrixPose | OrbitPose | None) -> NDArray[np.float64] | None:
    """world_from_camera [4, 4] of a pose, mm; None stays None and means the endoscope's own pose."""
    if pose is None:
        return None
    return np.array(world_from_camera(pose, MEDIAN_DEPTH_UNITS / scene.units_per_mm), dtype=np.float64)


def camera_of(clip: Intrinsics, wanted: IntrinsicsOverride, max_pixels: int) -> Intrinsics:
    """The clip's camera with the caller's overrides.

    Raises:
        LimitError: the camera has more than max_pixels pixels.
    """
    width, height = wanted.size(clip.width, clip.height)
    if width * height > max_pixels:
        problem = f"{width} x {height} is more than {max_pixels} pixels."
        raise LimitError("width", problem, "Ask for a smaller image.")
    return seen_through(clip, wanted)


def seen_through(clip: Intrinsics, wanted: IntrinsicsOverride) -> Intrinsics:
    """The clip's camera with the caller's overrides, of any size."""
    changes = {name: value for name in ("fx", "fy", "cx", "cy") if (value := getattr(wanted, name)) is not None}
    return dataclasses.replace(clip.resized(*wanted.size(clip.width, clip.height)), **changes)
