"""Does the confidence layer rank the errors, and is it the probability that it says it is?

Symbols: P pixels. An error is one pixel's: of colour the mean absolute difference over R G B in [0, 1], of depth the
absolute difference over the true depth. Where nothing solid is drawn, depth is infinitely wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

RIGHT_DEPTH = 0.02
"""A pixel's depth is right if it errs by less than this share of the true depth."""
RIGHT_COLOUR = 0.05
"""A pixel's colour is right if it errs by less than this in the mean of R G B: 13 of 255."""
BINS = 10
"""Of the reliability diagram, equally wide in confidence."""


@dataclass(frozen=True, eq=False)
class PixelErrors:
    """What the model says of pixels and how wrong it is there: each [P]."""

    confidence: NDArray[np.float32]
    colour: NDArray[np.float32]
    depth: NDArray[np.float32]


def pixel_errors(
    confidence: NDArray[np.float32],
    rgb: tuple[NDArray[np.float32], NDArray[np.float32]],
    depth_mm: tuple[NDArray[np.float32], NDArray[np.float32]],
    judged: NDArray[np.bool_],
) -> PixelErrors:
    """The errors of a view at the judged pixels [H, W], of (rendered, true) colours [H, W, 3] and depths [H, W]."""
    shown, true = (each[judged] for each in rgb)
    shown_mm, true_mm = (each[judged] for each in depth_mm)
    depth = np.where(shown_mm > 0, np.abs(shown_mm - true_mm) / true_mm, np.inf)
    colour = np.abs(np.clip(shown, 0, 1) - true).mean(axis=1)
    return PixelErrors(confidence[judged], colour.astype(np.float32), depth.astype(np.float32))


def together(views: Sequence[PixelErrors]) -> PixelErrors:
    """The pixels of several views as those of one."""
    columns = zip(*((each.confidence, each.colour, each.depth) for each in views), strict=True)
    return PixelErrors(*(np.concatenate(column) for column in columns))


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
    """Pixels of about the same confidence, and the shares of them that are right; NaN where there are none."""

    low: float
    high: float
    pixels: int
    confidence: float
    depth_right: float
    colour_right: float


def reliability(errors: PixelErrors) -> list[ReliabilityBin]:
    """The reliability diagram: of each bin of confidence, how often depth and colour were right."""
    place = np.minimum((errors.confidence * BINS).astype(np.intp), BINS - 1)
    found = []
    for each in range(BINS):
        here = place == each
        values = (errors.confidence[here], errors.depth[here] < RIGHT_DEPTH, errors.colour[here] < RIGHT_COLOUR)
        means = (float(value.mean()) if value.size else math.nan for value in values)
        found.append(ReliabilityBin(each / BINS, (each + 1) / BINS, int(here.sum()), *means))
    return found
