"""What of the common motion is the camera's and what the tissue's.

If all tissue in view moved rigidly, no picture could tell it from a camera that moves the other way. Tissue that
breathes or is pulled never does: its deformation has a course in time, and what of the camera's path follows that very
course is taken to be the tissue's (a rigid motion sum_s g_s h_s(t)), as far as the camera's path gets simpler by it. A
path is simple if it is likely under a Gaussian process: a smooth trend, slower than the deformation, and a shake.

Symbols: K frames, S courses h_s of the deformation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from intrasplat.poses.rigid import Reals, cross, exp, log

RIGID_PER_BENT = 3.0
"""Standard deviation of the tissue's rigid motion over the size of its deformation of the same course."""
NOISE_MM = 0.05
SLOW, QUICK = 0.6, 0.25
"""Least length of the trend and largest of the shake, over the deformation's period."""
USUAL_MM, USUAL_SHAKE_MM, USUAL_QUICK = 5.0, 0.3, 0.12
"""Of the path: size of the trend and of the shake; the shake's length over the deformation's period. The trend's usual
length is that period."""
UNUSUAL = np.array([2.0, 1.0, 1.5, 1.0])
"""Standard deviations of the logarithms of the trend's size and length and of the shake's."""
STARTS = ((0.5, 0.2), (0.5, 2.0), (2.0, 0.2), (2.0, 2.0))
"""Times the usual length of the trend and the usual size of the shake: where the search for the likeliest begins."""
SEARCHED = 48
"""Frames, spread over the clip, on which that search looks."""
TRIALS, ROUNDS = 150, 3
MIN_FURTHER = 0.25
"""Periods beyond the first that a clip is taken to show, at least."""


@dataclass(frozen=True, eq=False)
class Gauged:
    """Cameras after the tissue's rigid motion was given back to it.

    poses    [K, 4, 4] world_from_camera; the first is as it was
    tissue   [K, 4, 4] the rigid motion that was given to the tissue, 1 in the first frame
    covariance  [6 K, 6 K]  of the cameras' places (mm) and turns (radians) by this choice
    first    [S]       the courses in the first frame
    given    [S, 6]    (mm, radians) about pivot_mm [3] for a course of 1
    """

    poses: Reals
    tissue: Reals
    covariance: Reals
    first: Reals
    given: Reals
    pivot_mm: Reals

    def tissue_at(self, course: Reals) -> Reals:
        """The tissue's rigid motion [4, 4] where the courses are [S]."""
        return np.asarray(_moved(np.eye(4)[None], (course - self.first)[None], self.given, self.pivot_mm)[0])


def gauged(poses: Reals, frames: Reals, courses: Reals, bent_mm: Reals, pivot_mm: Reals, half_mm: float) -> Gauged:
    """The cameras whose path is simplest.

    Args:
        poses: [K, 4, 4] world_from_camera, mm.
        frames: [K] indices in the clip.
        courses: [K, S] of the deformation, of any unit.
        bent_mm: [S] size of the deformation for a course of 1, mm.
        pivot_mm: [3] the middle of the tissue seen.
        half_mm: half the extent of a view: what a turn moves at its border.
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
    for _ in range(ROUNDS):  # the path is nearly linear in what the tissue is given
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
    covariance *= (periods / max(periods - 1, MIN_FURTHER)) ** 2  # what is likely was learnt from this clip alone
    slopes = _slopes(now[:, :3, 3] - pivot_mm, h, 1.0).reshape(6 * count, -1)
    tissue = _moved(still, h, given, pivot_mm)
    return Gauged(now, tissue, slopes @ covariance @ slopes.T, courses[0], given, pivot_mm)


def _period(frames: Reals, sized: Reals) -> float:
    """Typical frames from one turn of the courses [K, S] to the next: that of a sine of their size and slope."""
    slope = np.diff(sized, axis=0) / np.diff(frames)[:, None]
    spread = np.square(sized - sized.mean(0)).mean(0).sum()
    return float(2 * np.pi * np.sqrt(spread / max(np.square(slope).mean(0).sum(), 1e-12)))


def _path(poses: Reals, far_mm: float) -> Reals:
    """[K, 6] places in mm, and turns as what they move far_mm away."""
    return np.concatenate([poses[:, :3, 3], far_mm * np.stack([log(pose)[3:] for pose in poses])], axis=1)


def _moved(poses: Reals, h: Reals, given: Reals, pivot_mm: Reals) -> Reals:
    """The cameras moved by the tissue's rigid motion."""
    twists = h @ given
    twists[:, :3] -= np.cross(twists[:, 3:], pivot_mm)
    return np.stack([exp(twist) @ pose for twist, pose in zip(twists, poses, strict=True)])


def _slopes(arm_mm: Reals, h: Reals, far_mm: float) -> Reals:
    """[K, 6, S 6] derivative of the path by the tissue's rigid motion. arm_mm [K, 3] from the pivot to the cameras."""
    by_twist = np.zeros((len(h), 6, 6))
    by_twist[:, :3, :3], by_twist[:, 3:, 3:] = np.eye(3), far_mm * np.eye(3)
    for each, arm in zip(by_twist, arm_mm, strict=True):
        each[:3, 3:] = -cross(arm)
    return np.asarray(np.einsum("ks,kci->kcsi", h, by_twist).reshape(len(h), 6, -1))


def _likeliest(path: Reals, frames: Reals, sized: Reals, period: float) -> Reals:
    """[K, K] covariance of one coordinate of the camera's path [K]: the likeliest, whatever the tissue did.

    sized: [K, S] courses times the standard deviation of what the tissue may do.
    """
    some = np.unique(np.linspace(0, len(frames) - 1, SEARCHED).round().astype(np.intp))
    tissue, path = sized[some] @ sized[some].T, path[some] - path[some].mean()
    usual = np.log([USUAL_MM, period, USUAL_SHAKE_MM, USUAL_QUICK * period])

    def covariance(logs: Reals, at: Reals) -> Reals:
        apart = np.abs(at[:, None] - at)
        size, slow, shake, quick = np.exp(logs)
        slow, quick = max(slow, SLOW * period), min(quick, QUICK * period)
        trend = size**2 * np.exp(-np.square(apart / slow) / 2)
        near = np.sqrt(3) * apart / quick
        anywhere = 1e4
        found = trend + shake**2 * (1 + near) * np.exp(-near) + NOISE_MM**2 * np.eye(len(at)) + anywhere
        return np.asarray(found)

    def unlikely(logs: Reals) -> float:
        root = np.linalg.cholesky(covariance(logs, frames[some]) + tissue)
        white = np.linalg.solve(root, path)
        unusual = np.square((logs - usual) / UNUSUAL).sum()
        return float(white @ white / 2 + np.log(np.diag(root)).sum() + unusual / 2)

    starts = [usual + np.log([1, length, shake, 1]) for length, shake in STARTS]
    ends = [minimize(unlikely, start, method="Nelder-Mead", options={"maxiter": TRIALS}) for start in starts]
    return covariance(min(ends, key=lambda end: end.fun).x, frames)
