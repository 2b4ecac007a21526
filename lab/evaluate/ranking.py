"""Does the confidence layer rank the errors, and is it the probability that it says it is?

Symbols: P pixels, H W pixels of a view. An error is one pixel's: of colour the mean absolute difference over R G B in
[0, 1], of depth the absolute difference over the true depth. Where nothing solid is drawn, depth is infinitely wrong.

A pixel's error is the size of the model's mistake times a random factor, which no confidence can know. So correlations
are also computed between squares of SQUARE_PX pixels: of their mean confidence and their mean error, in which the
relative error of depth is limited to 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from intrasplat.splat.metrics import RIGHT_COLOUR, RIGHT_DEPTH

SQUARE_PX = 8
LEAST_JUDGED = 0.5
"""Share of a square's pixels that must be judged for the square to count."""
BINS = 10
"""Number of bins of the reliability diagram, equally wide in confidence."""


@dataclass(frozen=True, eq=False)
class PixelErrors:
    """What the model says of pixels and how wrong it is there: each [P]. square numbers the squares they lie in."""

    confidence: NDArray[np.float32]
    colour: NDArray[np.float32]
    depth: NDArray[np.float32]
    square: NDArray[np.int64]


def pixel_errors(
    confidence: NDArray[np.float32],
    rgb: tuple[NDArray[np.float32], NDArray[np.float32]],
    depth_mm: tuple[NDArray[np.float32], NDArray[np.float32]],
    judged: NDArray[np.bool_],
) -> PixelErrors:
    """The errors of a view at the judged pixels [H, W], of (rendered, true) colours [H, W, 3] and depths [H, W]."""
    shown, true = (each[judged] for each in rgb)
    shown_mm, true_mm = (each[judged] for each in depth_mm)
    both = (shown_mm > 0) & (true_mm > 0)
    depth = np.divide(np.abs(shown_mm - true_mm), true_mm, out=np.full(both.shape, np.inf, np.float32), where=both)
    colour = np.abs(np.clip(shown, 0, 1) - true).mean(axis=1)
    row, column = (each // SQUARE_PX for each in np.nonzero(judged))
    square = row * (judged.shape[1] // SQUARE_PX + 1) + column
    return PixelErrors(confidence[judged], colour.astype(np.float32), depth.astype(np.float32), square)


def together(views: Sequence[PixelErrors]) -> PixelErrors:
    """The pixels of several views as those of one."""
    first, squares = 0, []
    for each in views:
        squares.append(each.square + first)
        first += int(each.square.max(initial=-1)) + 1
    return PixelErrors(
        np.concatenate([each.confidence for each in views]),
        np.concatenate([each.colour for each in views]),
        np.concatenate([each.depth for each in views]),
        np.concatenate(squares),
    )


def squares_of(errors: PixelErrors) -> PixelErrors:
    """The mean confidence and the mean errors of the squares of which enough pixels are judged."""
    count = np.bincount(errors.square)
    kept = count >= LEAST_JUDGED * SQUARE_PX**2

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(np.bincount(errors.square, values)[kept] / count[kept], np.float32)

    depth = mean(np.minimum(errors.depth, np.float32(1)))
    return PixelErrors(mean(errors.confidence), mean(errors.colour), depth, np.flatnonzero(kept))


def rank_scores(errors: PixelErrors, name: str) -> dict[str, float]:
    """The rank correlations of confidence with colour and depth, of pixels and of squares, by column of a row."""
    found = {}
    for scale, each in (("", errors), (f"_{SQUARE_PX}px", squares_of(errors))):
        found[f"{name}_colour{scale}"] = rank_correlation(each.confidence, each.colour)
        found[f"{name}_depth{scale}"] = rank_correlation(each.confidence, each.depth)
    return found


def rank_correlation(confidence: NDArray[np.floating], error: NDArray[np.floating]) -> float:
    """Spearman's rank correlation of [P] confidence with the negative of [P] error, ties at their mean rank.

    1: the higher the confidence, the smaller the error, without exception. 0: it says nothing. NaN: one of both is the
    same everywhere, or there is no pixel.
    """
    if not confidence.size:
        return math.nan
    trust, wrong = rankdata(confidence), rankdata(error)
    trust -= trust.mean()
    wrong -= wrong.mean()
    scale = math.sqrt(float(trust @ trust) * float(wrong @ wrong))
    return -float(trust @ wrong) / scale if scale > 0 else math.nan


@dataclass(frozen=True)
class ReliabilityBin:
    """Pixels of about the same confidence, and the shares of them whose depth, colour, both are right; NaN of none."""

    low: float
    high: float
    pixels: int
    confidence: float
    depth_right: float
    colour_right: float
    right: float


def reliability(errors: PixelErrors) -> list[ReliabilityBin]:
    """The reliability diagram: of each bin of confidence, how often depth and colour were right."""
    place = np.minimum((errors.confidence * BINS).astype(np.intp), BINS - 1)
    found = []
    for each in range(BINS):
        here = place == each
        depth, colour = errors.depth[here] < RIGHT_DEPTH, errors.colour[here] < RIGHT_COLOUR
        values = (errors.confidence[here], depth, colour, depth & colour)
        means = (float(value.mean()) if value.size else math.nan for value in values)
        found.append(ReliabilityBin(each / BINS, (each + 1) / BINS, int(here.sum()), *means))
    return found
