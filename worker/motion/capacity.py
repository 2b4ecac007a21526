"""How large a model the scene needs: how many bases its motion has, and how far apart its Gaussians start.

Both are decided before training, from training frames alone, by the squared error of the picture each is expected to
leave, in squared grey levels (of 255) a channel of a tissue pixel.

Symbols: B bases.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from worker.input.clip import DepthClip
from worker.motion.tracks import Tracks, resting
from worker.motion.trials import BasisValues, Missed, Trial

BASES = (3, 5, 9, 13, 17, 25, 33)
"""Numbers of bases to choose from, besides REST."""
REST = 1
"""One basis is a constant: a scene that neither moves nor changes its light needs no more."""
FRAMES_A_BASIS = 3
"""Training frames a basis stands for where nothing could be followed."""
FOLLOWED = 0.5
"""Share of the fewest bases' error in motion that has to go with more bases, or no number follows it."""
MORE_FRAMES_THAN = 2
"""Each basis has more training frames than this: where it has fewer, they gain what held-out frames lose."""
WORTH_DB = 0.25
"""More bases have to lower the expected error of the picture by more than this."""
COARSEST = 4
"""Points are at most so many times as far apart as in the finest grid: what is flat at first may be lit later."""
MOST_POINTS = 80_000
"""An image, where the scene decides: the finest grid that was measured."""
TRAINED_SHARE = 0.1
"""Gaussians that are trained leave about a tenth of the squared error of a grid of colours as fine as they start:
they place and shape themselves. Measured on a still clip at 2 to 4 pixels, where 0.04 to 0.14 were left."""
FEWEST_CELLS_TO_TRY = 30
FEWEST_FRAMES_TO_TRY = 8
"""Below either, leaving frames out says nothing."""


@dataclass(frozen=True)
class Choice:
    """A number and why, in words for the report."""

    count: int
    reason: str


@dataclass(frozen=True)
class Tried:
    """What each number of bases would leave in frames it was not fitted to; empty where too little could be followed.

    tracked  of the tracks
    resting  of tracks at rest, where they say as much of the pictures as the tracks do; else empty
    """

    tracked: Mapping[int, Missed]
    resting: Mapping[int, Missed] = field(default_factory=dict)

    @property
    def believed(self) -> Mapping[int, Missed]:
        return self.resting or self.tracked


# bases --------------------------------------------------------------------------------------------------------------


def try_bases(
    tracks: Tracks, clip: DepthClip, train: Sequence[int], basis_values: BasisValues, most: int | None = None
) -> Tried:
    """What each number of bases that the training frames bear, up to most, would leave in frames it was not fitted to.

    Every fourth training frame is left out, the tracks of the others are fitted by three quarters of B bases, and the
    fit is compared with the tracks in those left out. Frames bear as many bases as leave each more than
    MORE_FRAMES_THAN of them. Tracks are noise where the pictures left out come no more than WORTH_DB nearer along them,
    fitted by the most bases, than they come at rest.
    """
    if len(train) < FEWEST_FRAMES_TO_TRY:
        return Tried({})
    trial, at_rest = (Trial.of(each, clip, train, basis_values) for each in (tracks, resting(tracks, clip, train)))
    if len(trial.places) < FEWEST_CELLS_TO_TRY:
        return Tried({})
    cap = _cap(len(train), most).count
    numbers = sorted({REST, min(cap, BASES[0]), *(each for each in BASES if each <= cap)})
    tracked = {bases: trial.missed(bases) for bases in numbers}
    if len(at_rest.places) < FEWEST_CELLS_TO_TRY:  # tissue that is hardly ever seen alone in place says nothing of rest
        return Tried(tracked)
    if at_rest.picture_error(numbers[-1]) > trial.picture_error(numbers[-1]) * 10 ** (WORTH_DB / 10):
        return Tried(tracked)
    return Tried(tracked, {bases: at_rest.missed(bases) for bases in numbers})


def choose_bases(tried: Tried, floor: float, frames: int, most: int | None = None) -> Choice:
    """The fewest bases whose expected error, on top of the floor that the Gaussians leave, is within WORTH_DB of the
    least; frames is the number of training frames.

    The most, where several numbers were tried and none follows the motion: even the best leaves more of it than the
    Gaussians do, and more than FOLLOWED of what the fewest bases leave. Light that nothing follows, such as a lamp
    that flickers, asks for no more bases. Where nothing was tried one for every FRAMES_A_BASIS frames, at most `most`.
    """
    errors = tried.tracked
    if not errors:
        bases = min(frames, most or BASES[-1], max(BASES[0], -(-frames // FRAMES_A_BASIS)))
        reason = f"one for {frames / bases:.2g} training frames, for too little could be followed to tell more"
        return Choice(bases, reason)
    fewest, cap = min(errors), _cap(frames, most)
    if len(errors) == 1:
        return Choice(fewest, cap.reason)
    if min(each.motion for each in errors.values()) > max(floor, FOLLOWED * errors[fewest].motion):
        return Choice(max(errors), f"{cap.reason}, for none that was tried follows the motion in frames left out")
    total = {bases: each.total for bases, each in tried.believed.items()}
    best = min(total, key=lambda each: total[each])
    allowed = (total[best] + floor) * 10 ** (WORTH_DB / 10)
    bases = min(each for each, error in total.items() if error + floor <= allowed)
    left = ", ".join(f"{each} leave {math.sqrt(total[each] + floor):.2f}" for each in sorted({fewest, bases, best}))
    seen = "no motion shows in the pictures; " if tried.resting else ""
    reason = f"{seen}the fewest within {WORTH_DB} dB of the best; in frames left out {left} of 255 grey levels"
    return Choice(bases, reason)


def _cap(frames: int, most: int | None) -> Choice:
    """The most bases that may be tried, and what says so."""
    limits = [
        Choice(BASES[-1], "the most there are to choose from"),
        Choice(most or BASES[-1], "the most that the preset allows"),
        Choice((frames - 1) // MORE_FRAMES_THAN, f"the most that {frames} training frames bear"),
    ]
    return min(limits, key=lambda each: each.count)


def choose_stride(clip: DepthClip, index: int, finest: int, least_error: float) -> Choice:
    """Pixels between points: the most, up to COARSEST times the finest, whose expected error is within WORTH_DB of the
    finest's; least_error is what the motion leaves whatever the points, squared grey levels."""
    errors = {stride: floor_error(clip, index, stride) for stride in range(finest, COARSEST * finest + 1)}
    allowed = (errors[finest] + least_error) * 10 ** (WORTH_DB / 10)
    stride = max(each for each, error in errors.items() if error + least_error <= allowed)
    left = ", ".join(
        f"{each} would leave {math.sqrt(errors[each] + least_error):.1f}"
        for each in (stride, stride + 1)
        if each in errors
    )
    return Choice(stride, f"the most within {WORTH_DB} dB of {finest}; of 255 grey levels {left}")


def floor_error(clip: DepthClip, index: int, stride: int) -> float:
    """What Gaussians that start stride px apart leave of the frame's tissue, whatever moves: squared grey levels.

    TRAINED_SHARE of the error of a grid of mean colours with linear interpolation between them.
    """
    height, width = clip.tissue.shape[1:]
    few = (max(1, round(width / stride)), max(1, round(height / stride)))
    tissue = clip.tissue[index].astype(np.float32)
    weight = np.maximum(cv2.resize(tissue, few, interpolation=cv2.INTER_AREA), 1e-6)
    image = clip.rgb[index].astype(np.float32)
    mean = cv2.resize(image * tissue[..., None], few, interpolation=cv2.INTER_AREA) / weight[..., None]
    missed = (cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR) - image)[clip.tissue[index]]
    return TRAINED_SHARE * float(np.square(missed).mean()) if missed.size else 0.0
