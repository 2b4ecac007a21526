"""Given poses that jump to and fro, and the same path without the jumps.

The pictures place each frame among its neighbours to a tenth of a millimetre, but leave open where the whole path goes
(intrasplat/poses/common_motion.py); given poses err the other way. So the path that was found is laid on the given one
by a motion that changes slowly.

Symbols: T frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from intrasplat.clip import DepthClip
from intrasplat.poses.rigid import Reals, exp, inverse, log
from intrasplat.poses.trajectory import ARM_MM

MIN_JITTER = 0.0015
"""Of the picture's width: how far given poses must jump to be steadied, 1 px of 640."""
MAX_JITTER = 0.003
"""Of the picture's width: jumps that harm the model, 2 px of 640."""
ROUGHNESS = (1.0, 1.6)
"""Change of step over step, and third difference over change of step: independent errors have 1.7 and 1.8, a hand that
shakes 0.6 and 1.5. The second notices errors beside a fast motion."""
AVERAGE = np.sqrt(6) * np.sqrt(8 / (3 * np.pi))
"""Mean change of step over the deviation of each pose, over its three axes, if poses err independently."""
MIN_RUNS = 2
WINDOWS, ORDER = (5, 7, 9, 15, 21, 31), 2
"""Frames over which the motion between both paths may be smoothed, by a polynomial of this order."""


def jitter_mm(clip: DepthClip, train: Sequence[int]) -> tuple[float, float]:
    """By how much a frame's pose errs at the tissue if poses err independently, and the tissue's depth, both in mm.

    Looked at is the point on the optical axis at the tissue's median depth, which errors of place and of angle move.
    (0, 0) if it moves as smoothly from frame to frame as that of a camera does.
    """
    wanted, pose = set(train), clip.world_from_camera
    runs = [index for index in train if {index - 1, index + 1, index + 2} <= wanted]
    if (pose == pose[:1]).all():  # the camera stands still
        return 0.0, 0.0
    depths = (clip.depth_mm[index][clip.tissue[index] & (clip.depth_mm[index] > 0)] for index in clip.one_by_one(runs))
    known = [float(np.median(each)) for each in depths if each.size]
    if len(runs) < MIN_RUNS or not known:
        return 0.0, 0.0
    depth_mm = float(np.median(known))
    looked_at = pose[:, :3, 3] + depth_mm * pose[:, :3, 2]
    step, change, third = (
        np.linalg.norm(np.diff(looked_at, order, axis=0)[np.array(runs) - order // 2], axis=1).mean()
        for order in (1, 2, 3)
    )
    if change < ROUGHNESS[0] * step and third < ROUGHNESS[1] * change:
        return 0.0, 0.0
    return float(change) / AVERAGE, depth_mm


@dataclass(frozen=True, eq=False)
class Steadied:
    """A path [T, 4, 4] without its jumps; by how much it jumps against what the pictures show, and what is left, mm."""

    world_from_camera: Reals
    jumps_mm: float
    left_mm: float


def steadied(given: Reals, found: Reals, unsure: Sequence[int]) -> Steadied:
    """The given path [T, 4, 4] without its jumps: the found one, moved by what lies between both over some frames.

    What lies between changes slowly but for the jumps, which its second differences show. The window of a
    Savitzky-Golay filter is the one that leaves least of them and follows the slow part best, by how well it predicts a
    frame from the others. Frames whose place was not found stay where they were given; so does a clip too short.
    """
    count = len(given)
    sure = np.setdiff1d(np.arange(count), unsure)
    between = np.stack([log(one @ inverse(two)) for one, two in zip(given, found, strict=True)])
    between = np.stack([np.interp(np.arange(count), sure, each[sure]) for each in between.T], axis=1)
    jumps = _squared(np.diff(between, 2, axis=0)) / 6
    best, steady = jumps, given
    for window in WINDOWS:
        if window > count / 2:
            break
        smooth, own = savgol_filter(between, window, ORDER, axis=0), savgol_coeffs(window, ORDER)[window // 2]
        lag = _squared((between - smooth) / (1 - own)) - jumps / (1 - own)
        if (left := jumps * own + max(lag, 0.0)) < best:
            best, steady = left, np.stack([exp(twist) @ pose for twist, pose in zip(smooth, found, strict=True)])
    steady[list(unsure)] = given[list(unsure)]
    return Steadied(steady, float(np.sqrt(jumps)), float(np.sqrt(best)))


def _squared(twists: Reals) -> float:
    """Mean square of what twists [N, 6] move at the tissue, mm^2."""
    return float(np.square(twists * np.repeat([1.0, ARM_MM], 3)).sum(1).mean())
