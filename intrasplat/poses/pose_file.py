"""Files of camera poses, and the poses of a clip's frames in them.

A TUM file has lines `timestamp tx ty tz qx qy qz qw`. Other text has a 3x4 or 4x4 matrix a line, or a row of it a line.
JSON has a list of matrices, alone or as "poses". Lines that start with # are comments.

Symbols: T frames, P poses.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intrasplat.clip import DepthClip
from intrasplat.errors import InputError
from intrasplat.intake.calibration.encoding import decoded_text
from intrasplat.intake.limits import MAX_POSE_FILE_BYTES
from intrasplat.notices import NoticeCode
from intrasplat.poses.agreement import Convention
from intrasplat.poses.rigid import Reals
from intrasplat.poses.trajectory import MM_PER_M, at_times

RIGID_TOLERANCE = 1e-3
MAX_POSITION = 1e6
"""Largest coordinate of a position, in the file's unit."""
TUM_COLUMNS, MATRIX_COLUMNS = 8, (12, 16)
REMEDY = "Give a TUM file (t x y z qx qy qz qw), or a 3x4 or 4x4 matrix a frame as JSON or text."


@dataclass(frozen=True, eq=False)
class StoredPoses:
    """Poses as a file or an array has them; agreement.py decides on unit, direction and axes.

    matrices [P, 4, 4]
    stamps   [P] first column of a TUM file: seconds or frame numbers; None: one pose a frame
    field    name for errors
    declared unit, direction and axes by the caller; None: those of the format
    """

    matrices: Reals
    stamps: Reals | None = None
    field: str = "poses_file"
    declared: Convention | None = None


def read_poses(path: Path, field: str = "poses_file") -> StoredPoses:
    """The poses in a file.

    Raises:
        InputError: it cannot be read, has no poses, or poses that are not rigid.
    """
    try:
        if path.stat().st_size > MAX_POSE_FILE_BYTES:
            raise InputError(field, f"{path.name} is larger than {MAX_POSE_FILE_BYTES // 2**20} MiB.", REMEDY)
        text = decoded_text(path.read_bytes())
        if text is None:
            raise InputError(field, f"{path.name} is not a text file.", REMEDY)
        if text.lstrip()[:1] in ("[", "{"):
            return StoredPoses(rigid(_of_json(json.loads(text)), field), None, field)
    except OSError as error:
        raise InputError(field, f"{path.name} cannot be read ({error.strerror}).", REMEDY) from error
    except (ValueError, RecursionError) as error:
        raise InputError(field, f"{path.name} is not valid JSON ({error}).", REMEDY) from error
    rows = _rows(text, path, field)
    columns = rows.shape[1]
    if columns == TUM_COLUMNS:
        return StoredPoses(_of_tum(rows, path, field), rows[:, 0], field)
    if columns in MATRIX_COLUMNS:
        return StoredPoses(rigid(rows.reshape(len(rows), -1, 4), field), None, field)
    is_whole = len(rows) % 4 == 0 and (rows[3::4] == (0, 0, 0, 1)).all()
    height = 4 if is_whole else 3
    if columns != 4 or len(rows) % height:
        raise InputError(field, f"{path.name} has {len(rows)} lines of {columns} numbers.", REMEDY)
    return StoredPoses(rigid(rows.reshape(-1, height, 4), field), None, field)


def read_tum(path: Path, field: str = "--against") -> tuple[Reals, Reals]:
    """Times [P] in seconds and poses [P, 4, 4] in mm of a TUM file in metres.

    Raises:
        InputError: it cannot be read, or is no TUM file.
    """
    stored = read_poses(path, field)
    if stored.stamps is None:
        raise InputError(field, f"{path.name} is no TUM file.", "Give lines `timestamp tx ty tz qx qy qz qw`.")
    poses = stored.matrices.copy()
    poses[:, :3, 3] *= MM_PER_M
    return stored.stamps, poses


def rigid(given: Any, field: str) -> Reals:
    """Matrices [P, 3 or 4, 4] as [P, 4, 4].

    Raises:
        InputError: they have another shape, are not finite, or not rigid.
    """
    try:
        matrices = np.asarray(given, np.float64)
    except (OverflowError, TypeError, ValueError) as error:
        raise InputError(field, f"the poses are no numbers in matrices ({error}).", REMEDY) from error
    if matrices.ndim != 3 or matrices.shape[1:] not in ((3, 4), (4, 4)) or not len(matrices):
        raise InputError(field, f"the poses have shape {list(matrices.shape)}, not [T, 4, 4].", REMEDY)
    poses = np.tile(np.eye(4), (len(matrices), 1, 1))
    poses[:, : matrices.shape[1]] = matrices
    rotation = poses[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        skew = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max((1, 2))
        good = np.isfinite(poses).all((1, 2)) & (skew < RIGID_TOLERANCE) & (np.linalg.det(rotation) > 0)
    good &= (np.abs(poses[:, :3, 3]) <= MAX_POSITION).all(1)
    good &= np.isclose(poses[:, 3], (0, 0, 0, 1)).all(1)
    if not good.all():
        problem = f"the pose of frame {int(np.argmin(good))} is not rigid, or farther than {MAX_POSITION:g} away."
        raise InputError(field, problem, "Give [R | t; 0 0 0 1] with finite numbers and rotations R, in mm or m.")
    return poses


def poses_of_frames(clip: DepthClip, stored: StoredPoses) -> Reals:
    """The stored poses [T, 4, 4] of the clip's frames: one a frame, or by frame number, or interpolated at its time.

    Raises:
        InputError: the poses do not belong to this clip.
    """
    count, stamps = clip.frame_count, stored.stamps
    if len(stored.matrices) == count:
        return stored.matrices
    problem = f"there are {len(stored.matrices)} poses for {count} frames."
    if stamps is None:
        raise InputError(stored.field, problem, "Give a pose for each frame.")
    if (np.diff(stamps) == 1).all():
        first = 0 if 0 in stamps else 1
        if first in stamps and len(stamps) > count:
            start = int(np.searchsorted(stamps, first))
            if start + count <= len(stamps):
                return stored.matrices[start : start + count]
        raise InputError(stored.field, problem, "Give a pose for each frame, numbered from 0.")
    if any(notice.code is NoticeCode.FRAME_TIMES for notice in clip.assumptions):
        raise InputError(stored.field, f"{problem} The frames' times are not known.", "Give a pose for each frame.")
    wanted_s = clip.frame_times_s - clip.frame_times_s[0]
    return at_times(stamps - stamps[0], stored.matrices, wanted_s, stored.field)


def _of_json(value: Any) -> Any:
    """Matrices in a parsed file: a list, {"poses": list}, or {"frames": [{"transform_matrix": ...}]}."""
    if isinstance(value, dict):
        frames = value.get("frames")
        if isinstance(frames, list):
            return [each.get("transform_matrix") if isinstance(each, dict) else None for each in frames]
        return value.get("poses")
    return value


def _rows(text: str, path: Path, field: str) -> Reals:
    """The numbers [lines, columns] of a text."""
    lines = text.replace(",", " ").splitlines()
    numbered = [
        (number, line.split()) for number, line in enumerate(lines, 1) if line.strip() and line.lstrip()[0] != "#"
    ]
    if not numbered:
        raise InputError(field, f"{path.name} holds no pose.", REMEDY)
    columns = len(numbered[0][1])
    for number, words in numbered:
        if len(words) != columns or not all(_is_number(word) for word in words):
            expected = TUM_COLUMNS if columns not in (4, *MATRIX_COLUMNS) else columns
            raise InputError(field, f"line {number} of {path.name} does not hold {expected} finite numbers.", REMEDY)
    return np.array([words for _, words in numbered], np.float64)


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _of_tum(rows: Reals, path: Path, field: str) -> Reals:
    lengths = np.linalg.norm(rows[:, 4:], axis=1)
    if not np.allclose(lengths, 1, atol=0.01):
        raise InputError(field, f"{path.name} holds quaternions that are not of length 1.", REMEDY)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return rigid(poses, field)
