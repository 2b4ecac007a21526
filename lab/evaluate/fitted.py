"""Scores of views whose light is another than the truth's: one gain and offset of each channel, found over all views.

Symbols: H W pixels. Colours are RGB, float in [0, 1], or uint8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from intrasplat.splat.metrics import Image, psnr_tissue

LEVELS = 255
Views = Sequence[tuple[Image, Image, NDArray[np.bool_]]]
"""Each: what is shown and the truth, [H, W, 3], and the pixels [H, W] that are judged."""


def plain_db(views: Views) -> float:
    """The mean psnr_tissue of the views as they are; NaN where no pixel is judged."""
    scores = [psnr_tissue(*view) for view in views]
    known = [score for score in scores if not math.isnan(score)]
    return float(np.mean(known)) if known else math.nan


def fitted_db(views: Views) -> float:
    """The same after gain * shown + offset by channel, which fit all the views together best by least squares."""
    pairs = [(_unit(shown)[judged], _unit(truth)[judged]) for shown, truth, judged in views]
    shown, truth = (np.concatenate([pair[side] for pair in pairs]).astype(np.float64) for side in (0, 1))
    if not shown.size:
        return math.nan
    apart = shown - shown.mean(axis=0)
    spread = np.square(apart).sum(axis=0)
    gain = (apart * truth).sum(axis=0) / np.where(spread > 0, spread, 1.0)
    offset = truth.mean(axis=0) - gain * shown.mean(axis=0)
    return plain_db([(_unit(view) * gain + offset, true, judged) for view, true, judged in views])


def _unit(image: Image) -> NDArray[np.floating]:
    """The image as it is shown, in [0, 1]."""
    return image / np.float32(LEVELS) if image.dtype == np.uint8 else np.clip(image, 0, 1)
