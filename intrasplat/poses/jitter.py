"""Jitter in given poses, and the same path without it.

The path found in the pictures is precise from frame to frame, to a tenth of a millimetre, but may drift as a whole
(intrasplat/poses/common_motion.py). Given poses may jitter but do not drift. So a slowly changing motion aligns the
found path with the given one.

Symbols: T frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.poses.rigid import Reals, exp, inverse, log
from intrasplat.poses.trajectory import ARM_MM

MIN_JITTER = 0.0015
"""Jitter from which given poses are smoothed, as a share of the picture's width: 1 px of 640."""
MAX_JITTER = 0.003
"""Jitter that harms the model, as a share of the picture's width: 2 px of 640."""
ROUGHNESS = (1.0, 1.6)
"""Second difference over first, and third over second. Independent errors have 1.7 and 1.8, a shaking hand 0.6 and 1.5.
The second ratio detects errors beside a fast motion."""
AVERAGE = np.sqrt(6) * np.sqrt(8 / (3 * np.pi))
"""Mean norm of the second difference over the deviation per pose, for independent errors on three axes."""
MIN_RUNS = 2
WINDOWS, ORDER = (5, 7, 9, 15, 21, 31), 2
"""Windows, in frames, and polynomial order of the Savitzky-Golay filters that are tried."""


def jitter_mm(clip: DepthClip, train: Sequence[int]) -> tuple[float, float]:
    """The error of each pose at the tissue, for independent errors, and the tissue's median depth, both in mm.

    Measured at the point on the optical axis at that depth: errors of position and of rotation both move it.
    (0, 0) if it moves from frame to frame as smoothly as with a real camera.
    """
    wanted, pose = set(train), clip.world_from_camera
    runs = [index for index in train if {index - 1, index + 1, index + 2} <= wanted]
    if (pose == pose[:1]).all():
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
    """A path [T, 4, 4] without jitter; the jitter against the found path, and what is left of it, both in mm."""

    world_from_camera: Reals
    jumps_mm: float
    left_mm: float


def steadied(given: Reals, found: Reals, unsure: Sequence[int]) -> Steadied:
    """The given path [T, 4, 4] without jitter: the found path, moved by the smoothed motion between the two paths.

    That motion is slow drift plus jitter; its second differences measure the jitter. A Savitzky-Golay filter smooths
    it. The window is the one with the least expected error: jitter that passes plus drift that the filter loses, as
    leave-one-out prediction shows it. Unsure frames keep their given pose, and so does a clip too short.
    """
    from scipy.signal import savgol_coeffs, savgol_filter  # takes long, and few processes need it

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
    """Mean squared displacement by twists [N, 6] at a distance of ARM_MM, mm^2."""
    return float(np.square(twists * np.repeat([1.0, ARM_MM], 3)).sum(1).mean())
