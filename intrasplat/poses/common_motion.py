"""Splits the rigid motion that camera and tissue have in common into a part of the camera and a part of the tissue.

Pictures show only relative motion: rigid tissue motion looks like the opposite camera motion. Tissue that breathes or
is pulled also deforms, and the deformation has a time course. The part of the camera path that follows that course is
assigned to the tissue, as a rigid motion sum_s g_s h_s(t), as far as the camera path becomes more likely by it. The
prior of the path is a Gaussian process: a smooth trend, slower than the deformation, and a shake.

Symbols: K frames; S time courses of the deformation; h [K, S] the courses minus their values in the first frame;
given [S, 6] the estimate of g, mm and radians; now [K, 4, 4] the cameras for that estimate; sized [K, S] courses in
units of the path, mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from intrasplat.poses.rigid import Reals, cross, exp, log

RIGID_PER_BENT = 3.0
"""Prior standard deviation of the tissue's rigid motion, relative to its deformation of the same course."""
NOISE_MM = 0.05
ANYWHERE_MM2 = 1e4
"""Prior variance of a constant offset: where the path lies as a whole does not matter."""
SLOW, QUICK = 0.6, 0.25
"""Minimum length scale of the trend and maximum of the shake, as a share of the deformation's period."""
USUAL_MM, USUAL_SHAKE_MM, USUAL_QUICK = 5.0, 0.3, 0.12
"""Prior medians: size of the trend, size of the shake, and length scale of the shake as a share of the deformation's
period. The trend's median length scale is that period."""
UNUSUAL = np.array([2.0, 1.0, 1.5, 1.0])
"""Prior standard deviations of the logarithms of the trend's size and length scale, and of the shake's."""
STARTS = ((0.5, 0.2), (0.5, 2.0), (2.0, 0.2), (2.0, 2.0))
"""Starts of the search for the likeliest path prior: factors on the trend's length scale and on the shake's size."""
SEARCHED = 48
"""Frames, spread over the clip, that this search uses."""
TRIALS, ROUNDS = 150, 3
MIN_FURTHER = 0.25
"""A clip counts as showing at least this many periods beyond the first."""


@dataclass(frozen=True, eq=False)
class Gauged:
    """Cameras without the rigid motion that is assigned to the tissue.

    poses       [K, 4, 4]   world_from_camera; the first is unchanged
    tissue      [K, 4, 4]   the rigid motion assigned to the tissue; the identity in the first frame
    covariance  [6 K, 6 K]  of camera positions (mm) and rotations (radians) that this split adds
    first       [S]         the courses in the first frame
    given       [S, 6]      rigid motion (mm, radians) about pivot_mm [3] for a course of 1
    """

    poses: Reals
    tissue: Reals
    covariance: Reals
    first: Reals
    given: Reals
    pivot_mm: Reals

    def tissue_at(self, course: Reals) -> Reals:
        """The tissue's rigid motion [4, 4] for course values [S]."""
        return np.asarray(_moved(np.eye(4)[None], (course - self.first)[None], self.given, self.pivot_mm)[0])


def gauged(poses: Reals, frames: Reals, courses: Reals, bent_mm: Reals, pivot_mm: Reals, half_mm: float) -> Gauged:
    """The cameras whose path is the likeliest, and the rigid motion that the tissue then has.

    Args:
        poses: [K, 4, 4] world_from_camera, mm.
        frames: [K] indices in the clip.
        courses: [K, S] time courses of the deformation, in any unit.
        bent_mm: [S] size of the deformation for a course of 1, mm.
        pivot_mm: [3] the middle of the visible tissue.
        half_mm: half the width of the view at the tissue, which converts rotations to mm.
    """
    count, kinds = courses.shape
    still = np.tile(np.eye(4), (count, 1, 1))
    if not kinds:
        return Gauged(poses, still, np.zeros((6 * count, 6 * count)), np.zeros(0), np.zeros((0, 6)), pivot_mm)
    far_mm = float(np.linalg.norm(pivot_mm))
    h = courses - courses[:1]
    sigma = np.outer(bent_mm * RIGID_PER_BENT, np.repeat([1.0, 1 / half_mm], 3))  # [S, 6]
    sizes = sigma * np.repeat([1.0, far_mm], 3)
    period = _period(frames, courses * bent_mm)
    path = _path(poses, far_mm)
    precisions = [np.linalg.inv(_likeliest(path[:, c], frames, courses * sizes[:, c], period)) for c in range(6)]
    given, now = np.zeros((kinds, 6)), poses
    for _ in range(ROUNDS):  # Gauss-Newton: the path is nearly linear in `given`
        slopes = _slopes(now[:, :3, 3] - pivot_mm, h, far_mm)  # [K, 6, S 6]
        path = _path(now, far_mm)
        normal, right = np.diag(1 / np.square(sigma.ravel())), -given.ravel() / np.square(sigma.ravel())
        for c, precision in enumerate(precisions):
            weighted = slopes[:, c].T @ precision
            normal += weighted @ slopes[:, c]
            right -= weighted @ path[:, c]
        covariance = np.linalg.inv(normal)
        given = given + (covariance @ right).reshape(kinds, 6)
        now = _moved(poses, h, given, pivot_mm)
    periods = (frames[-1] - frames[0]) / period
    covariance *= (periods / max(periods - 1, MIN_FURTHER)) ** 2  # few periods tell little of the prior fitted to them
    slopes = _slopes(now[:, :3, 3] - pivot_mm, h, 1.0).reshape(6 * count, -1)
    tissue = _moved(still, h, given, pivot_mm)
    return Gauged(now, tissue, slopes @ covariance @ slopes.T, courses[0], given, pivot_mm)


def _period(frames: Reals, sized: Reals) -> float:
    """Typical period, in frames, of the courses [K, S]: that of a sine of the same variance and mean squared slope."""
    slope = np.diff(sized, axis=0) / np.diff(frames)[:, None]
    spread = np.square(sized - sized.mean(0)).mean(0).sum()
    return float(2 * np.pi * np.sqrt(spread / max(np.square(slope).mean(0).sum(), 1e-12)))


def _path(poses: Reals, far_mm: float) -> Reals:
    """[K, 6] positions in mm, and rotations in mm of arc at the distance far_mm."""
    return np.concatenate([poses[:, :3, 3], far_mm * np.stack([log(pose)[3:] for pose in poses])], axis=1)


def _moved(poses: Reals, h: Reals, given: Reals, pivot_mm: Reals) -> Reals:
    """The cameras [K, 4, 4] moved by the tissue's rigid motion h @ given about the pivot."""
    twists = h @ given
    twists[:, :3] -= np.cross(twists[:, 3:], pivot_mm)
    return np.stack([exp(twist) @ pose for twist, pose in zip(twists, poses, strict=True)])


def _slopes(arm_mm: Reals, h: Reals, far_mm: float) -> Reals:
    """[K, 6, S 6] derivative of the path by `given`. arm_mm [K, 3]: from the pivot to the cameras."""
    by_twist = np.zeros((len(h), 6, 6))
    by_twist[:, :3, :3], by_twist[:, 3:, 3:] = np.eye(3), far_mm * np.eye(3)
    for each, arm in zip(by_twist, arm_mm, strict=True):
        each[:3, 3:] = -cross(arm)
    return np.asarray(np.einsum("ks,kci->kcsi", h, by_twist).reshape(len(h), 6, -1))


def _likeliest(path: Reals, frames: Reals, sized: Reals, period: float) -> Reals:
    """[K, K] prior covariance of one coordinate of the camera's path [K]: the likeliest, tissue motion marginalised.

    sized: [K, S] courses times the prior standard deviation of the tissue's rigid motion.
    """
    some = np.unique(np.linspace(0, len(frames) - 1, SEARCHED).round().astype(np.intp))
    tissue, path = sized[some] @ sized[some].T, path[some] - path[some].mean()
    usual = np.log([USUAL_MM, period, USUAL_SHAKE_MM, USUAL_QUICK * period])

    def covariance(logs: Reals, apart: Reals) -> Reals:
        size, slow, shake, quick = np.exp(logs)
        slow, quick = max(slow, SLOW * period), min(quick, QUICK * period)
        trend = size**2 * np.exp(np.square(apart) * (-0.5 / slow**2))
        near = apart * (np.sqrt(3) / quick)
        found = trend + shake**2 * (1 + near) * np.exp(-near)
        found += ANYWHERE_MM2
        found[np.diag_indices(len(apart))] += NOISE_MM**2
        return np.asarray(found)

    apart = np.abs(frames[some, None] - frames[some])
    bordered = np.empty((len(some) + 1, len(some) + 1))
    bordered[-1, :-1], bordered[-1, -1] = path, 1 + path @ path / NOISE_MM**2

    def unlikely(logs: Reals) -> float:
        bordered[:-1, :-1] = covariance(logs, apart) + tissue
        root = np.linalg.cholesky(bordered)  # its last row solves root[:-1, :-1] white = path
        white = root[-1, :-1]
        unusual = np.square((logs - usual) / UNUSUAL).sum()
        return float(white @ white / 2 + np.log(np.diag(root)[:-1]).sum() + unusual / 2)

    starts = [usual + np.log([1, length, shake, 1]) for length, shake in STARTS]
    ends = [minimize(unlikely, start, method="Nelder-Mead", options={"maxiter": TRIALS}) for start in starts]
    return covariance(min(ends, key=lambda end: end.fun).x, np.abs(frames[:, None] - frames))
