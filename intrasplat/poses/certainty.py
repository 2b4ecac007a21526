"""Expected error of a camera path: standard deviation of positions and rotations after one rigid motion aligns it.

Symbols: K frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from intrasplat.poses.rigid import Reals, cross
from intrasplat.poses.trajectory import ARM_MM

BETWEEN_AXES = float(np.sqrt(2) * ARM_MM)
"""A rotation moves two of three axes, whose ends lie ARM_MM away."""


def by_place_and_turn(of_twists: Reals, poses: Reals) -> Reals:
    """Covariance [6 K, 6 K] of positions (mm) and rotations (rad), from that of twists applied left of poses."""
    slopes = block_diag(*_slopes(poses))
    return np.asarray(slopes @ of_twists @ slopes.T)


def aligned_sigma(covariance: Reals, poses: Reals, asked: Sequence[int] | None = None) -> tuple[float, float]:
    """Expected error (mm, degrees), root mean square over frames, from a covariance [6 K, 6 K] of positions, rotations.

    A motion common to all cameras is no error, as in trajectory_error. asked: the frames that count; None: all K.
    """
    if asked is not None:
        rows = (6 * np.asarray(asked)[:, None] + np.arange(6)).ravel()
        covariance, poses = covariance[np.ix_(rows, rows)], poses[list(asked)]
    count = len(poses)
    scale = np.tile(np.repeat([1.0, BETWEEN_AXES], 3), count)
    common, _ = np.linalg.qr(scale[:, None] * _slopes(poses).reshape(-1, 6))
    alone = np.eye(6 * count) - common @ common.T
    variance = np.diag(alone @ (scale[:, None] * covariance * scale) @ alone).reshape(count, 6)
    mm, arms_mm = np.sqrt(variance[:, :3].sum(1).mean()), np.sqrt(variance[:, 3:].sum(1).mean())
    return float(mm), float(np.degrees(arms_mm / BETWEEN_AXES))


def _slopes(poses: Reals) -> Reals:
    """[K, 6, 6] derivative of position and rotation by a twist."""
    slopes = np.tile(np.eye(6), (len(poses), 1, 1))
    for each, place in zip(slopes, poses[:, :3, 3], strict=True):
        each[:3, 3:] = -cross(place)
    return slopes
