"""Camera paths as TUM files, and the error of one path against another.

A TUM file has one line `timestamp tx ty tz qx qy qz qw` per frame: seconds, metres, world_from_camera. Lines that start
with # are comments.

Symbols: T frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from intrasplat.errors import InputError
from intrasplat.poses.rigid import Reals, between, inverse

MM_PER_M = 1000.0
ARM_MM = 60.0
"""Alignment of two paths weighs a rotation by how far it moves a point at this distance. Positions alone do not
determine the rotation of a path that only rotates or that runs along a line."""
LATE_S, MAX_GAP_S = 0.02, 0.25
"""A frame must lie within LATE_S of a pose, or between two poses that are at most MAX_GAP_S apart."""


@dataclass(frozen=True)
class TrajectoryError:
    """Absolute trajectory error, root mean square after one rigid motion aligns one path with the other."""

    mm: float
    deg: float


def trajectory_error(found: Reals, true: Reals) -> TrajectoryError:
    """The error of a path [T, 4, 4] against the true one, world_from_camera in mm.

    The rigid motion minimises the squared error of positions and of axis ends ARM_MM away. The scale is not fitted,
    because stereo measures it.
    """
    centred = [path[:, :3, 3] - path[:, :3, 3].mean(0) for path in (found, true)]
    spread = np.einsum("ti,tj->ij", centred[1], centred[0])
    spread += ARM_MM**2 * np.einsum("tij,tkj->ik", true[:, :3, :3], found[:, :3, :3])
    u, _, vt = np.linalg.svd(spread)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    off_mm = centred[0] @ turn.T - centred[1]
    off = np.swapaxes(true[:, :3, :3], 1, 2) @ turn @ found[:, :3, :3]
    angles_deg = np.degrees(Rotation.from_matrix(off).magnitude())
    return TrajectoryError(*(float(np.sqrt(np.mean(each))) for each in (np.square(off_mm).sum(1), angles_deg**2)))


def write_tum(path: Path, times_s: Reals, world_from_camera: Reals) -> None:
    """Write a path [T, 4, 4] in mm with its times [T] as a TUM file."""
    path.write_text(tum_lines(times_s, world_from_camera))


def tum_lines(times_s: Reals, world_from_camera: Reals) -> str:
    """A path [T, 4, 4] in mm as the text of a TUM file."""
    turns = Rotation.from_matrix(world_from_camera[:, :3, :3]).as_quat()  # x, y, z, w
    rows = np.column_stack([times_s, world_from_camera[:, :3, 3] / MM_PER_M, turns])
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows)


def at_times(times_s: Reals, poses: Reals, wanted_s: Reals, field: str = "--against") -> Reals:
    """The poses [T, 4, 4] of a path at the times wanted, interpolated. Both times count from the same moment.

    Raises:
        InputError: the path's times do not rise, or it has no pose near a time.
    """
    remedy = "Give a pose for each frame, or a path that begins with the clip and lasts as long, with 5 poses a second."
    if not (np.diff(times_s) > 0).all():
        raise InputError(field, "the times of the path do not rise from line to line.", remedy)
    gap_s = np.diff(times_s, prepend=-math.inf, append=math.inf)[np.searchsorted(times_s, wanted_s)]
    nearest_s = np.abs(np.asarray(wanted_s)[:, None] - times_s).min(1)
    if (unknown := (gap_s > MAX_GAP_S) & (nearest_s > LATE_S)).any():
        about = f"{len(times_s)} poses from {times_s[0]:.2f} to {times_s[-1]:.2f} s"
        raise InputError(field, f"the path has {about}, and none about {wanted_s[unknown][0]:.2f} s.", remedy)
    return np.stack([between(times_s, poses, wanted) for wanted in wanted_s])


def from_first(poses: Reals) -> Reals:
    """The same path in the world of its first camera."""
    return np.asarray(inverse(poses[0]) @ poses)
