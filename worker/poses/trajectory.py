"""Camera paths as TUM files, and how far one path is from another.

A TUM file has a line `timestamp tx ty tz qx qy qz qw` a frame: seconds, metres, world_from_camera. Lines that begin
with # are comments.

Symbols: T frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from contract.wire.errors import InputError
from worker.poses.rigid import Reals, inverse

MM_PER_M = 1000.0
ARM_MM = 60.0
"""How much a turn counts beside a place when two paths are laid on each other: as much as it moves what is so far away.
Places alone do not fix the turn of a path that only turns, or that runs along a line."""


@dataclass(frozen=True)
class TrajectoryError:
    """Absolute trajectory error, root mean square after one rigid motion laid one path on the other."""

    mm: float
    deg: float


def trajectory_error(found: Reals, true: Reals) -> TrajectoryError:
    """The error of a path [T, 4, 4] against the true one, world_from_camera in mm.

    The rigid motion is that of least squares over places and, ARM_MM away, axes. Stereo knows
    the scale, so it is not fitted.
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


def read_tum(path: Path) -> tuple[Reals, Reals]:
    """Times [T] in seconds and poses [T, 4, 4] in mm of a TUM file.

    Raises:
        InputError: it cannot be read, or is no TUM file.
    """
    remedy = "Give lines `timestamp tx ty tz qx qy qz qw`, in seconds and metres."
    try:
        lines = [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
        rows = np.array(lines, np.float64)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError("--against", f"{path} cannot be read as a TUM file ({error}).", remedy) from error
    if rows.ndim != 2 or rows.shape[1] != 8 or not np.isfinite(rows).all():
        raise InputError("--against", f"{path} does not hold 8 finite numbers a line.", remedy)
    lengths = np.linalg.norm(rows[:, 4:], axis=1)
    if not np.allclose(lengths, 1, atol=0.01):
        raise InputError("--against", f"{path} holds quaternions that are not of length 1.", remedy)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = MM_PER_M * rows[:, 1:4]
    return rows[:, 0], poses


def at_times(times_s: Reals, poses: Reals, wanted_s: Reals) -> Reals:
    """The poses [T, 4, 4] nearest in time to those wanted."""
    nearest = np.abs(np.asarray(wanted_s)[:, None] - times_s).argmin(1)
    return np.asarray(poses[nearest])


def from_first(poses: Reals) -> Reals:
    """The same path in the world of its first camera."""
    return np.asarray(inverse(poses[0]) @ poses)
