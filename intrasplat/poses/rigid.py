"""Rigid motions of a stereo camera and their robust estimation from matches between two frames.

Symbols: M matches. A twist [6] is (v, w): translation in mm, rotation in radians; exp maps it to a motion [4, 4].
A measurement [3] is (column, row, disparity) of a point in px of the coarse grid. Its noise is about the same in all
three, unlike that of depth in mm, which grows with the square of the depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

STEPS = 8
"""Maximum number of Gauss-Newton steps for one link."""
MIN_SCALE_PX, MAX_SCALE_PX = 0.25, 2.0
"""Limits of the robust scale, the residual at which a match has half its weight, in px of the coarse grid."""
LONGEST = np.repeat([20.0, 0.2], 3)
"""Maximum change of a coordinate in one step, mm and radians: contradictory matches must not make it diverge."""
CONVERGED = 1e-5
"""Length of a twist (mm, and radians times 100) at which the steps end."""


def exp(twist: Reals) -> Reals:
    """The motion [4, 4] of a twist [6]."""
    v, w = twist[:3], twist[3:]
    angle = float(np.linalg.norm(w))
    k = cross(w)
    if angle < 1e-8:
        a, b, c = 1.0, 0.5, 1 / 6
    else:
        a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
        c = (1 - a) / angle**2
    motion = np.eye(4)
    motion[:3, :3] += a * k + b * k @ k
    motion[:3, 3] = (np.eye(3) + b * k + c * k @ k) @ v
    return motion


def log(motion: Reals) -> Reals:
    """The twist [6] of a motion [4, 4]; its angle is at most pi."""
    rotation = motion[:3, :3]
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    sine, cosine = np.linalg.norm(axis) / 2, (np.trace(rotation) - 1) / 2
    angle = float(np.arctan2(sine, cosine))
    w = axis / 2 if sine < 1e-8 else axis * (angle / (2 * sine))
    k = cross(w)
    c = 1 / 12 if angle < 1e-4 else (1 - angle * np.sin(angle) / (2 * (1 - np.cos(angle)))) / angle**2
    return np.concatenate([(np.eye(3) - k / 2 + c * k @ k) @ motion[:3, 3], w])


def cross(w: Reals) -> Reals:
    """[3, 3] the matrix of the cross product with w."""
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def inverse(motion: Reals) -> Reals:
    """The inverse of rigid motions [..., 4, 4]."""
    back = np.zeros_like(motion)
    rotation = np.swapaxes(motion[..., :3, :3], -1, -2)
    back[..., :3, :3] = rotation
    back[..., :3, 3] = -(rotation @ motion[..., :3, 3:])[..., 0]
    back[..., 3, 3] = 1
    return back


def between(frames: Sequence[int] | Reals, poses: Reals, index: float) -> Reals:
    """The pose [4, 4] at a frame, interpolated at constant velocity between the poses before and after it.

    frames [K] (or times) rise; poses are [K, 4, 4].
    """
    after = int(np.searchsorted(frames, index))
    if after in {0, len(frames)}:
        return np.asarray(poses[min(after, len(frames) - 1)])
    share = (index - frames[after - 1]) / (frames[after] - frames[after - 1])
    return np.asarray(exp(log(poses[after] @ inverse(poses[after - 1])) * share) @ poses[after - 1])


@dataclass(frozen=True)
class StereoCamera:
    """The camera of the coarse grid: focal lengths and principal point in its px, and the baseline in mm."""

    fx: float
    fy: float
    cx: float
    cy: float
    baseline_mm: float

    def points_mm(self, seen: Reals) -> Reals:
        """Points [M, 3], camera axes, of measurements [M, 3]."""
        z = self.fx * self.baseline_mm / seen[:, 2]
        return np.stack([(seen[:, 0] - self.cx) * z / self.fx, (seen[:, 1] - self.cy) * z / self.fy, z], axis=1)

    def seen(self, points_mm: Reals) -> Reals:
        """Measurements [M, 3] of points [M, 3]."""
        x, y, z = points_mm.T
        z = np.maximum(z, 1e-3)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy, self.fx * self.baseline_mm / z], axis=1)

    def slopes_by_point(self, points_mm: Reals) -> Reals:
        """[M, 3, 3] derivative of the measurements by the points."""
        x, y, z = points_mm.T
        z = np.maximum(z, 1e-3)
        slopes = np.zeros((len(z), 3, 3))
        slopes[:, 0, 0], slopes[:, 0, 2] = self.fx / z, -self.fx * x / z**2
        slopes[:, 1, 1], slopes[:, 1, 2] = self.fy / z, -self.fy * y / z**2
        slopes[:, 2, 2] = -self.fx * self.baseline_mm / z**2
        return slopes

    def slopes(self, points_mm: Reals) -> Reals:
        """[M, 3, 6] derivative of the measurements by a twist of the points."""
        by_point = self.slopes_by_point(points_mm)
        x, y, z = points_mm.T
        turn = np.zeros((len(z), 3, 3))  # d(w x p)/dw = -cross(p)
        turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = z, -y, x
        turn -= turn.transpose(0, 2, 1)
        return np.concatenate([by_point, by_point @ turn], axis=2)


@dataclass(frozen=True)
class Aligned:
    """A motion [4, 4] of one frame's points into another frame's camera axes, and how well it explains the matches.

    residual_px [M]     length of each match's residual
    weight      [M]     robust weight of each match
    """

    motion: Reals
    residual_px: Reals
    weight: Reals


def align(camera: StereoCamera, before: Reals, after: Reals, trust: Reals, start: Reals) -> Aligned:
    """The rigid motion that takes measurements before [M, 3] to those after [M, 3].

    Iteratively reweighted least squares with Geman-McClure weights. The scale follows the median residual, and
    at least halves per step down to MAX_SCALE_PX, so that a poor start does not lock onto matches that fit by chance.
    trust [M] multiplies the weights; start [4, 4] is the initial estimate.
    """
    points = camera.points_mm(before)
    motion, there = start, camera.slopes(camera.points_mm(after))
    damping = np.diag([1e-6] * 3 + [1e-3] * 3)
    largest_px = float("inf")
    for _ in range(STEPS):
        moved = points @ motion[:3, :3].T + motion[:3, 3]
        off = camera.seen(moved) - after
        squared = np.square(off).sum(1)
        scale_px = np.clip(2 * np.sqrt(weighted_median(squared, trust)), MIN_SCALE_PX, largest_px)
        weight = trust / np.square(1 + squared / scale_px**2)
        largest_px = max(scale_px / 2, MAX_SCALE_PX)
        slopes = there
        weighted = slopes * weight[:, None, None]
        normal = np.einsum("mki,mkj->ij", weighted, slopes)
        step = -np.linalg.solve(normal + damping, np.einsum("mki,mk->i", weighted, off))
        step /= max(1.0, *np.abs(step / LONGEST))
        motion = exp(step) @ motion
        if np.linalg.norm(step * [1, 1, 1, 100, 100, 100]) < CONVERGED:
            break
    u, _, vt = np.linalg.svd(motion[:3, :3])
    motion[:3, :3] = u @ vt  # re-orthonormalise: rounding errors would double from frame to frame
    return Aligned(motion, np.sqrt(squared), weight)


def weighted_median(values: Reals, weight: Reals) -> float:
    """The median of values [M] with weights [M]; 0 if nothing has weight."""
    order = np.argsort(values)
    course = np.cumsum(weight[order])
    if not len(course) or course[-1] <= 0:
        return 0.0
    return float(values[order[np.searchsorted(course, course[-1] / 2)]])
