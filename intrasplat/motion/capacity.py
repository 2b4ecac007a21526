"""Model size that the scene needs: the number of bases, and the distance between Gaussians at the start.

Both choices minimise the expected squared error of the picture, in squared grey levels (of 255) per channel of a tissue
pixel. They use training frames alone and precede training (docs/decisions/motion.md).

Symbols: B bases.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.machine.cores import cores
from intrasplat.motion.tracks import Tracks, resting
from intrasplat.motion.trials import CELLS, BasisValues, FitError, Trial, mean_error, mean_picture_error

BASES = (3, 5, 9, 13, 17, 25, 33, 49, 65, 97, 129, 161, 193)
"""Numbers of bases to choose from, besides REST."""
REST = 1
"""One basis is a constant: neither motion nor illumination of the scene changes."""
FRAMES_A_BASIS = 3
"""Training frames per basis if too few tracks are reliable for cross-validation."""
MIN_FRAMES_A_BASIS = 2
"""Each basis has more training frames than this. With fewer, the model overfits: held-out frames get worse."""
USUAL_BASES, LONG_FRAMES_A_BASIS = 33, 4
"""Beyond USUAL_BASES, each basis needs this many training frames: a model's memory grows with its bases."""
MAX_UNEXPLAINED_MOTION = 0.5
"""No number of bases follows the motion if the best leaves more than this share of what the smallest number leaves."""
MIN_GAIN_DB = 0.25
"""More bases, or more points, must lower the expected error of the picture by more than this."""
MAX_LOSS_DB = 1.5
"""If no number of bases follows the motion, one may leave this much more of it than the best does: its training frames
are sharper."""
MAX_COARSENING = 4
"""Largest stride over the finest stride: changing illumination may reveal detail later."""
MAX_POINTS = 80_000
"""Points per image in the finest grid that was measured."""
TRAINED_SHARE = 0.1
"""Squared error of trained Gaussians, as a share of that of a grid of colours at their starting distance. Measured on a
still clip at 2 to 4 pixels: 0.04 to 0.14."""
MIN_TRIAL_CELLS = 30
MIN_TRIAL_FRAMES = 8
"""With fewer cells or frames, the error in validation frames is meaningless."""


@dataclass(frozen=True)
class BasisChoice:
    """The chosen number and the reason, a text for the report.

    motion_error: error of the motion in validation frames, in squared grey levels, if no number of bases follows it.
    """

    count: int
    reason: str
    motion_error: float | None = None


@dataclass(frozen=True)
class BasisTrials:
    """Error of each number of bases in validation frames; empty if too few tracks are reliable.

    tracked  errors for the tracks
    resting  errors for tracks at rest, if the pictures fit these as well as the tracks; else empty
    """

    tracked: Mapping[int, FitError]
    resting: Mapping[int, FitError] = field(default_factory=dict)

    @property
    def decisive(self) -> Mapping[int, FitError]:
        return self.resting or self.tracked


# bases --------------------------------------------------------------------------------------------------------------


def try_bases(
    tracks: Sequence[Tracks],
    clip: DepthClip,
    train: Sequence[int],
    basis_values: BasisValues,
    max_bases: int | None = None,
) -> BasisTrials:
    """The error of each number of bases up to max_bases, in validation frames. tracks: those of each keyframe.

    Every fourth training frame is a validation frame. Three quarters of B bases are fitted to the tracks in the other
    frames; the error is the fit's difference from the tracks in the validation frames. Each basis has more than
    MIN_FRAMES_A_BASIS training frames.

    The tracks of a single keyframe count as noise if they predict the pictures of the validation frames at most
    MIN_GAIN_DB better than rest does, with the largest number of bases. The result then has `resting`.
    """
    if len(train) < MIN_TRIAL_FRAMES:
        return BasisTrials({})
    cells = CELLS // len(tracks)
    trials = [Trial.of(each, clip, train, basis_values, cells) for each in tracks]
    if sum(len(each.places) for each in trials) < MIN_TRIAL_CELLS:
        return BasisTrials({})
    limit = _bases_limit(len(train), max_bases).count
    numbers = sorted({REST, min(limit, BASES[0]), *(each for each in BASES if each <= limit)})
    with ThreadPoolExecutor(cores()) as pool:
        tracked = dict(zip(numbers, pool.map(partial(mean_error, trials), numbers), strict=True))
    if len(tracks) > 1:  # several keyframes: the camera moved, so no picture rests
        return BasisTrials(tracked)
    at_rest = [Trial.of(resting(tracks[0], clip, train), clip, train, basis_values)]
    if len(at_rest[0].places) < MIN_TRIAL_CELLS:  # instruments cover the tissue: rest cannot be tested
        return BasisTrials(tracked)
    error, error_at_rest = (mean_picture_error(each, numbers[-1]) for each in (trials, at_rest))
    if error_at_rest > error * 10 ** (MIN_GAIN_DB / 10):
        return BasisTrials(tracked)
    return BasisTrials(tracked, {bases: mean_error(at_rest, bases) for bases in numbers})


def choose_bases(trials: BasisTrials, floor: float, frames: int, max_bases: int | None = None) -> BasisChoice:
    """The smallest number of bases whose expected error is within MIN_GAIN_DB of the least.

    The expected error is that in validation frames plus the floor, the error of the Gaussians without motion. `frames`
    is the number of training frames.

    If no number follows the motion, the largest number within MAX_LOSS_DB of the best is chosen: even the best leaves a
    motion error above the floor and above MAX_UNEXPLAINED_MOTION of what the smallest number leaves. Between stills,
    more bases fit each frame and miss those between by more. Changes of illumination do not count, because more bases
    do not model a flickering lamp. Without trials, one basis for every FRAMES_A_BASIS frames.
    """
    errors = trials.tracked
    if not errors:
        most = max_bases or min(BASES[-1], max(USUAL_BASES, _most_bases(frames)))
        bases = min(frames, most, max(BASES[0], -(-frames // FRAMES_A_BASIS)))
        reason = f"one for {frames / bases:.2g} training frames, for too little could be followed to tell more"
        return BasisChoice(bases, reason)
    smallest, limit = min(errors), _bases_limit(frames, max_bases)
    if len(errors) == 1:
        return BasisChoice(smallest, limit.reason)
    if min(each.motion for each in errors.values()) > max(floor, MAX_UNEXPLAINED_MOTION * errors[smallest].motion):
        allowed = min(each.motion for each in errors.values()) * 10 ** (MAX_LOSS_DB / 10)
        most = max(bases for bases, each in errors.items() if each.motion <= allowed)
        why = limit.reason if most == max(errors) else f"more lose over {MAX_LOSS_DB} dB"
        reason = f"{why}, for none that was tried follows the motion in validation frames"
        return BasisChoice(most, reason, errors[most].motion)
    total = {bases: each.total for bases, each in trials.decisive.items()}
    best = min(total, key=lambda each: total[each])
    allowed = (total[best] + floor) * 10 ** (MIN_GAIN_DB / 10)
    bases = min(each for each, error in total.items() if error + floor <= allowed)
    left = ", ".join(f"{each} leave {math.sqrt(total[each] + floor):.2f}" for each in sorted({smallest, bases, best}))
    seen = "no motion shows in the pictures; " if trials.resting else ""
    reason = f"{seen}the fewest within {MIN_GAIN_DB} dB of the best; in validation frames {left} of 255 grey levels"
    return BasisChoice(bases, reason)


def _bases_limit(frames: int, max_bases: int | None) -> BasisChoice:
    """The largest number of bases to try, and what limits it."""
    limits = [
        BasisChoice(BASES[-1], "the most there are to choose from"),
        BasisChoice(max_bases or BASES[-1], "the most that the preset allows"),
        BasisChoice(_most_bases(frames), f"the most that {frames} training frames bear"),
    ]
    return min(limits, key=lambda each: each.count)


def _most_bases(frames: int) -> int:
    """The largest number of bases for this number of training frames."""
    return min((frames - 1) // MIN_FRAMES_A_BASIS, max(USUAL_BASES, frames // LONG_FRAMES_A_BASIS))


# points -------------------------------------------------------------------------------------------------------------


def choose_stride(clip: DepthClip, keys: Sequence[int], finest: int, motion_error: float) -> BasisChoice:
    """The largest stride (px between points) whose expected error in these frames is within MIN_GAIN_DB of the finest.

    It is at most MAX_COARSENING times the finest. motion_error, in squared grey levels, is the error of the motion
    alone.
    """
    errors = {stride: mean_floor_error(clip, keys, stride) for stride in range(finest, MAX_COARSENING * finest + 1)}
    allowed = (errors[finest] + motion_error) * 10 ** (MIN_GAIN_DB / 10)
    stride = max(each for each, error in errors.items() if error + motion_error <= allowed)
    left = ", ".join(
        f"{each} would leave {math.sqrt(errors[each] + motion_error):.1f}"
        for each in (stride, stride + 1)
        if each in errors
    )
    return BasisChoice(stride, f"the most within {MIN_GAIN_DB} dB of {finest}; of 255 grey levels {left}")


def floor_error(clip: DepthClip, index: int, stride: int) -> float:
    """Expected error, in squared grey levels, of one frame's tissue with Gaussians that start stride px apart.

    It is TRAINED_SHARE of the error of a grid of mean colours with linear interpolation between them.
    """
    height, width = clip.tissue.shape[1:]
    few = (max(1, round(width / stride)), max(1, round(height / stride)))
    tissue = clip.tissue[index].astype(np.float32)
    weight = np.maximum(cv2.resize(tissue, few, interpolation=cv2.INTER_AREA), 1e-6)
    image = clip.rgb[index].astype(np.float32)
    mean = cv2.resize(image * tissue[..., None], few, interpolation=cv2.INTER_AREA) / weight[..., None]
    missed = (cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR) - image)[clip.tissue[index]]
    return TRAINED_SHARE * float(np.square(missed).mean()) if missed.size else 0.0


def mean_floor_error(clip: DepthClip, keys: Sequence[int], stride: int) -> float:
    """Mean of floor_error over these frames."""
    return sum(floor_error(clip, index, stride) for index in keys) / len(keys)
