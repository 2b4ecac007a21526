"""Poses of the endoscope and of free viewpoints: world_from_camera [4, 4], mm, OpenCV axes.

The endoscope follows no path, one, or several at once; each path starts at the world's origin.

swing    slowly about the tissue, by SWING_DEG and DOLLY_MM
pan      to the right by PAN_VIEWS widths of the view at mean depth, once in the clip
advance  by ADVANCE_MM towards the tissue and back, once in the clip
retreat  by RETREAT_MM away from the tissue and back, once in the clip
roll     by ROLL_DEG about the optical axis, once in the clip
turn     by TURN_DEG within TURN_S about the port that the endoscope goes through, from TURN_START_S on
shake    as held by hand: sway of a mm or two and half a degree at 1.1 to 2.1 Hz, and tremor of 5 to 8 Hz

A turn and a shake take seconds, so settings.frame_rate_hz says how many frames they last.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, reduce
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.poses.pose_file import read_tum
from intrasplat.poses.trajectory import from_first
from lab.phantom.settings import CAMERA_PATHS, FOCAL_PER_WIDTH, MEAN_DEPTH_MM, CameraPath, PhantomSettings

SWING_DEG = (4.0, 2.5)  # yaw and pitch
SWING_PERIODS = (2.3, 3.1)  # in periods of the tissue, so that the view never repeats with the tissue
DOLLY_MM = 5.0

PAN_VIEWS = 1.5
PAN_BOW_MM, PAN_BOW_DEG = 8.0, 6.0  # deviation down and to the right, half-way: no hand moves along a line
ADVANCE_MM = 30.0
RETREAT_MM, RETREAT_SIDE_MM, RETREAT_DEG = 100.0, 8.0, 4.0  # back, to the side and turned, half-way
ROLL_DEG = 20.0
TURN_DEG, TURN_S, TURN_START_S = 5.0, 1.5, 0.4  # as fast as the kinematics of real recordings show
PORT_BEHIND_MM = 120.0  # the endoscope turns about its port in the abdominal wall
RAMP = 0.2  # share of a movement for acceleration, and for deceleration

# A hand is faster than a breath, whose usual 36 frames are 0.7 Hz: at equal frequency they could not be separated.
SWAY_MM, SWAY_MM_HZ = np.array([1.8, 1.5, 1.1]), np.array([1.1, 1.6, 1.3])  # along x, y, z
SWAY_DEG, SWAY_DEG_HZ = np.array([0.6, 0.8, 0.6]), np.array([1.7, 1.2, 2.1])  # about x, y, z
TREMOR_HZ = np.array([5.3, 6.1, 7.3])
TREMOR_SHARE = 0.1  # of the sway

Pose = NDArray[np.float64]


def orbit_pose(yaw_deg: float, pitch_deg: float, nearer_mm: float = 0.0) -> Pose:
    """A camera that orbits the point at mean depth on frame 0's axis and looks at it. Yaw is to the right, pitch up."""
    yaw, pitch = np.deg2rad(yaw_deg), np.deg2rad(pitch_deg)
    about_y = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    pose = np.eye(4)
    pose[:3, :3] = about_y @ about_x
    pose[:3, 3] = np.array([0, 0, MEAN_DEPTH_MM]) - (MEAN_DEPTH_MM - nearer_mm) * pose[:3, 2]
    return pose


def endoscope_pose(frame: float, settings: PhantomSettings) -> Pose:
    """The left eye's pose at a frame: the identity at frame 0, and in every frame of a fixed endoscope."""
    followed = [_POSES[path](frame, settings) for path in CAMERA_PATHS if path in settings.camera]
    if settings.recorded_path is not None:
        recorded = _recorded(settings.recorded_path)
        followed.append(recorded[min(round(frame), len(recorded) - 1)])
    return reduce(np.matmul, followed) if followed else np.eye(4)


def working_place_mm(frame: float, settings: PhantomSettings) -> NDArray[np.float64]:
    """(right, down) [2] mm of the tissue below the instruments, which a pan follows."""
    return _pan(frame, settings)[:2, 3] if "pan" in settings.camera else np.zeros(2)


def farther_mm(settings: PhantomSettings, depth_mm: float) -> tuple[float, float]:
    """How much farther (right or left, up or down) the clip's views reach on the plane z = depth_mm than frame 0's.

    A swing does not count: it looks at what frame 0 shows.
    """
    camera = settings.intrinsics
    edges = np.array([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy])
    corners = np.array([[x * edges[0], y * edges[1], 1.0] for x in (-1, 1) for y in (-1, 1)])
    paths: tuple[CameraPath, ...] = tuple(path for path in CAMERA_PATHS if path in settings.camera and path != "swing")
    reach_mm = depth_mm * edges
    looked_at = replace(settings, camera=paths)
    for frame in np.linspace(0, settings.frames - 1, min(settings.frames, _MAX_LOOKS)):
        pose = endoscope_pose(float(frame), looked_at)
        rays = corners @ pose[:3, :3].T
        places_mm = pose[:2, 3] + rays[:, :2] / rays[:, 2:] * (depth_mm - pose[2, 3])
        reach_mm = np.maximum(reach_mm, np.abs(places_mm).max(axis=0))
    right_mm, down_mm = reach_mm - depth_mm * edges
    return float(right_mm), float(down_mm)


def right_eye(world_from_left: Pose, baseline_mm: float) -> Pose:
    """The rectified right eye's pose: baseline_mm along the left eye's x axis."""
    pose = world_from_left.copy()
    pose[:3, 3] += baseline_mm * pose[:3, 0]
    return pose


def _swing(frame: float, settings: PhantomSettings) -> Pose:
    angle = 2 * np.pi * frame / settings.period_frames
    yaw, pitch = (degrees * np.sin(angle / periods) for degrees, periods in zip(SWING_DEG, SWING_PERIODS, strict=True))
    return orbit_pose(yaw, pitch, DOLLY_MM * np.sin(angle / 2 / SWING_PERIODS[1]) ** 2)


def _pan(frame: float, settings: PhantomSettings) -> Pose:
    share = _eased(_done(frame, settings))
    bow = np.sin(np.pi * share)
    return _moved((PAN_VIEWS * MEAN_DEPTH_MM / FOCAL_PER_WIDTH * share, PAN_BOW_MM * bow, 0), (0, PAN_BOW_DEG * bow, 0))


def _advance(frame: float, settings: PhantomSettings) -> Pose:
    return _moved((0, 0, ADVANCE_MM * np.sin(np.pi * _eased(_done(frame, settings))) ** 2), (0, 0, 0))


def _retreat(frame: float, settings: PhantomSettings) -> Pose:
    share = float(np.sin(np.pi * _eased(_done(frame, settings))) ** 2)
    away = share * np.array([RETREAT_SIDE_MM, -RETREAT_SIDE_MM / 2, -RETREAT_MM])
    return _moved(away, share * RETREAT_DEG * np.array([0.5, 1.0, -2.0]))


def _roll(frame: float, settings: PhantomSettings) -> Pose:
    return _moved((0, 0, 0), (0, 0, ROLL_DEG * _eased(_done(frame, settings))))


def _turn(frame: float, settings: PhantomSettings) -> Pose:
    since_s = frame / settings.frame_rate_hz - TURN_START_S
    turned = _moved((0, 0, -PORT_BEHIND_MM), (0, TURN_DEG * _eased(since_s / TURN_S), 0))
    return turned @ _moved((0, 0, PORT_BEHIND_MM), (0, 0, 0))


def _shake(frame: float, settings: PhantomSettings) -> Pose:
    angle = 2 * np.pi * frame / settings.frame_rate_hz
    tremor = TREMOR_SHARE * np.sin(angle * TREMOR_HZ)
    return _moved(
        SWAY_MM * (np.sin(angle * SWAY_MM_HZ) + tremor), SWAY_DEG * (np.sin(angle * SWAY_DEG_HZ) + tremor[::-1])
    )


@cache
def _recorded(path: Path) -> Pose:
    """The poses [lines, 4, 4] of a TUM file, from the first one."""
    return from_first(read_tum(path)[1])


def _done(frame: float, settings: PhantomSettings) -> float:
    """Share of the clip that has passed: 1 at the last frame."""
    return frame / max(settings.frames - 1, 1)


def _eased(share: float) -> float:
    """From 0 to 1 at constant speed, with acceleration and deceleration at the ends."""
    share = min(max(share, 0.0), 1.0)
    if share > 0.5:
        return 1 - _eased(1 - share)
    speed = 1 / (1 - RAMP)
    return speed * (share**2 / (2 * RAMP) if share < RAMP else share - RAMP / 2)


def _moved(by_mm: NDArray[np.float64] | tuple[float, ...], by_deg: NDArray[np.float64] | tuple[float, ...]) -> Pose:
    """A camera translated by (x, y, z) and rotated about the vector by_deg, whose length is the angle."""
    pose = np.eye(4)
    pose[:3, :3], _ = cv2.Rodrigues(np.deg2rad(np.asarray(by_deg, np.float64)))
    pose[:3, 3] = by_mm
    return pose


_MAX_LOOKS = 500  # frames of a long clip at which its extent is looked at
_POSES = {
    "swing": _swing,
    "pan": _pan,
    "advance": _advance,
    "retreat": _retreat,
    "roll": _roll,
    "turn": _turn,
    "shake": _shake,
}
