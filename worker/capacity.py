"""How large a model the scene needs: how many bases its motion has, and how far apart its Gaussians start.

Both are decided before training, from training frames alone, by the squared error of the picture each is expected to
leave, in squared grey levels (of 255) a channel of a tissue pixel.

Symbols: K training frames, n sampled cells of the tracks' grid, B bases, N points, s pixels between points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from worker.clip import DepthClip
from worker.deformation import SharedBasis
from worker.motion import Tracks, cell_means, fit_series

Reals = NDArray[np.float64]

BASES = (3, 5, 9, 13, 17, 25, 33)
"""Numbers of bases to choose from."""
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
CELLS = 1000
"""Tracks on which bases are tried."""
FEWEST_CELLS_TO_TRY = 30
FEWEST_FRAMES_TO_TRY = 8
"""Below either, leaving frames out says nothing."""
TRIED_ON_EVERY, FIRST_TRIED_ON = 4, 2
"""Bases are tried on every fourth training frame, from the third on, and fitted to the others."""
TRUSTED = 0.3
"""Mean confidence a track needs to be tried on."""


@dataclass(frozen=True)
class Choice:
    """A number and why, in words for the report."""

    count: int
    reason: str


@dataclass(frozen=True)
class Missed:
    """What a number of bases would leave in frames it was not fitted to, squared grey levels: of motion, by which the
    picture changes where the track starts, and of light, the change of colour along the track."""

    motion: float
    light: float

    @property
    def total(self) -> float:
        return self.motion + self.light


# bases --------------------------------------------------------------------------------------------------------------


def errors_by_bases(
    tracks: Tracks, clip: DepthClip, train: Sequence[int], most: int | None = None
) -> dict[int, Missed]:
    """What each number of bases that the training frames bear, up to most, would leave in frames it was not fitted to.

    Every fourth training frame is left out, the tracks of the others are fitted by three quarters of B bases, and the
    fit is compared with the tracks in those left out. Frames bear as many bases as leave each more than
    MORE_FRAMES_THAN of them. Empty where too little could be followed.
    """
    if len(train) < FEWEST_FRAMES_TO_TRY:
        return {}
    series, confidence = _series(tracks, clip, train[0])
    if series.shape[1] < FEWEST_CELLS_TO_TRY:
        return {}
    left_out = np.zeros(len(train), np.bool_)
    left_out[FIRST_TRIED_ON::TRIED_ON_EVERY] = True
    times = np.array([float(clip.t[index]) for index in train])
    share = 1 - left_out.mean()
    cap = _cap(len(train), most).count
    return {
        bases: _missed(series, confidence, times, left_out, max(2, round(share * bases)))
        for bases in [each for each in BASES if each <= cap] or [cap]
    }


def choose_bases(errors: Mapping[int, Missed], floor: float, frames: int, most: int | None = None) -> Choice:
    """The fewest bases whose expected error, on top of the floor that the Gaussians leave, is within WORTH_DB of the
    least; errors as from errors_by_bases, frames the number of training frames.

    The most, where several numbers were tried and none follows the motion: even the best leaves more of it than the
    Gaussians do, and more than FOLLOWED of what the fewest bases leave. Light that nothing follows, such as a lamp
    that flickers, asks for no more bases. Without errors one for every FRAMES_A_BASIS frames, at most `most`.
    """
    if not errors:
        bases = min(frames, most or BASES[-1], max(BASES[0], -(-frames // FRAMES_A_BASIS)))
        reason = f"one for {frames / bases:.2g} training frames, for too little could be followed to tell more"
        return Choice(bases, reason)
    fewest, cap = min(errors), _cap(frames, most)
    if len(errors) == 1:
        return Choice(fewest, cap.reason)
    if min(each.motion for each in errors.values()) > max(floor, FOLLOWED * errors[fewest].motion):
        return Choice(max(errors), f"{cap.reason}, for none that was tried follows the motion in frames left out")
    total = {bases: each.total for bases, each in errors.items()}
    best = min(total, key=lambda each: total[each])
    allowed = (total[best] + floor) * 10 ** (WORTH_DB / 10)
    bases = min(each for each, error in total.items() if error + floor <= allowed)
    left = ", ".join(f"{each} leave {math.sqrt(total[each] + floor):.1f}" for each in sorted({fewest, bases, best}))
    return Choice(bases, f"the fewest within {WORTH_DB} dB of the best; in frames left out {left} of 255 grey levels")


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


def _series(tracks: Tracks, clip: DepthClip, reference: int) -> tuple[Reals, Reals]:
    """[K, n, 6] what has to be followed along n tracks, in grey levels, three of displacement and three of colour, and
    [K, n] its confidence."""
    frames, height, width = tracks.confidence.shape
    step, k, pose = tracks.step_px, clip.intrinsics, clip.world_from_camera[reference]
    rows, columns = np.divmod(np.arange(height * width), width)
    pixels = (rows * step + step // 2) * k.width + columns * step + step // 2
    depth_mm = clip.depth_mm[reference].reshape(-1)[pixels]
    trusted = np.flatnonzero((tracks.confidence.mean(0).reshape(-1) > TRUSTED) & (depth_mm > 0))
    some = trusted[np.linspace(0, len(trusted) - 1, min(CELLS, len(trusted))).round().astype(np.intp)]
    confidence = tracks.confidence.reshape(frames, -1)[:, some].astype(np.float64)

    z = depth_mm[some].astype(np.float64)
    right, down, away = pose[:3, :3].T  # camera axes in the world
    across = (columns[some] * step + step // 2 + 0.5 - k.cx) / k.fx
    along = (rows[some] * step + step // 2 + 0.5 - k.cy) / k.fy
    px_per_mm = np.stack(
        [
            k.fx / z[:, None] * (right - across[:, None] * away),
            k.fy / z[:, None] * (down - along[:, None] * away),
        ],
        axis=1,
    )  # [n, 2, 3]
    grey_per_mm = _slopes(clip.rgb[reference], step).reshape(-1, 3, 2)[some] @ px_per_mm
    displacement_mm = tracks.displacement_mm.reshape(frames, -1, 3)[:, some]
    shifted = np.einsum("ncd,knd->knc", grey_per_mm, displacement_mm)
    colour = 255 * tracks.colour.reshape(frames, -1, 3)[:, some]
    return np.concatenate([shifted, colour], axis=2), confidence


def _slopes(rgb: NDArray[np.uint8], step: int) -> Reals:
    """[h, w, 3, 2] grey levels a clip pixel to the right and down, on the tracks' grid of h w cells."""
    small = cell_means(rgb, step).astype(np.float32)
    slopes = [cv2.Scharr(small, cv2.CV_32F, int(axis == 0), int(axis == 1)) / (32 * step) for axis in range(2)]
    return np.stack(slopes, axis=-1).astype(np.float64)


def _missed(series: Reals, confidence: Reals, times: Reals, left_out: NDArray[np.bool_], bases: int) -> Missed:
    """Mean squared error a channel in the frames left out, of the series fitted to the others as motion.py fits."""
    shared = SharedBasis.initial(1, bases=bases, times=times[~left_out].tolist())
    basis = np.stack([shared.basis(float(t)).double().numpy() for t in times])
    weights = fit_series(series[~left_out], confidence[~left_out], basis[~left_out])
    missed = series[left_out] - np.einsum("kb,nbc->knc", basis[left_out], weights)
    weight = confidence[left_out]
    squares = (missed**2 * weight[..., None]).sum((0, 1)) / max(3 * weight.sum(), 1e-9)
    return Missed(motion=float(squares[:3].sum()), light=float(squares[3:].sum()))
