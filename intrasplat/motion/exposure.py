"""The camera's exposure and white balance in every frame, measured along tracks, and frames in steady light.

A gain of light acts before the camera's tone curve. That curve is about a power, so the gain multiplies the recorded
values of a channel, too. Each measurement is a median over tissue of log(colour there / colour in the keyframe).

Symbols: T frames, H W pixels, K training frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.machine.cores import cores
from intrasplat.motion.lifted import cell_means
from intrasplat.motion.recoloured import EyeOrClip, recoloured
from intrasplat.motion.tracks import Tracks
from intrasplat.notices import Notice, NoticeCode

Reals = NDArray[np.float64]

MIN_CONFIDENCE, MIN_CELLS, MAX_CELLS = 0.3, 30, 5000
"""Of a track that is measured; fewest and most tracks of a frame, the most about."""
MIN_SHARE = 0.05
"""Least share of the cells that is measured: the median of a few is that of one highlight or shadow."""
STEADY = 1e-3
"""Weight of "neighbouring training frames have the same gain", beside shares of up to 1 of what is measured."""
MIN_LEVEL, MAX_LEVEL = 0.08, 0.95
"""Colours in [0, 1] that are measured: noise and the tone curve's foot spoil darker ones, clipping brighter ones."""
MIN_CHANGE, MIN_TINT = 0.2, 0.12
"""Least range of the log gains' mean (one stop is 0.32, `d4d_stereo` drifts by 0.16), and of red or blue against green,
that is corrected. The bases follow smaller changes as well, and lamps change with the place, which one gain cannot."""
MAX_UNEVEN, MAX_UNEVEN_SHARE = 0.06, 0.1
"""Difference of a training frame's mean log gain from that between its neighbours (0.005 in videos, 0.04 in stills 3 s
apart), and the share of the frames that may differ by more: one step of the light is not a flicker."""
TONE_POWER = 2.2
"""Light is about this power of recorded values."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """Natural logarithms [T, 3] of each frame's gains of R G B against those of the frame `reference`."""

    log_gains: Reals
    reference: int

    @property
    def stops(self) -> Reals:
        """[T] exposure of every frame against the reference's, in stops."""
        return np.asarray(self.log_gains.mean(axis=1) * TONE_POWER / np.log(2))

    @property
    def log_tints(self) -> Reals:
        """[T, 3] logarithms of the gains of R G B against that of G."""
        return np.asarray(self.log_gains - self.log_gains[:, 1:2])

    def notice(self, times_s: Reals) -> Notice:
        """The report's sentence on the light. times_s: [T]."""
        stops, tint = np.ptp(self.stops), np.exp(np.ptp(self.log_tints, axis=0).max())
        extremes = [int(self.stops.argmin()), int(self.stops.argmax())]
        dark, bright = (f"frame {index} ({times_s[index]:.1f} s)" for index in extremes)
        text = (
            f"light: exposure changes by {stops:.1f} stops, from {dark}, the darkest, to {bright}, the brightest, and "
            f"white balance by {tint:.2f} times; the model has the light of frame {self.reference}"
        )
        return Notice.info(NoticeCode.EXPOSURE, text)

    def warnings(self, train: Sequence[int], times_s: Reals) -> tuple[Notice, ...]:
        """A warning if the gains of the training frames do not tell those of frames between them. times_s: [T]."""
        uneven = unevenness(self.log_gains[train], times_s[train])
        if not _flickers(uneven):
            return ()
        worst = int(uneven.argmax())
        text = (
            f"The light of {(uneven > MAX_UNEVEN).sum()} of {len(train)} training frames is not between that of the "
            f"frames around them, most of all in frame {train[worst]}, by {np.expm1(uneven[worst]):.0%}: it flickers, "
            "or changes faster than the frames show. The light between training frames is a guess: with light=recorded "
            "such moments may be too bright or too dark, and the scores of held-out frames are too low for that."
        )
        return (Notice.warning(NoticeCode.LIGHT_FLICKERS, text),)


def unevenness(log_gains: Reals, times_s: Reals) -> Reals:
    """[K] by how much a frame's mean log gain differs from that between its neighbours; 0 for the first and the last.

    log_gains: [K, 3]. times_s: [K], rising.
    """
    level = log_gains.mean(axis=1)
    share = (times_s[1:-1] - times_s[:-2]) / (times_s[2:] - times_s[:-2])
    uneven = np.zeros(len(level))
    uneven[1:-1] = np.abs(level[1:-1] - (1 - share) * level[:-2] - share * level[2:])
    return uneven


def _flickers(uneven: Reals) -> bool:
    return bool((uneven > MAX_UNEVEN).sum() > MAX_UNEVEN_SHARE * len(uneven))


def find_exposure(clip: DepthClip, train: Sequence[int], tracks: Sequence[Tracks]) -> Exposure | None:
    """The exposure of every frame; None: it hardly changes, or too few tracks show it.

    Only training frames are measured. The gains of other frames are interpolated in time.
    """
    rows, values = list[Reals](), list[Reals]()
    for each in tracks:
        for place, log_gain, share in measured_cells(clip, train, each, _gain):
            row = np.zeros(len(train))
            row[place], row[each.reference] = share, -share
            rows.append(row)
            values.append(share * log_gain)
    if not rows:
        return None
    system = np.array(rows)
    known = system.any(axis=0)
    steady = STEADY * (np.eye(known.sum())[1:] - np.eye(known.sum())[:-1])  # joins frames that no track joins
    targets = np.concatenate([values, np.zeros((len(steady), 3))])
    found, *_ = np.linalg.lstsq(np.concatenate([system[:, known], steady]), targets, rcond=None)
    measured, times_s = np.asarray(train)[known], clip.frame_times_s
    drifts = np.ptp(found.mean(axis=1)) >= MIN_CHANGE or np.ptp(found - found[:, 1:2], axis=0).max() >= MIN_TINT
    if not drifts and not _flickers(unevenness(found, times_s[measured])):
        return None
    usual = int(np.abs(found - np.median(found, axis=0)).sum(axis=1).argmin())
    found -= found[usual]
    log_gains = np.stack([np.interp(times_s, times_s[measured], channel) for channel in found.T], axis=1)
    return Exposure(log_gains, int(measured[usual]))


def _gain(cells: Measured) -> tuple[int, Reals, float] | None:
    """A frame, log gains [3] of it against the keyframe, share of cells measured; None: too few."""
    if cells.good.sum() < max(MIN_CELLS, MIN_SHARE * cells.good.size):
        return None
    log_gain = np.median(np.log(cells.ratio[cells.good]), axis=0).astype(np.float64)
    return cells.place, log_gain, float(cells.good.mean())


@dataclass(frozen=True, eq=False)
class Measured:
    """Some cells of a keyframe in a tracked frame.

    place, row  the frame's index in the training frames, and in the tracks
    some        the cells of the grid, about MAX_CELLS of them
    good        [...] bool, which of those are measured
    ratio       [..., 3] colour there / colour in the keyframe
    """

    place: int
    row: int
    some: tuple[slice, slice]
    good: NDArray[np.bool_]
    ratio: NDArray[np.float32]


Value = TypeVar("Value")


def measured_cells(
    clip: DepthClip, train: Sequence[int], tracks: Tracks, measure: Callable[[Measured], Value | None]
) -> Iterator[Value]:
    """What `measure`, which several threads call, makes of each tracked frame but the keyframe, without None."""
    start = cell_means(clip.rgb[train[tracks.reference]], tracks.step_px).astype(np.float32) / np.float32(255)
    step = max(1, round(math.sqrt(start[..., 0].size / MAX_CELLS)))
    some = np.s_[::step, ::step]
    start = start[some]

    def measured(row: int, place: int) -> Value | None:
        there = start + tracks.colour[row][some]
        low, high = np.minimum(start, there).min(axis=-1), np.maximum(start, there).max(axis=-1)
        good = (tracks.confidence[row][some] > MIN_CONFIDENCE) & (low > MIN_LEVEL) & (high < MAX_LEVEL)
        found = measure(Measured(place, row, some, good, there / np.maximum(start, np.float32(1e-6))))
        tracks.let_go(row)
        return found

    others = [(row, place) for row, place in enumerate(tracks.followed.tolist()) if place != tracks.reference]
    with ThreadPoolExecutor(cores()) as pool:
        yield from (each for each in pool.map(lambda other: measured(*other), others) if each is not None)


def in_steady_light(clip: DepthClip, exposure: Exposure) -> DepthClip:
    """The clip as if every frame had the reference's light."""
    right = None if clip.right is None else _steady(clip.right, exposure)
    return replace(_steady(clip, exposure), right=right)


def _steady(eye: EyeOrClip, exposure: Exposure) -> EyeOrClip:
    levels = np.arange(256)[:, None]

    def picture(index: int) -> NDArray[np.uint8]:
        table = np.clip(levels / np.exp(exposure.log_gains[index]) + 0.5, 0, 255).astype(np.uint8)
        return np.asarray(cv2.LUT(eye.rgb[index], table.reshape(1, 256, 3)), np.uint8)

    return recoloured(eye, picture)
