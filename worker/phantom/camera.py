"""Poses of the endoscope and of free viewpoints: world_from_camera [4, 4], mm, OpenCV axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from worker.phantom.surface import MEAN_DEPTH_MM

SWING_DEG = (4.0, 2.5)  # yaw and pitch of a moving endoscope
SWING_PERIODS = (2.3, 3.1)  # of the tissue's period, so that the view never repeats with the tissue
DOLLY_MM = 5.0


def orbit_pose(yaw_deg: float, pitch_deg: float, nearer_mm: float = 0.0) -> NDArray[np.float64]:
    """A camera that orbits the point at mean depth on frame 0's axis and looks at it. Yaw is to the right, pitch up."""
    yaw, pitch = np.deg2rad(yaw_deg), np.deg2rad(pitch_deg)
    about_y = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    pose = np.eye(4)
    pose[:3, :3] = about_y @ about_x
    pose[:3, 3] = np.array([0, 0, MEAN_DEPTH_MM]) - (MEAN_DEPTH_MM - nearer_mm) * pose[:3, 2]
    return pose


def endoscope_pose(frame: float, period_frames: float, moving: bool) -> NDArray[np.float64]:
    """The left eye's pose at a frame: the identity at frame 0, and in every frame of a fixed endoscope."""
    if not moving:
        return np.eye(4)
    angle = 2 * np.pi * frame / period_frames
    yaw, pitch = (degrees * np.sin(angle / periods) for degrees, periods in zip(SWING_DEG, SWING_PERIODS, strict=True))
    return orbit_pose(yaw, pitch, DOLLY_MM * np.sin(angle / 2 / SWING_PERIODS[1]) ** 2)


def right_eye(world_from_left: NDArray[np.float64], baseline_mm: float) -> NDArray[np.float64]:
    """The rectified right eye's pose: baseline_mm along the left eye's x axis."""
    pose = world_from_left.copy()
    pose[:3, 3] += baseline_mm * pose[:3, 0]
    return pose
