"""Nearness of a frame at low resolution: enough to separate instruments from the tissue behind them.

Symbols: h w pixels of the small picture; nearness: disparity beyond infinity in its pixels.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.instruments import smooth_nearness
from intrasplat.stereo.matching import Grey, Image, MatchPlan, evidence, semi_global


def nearness(coarse: NDArray[np.uint8], right: Grey, plan: MatchPlan, offset_px: float) -> Image:
    """Nearness [h, w] for a small left picture [h, w, 3] and the rectified right picture [H, W] at full size.

    offset_px: the disparity at infinity, in pixels of the full picture.
    """
    size, scale = coarse.shape[1::-1], coarse.shape[1] / right.shape[1]
    left = np.asarray(cv2.cvtColor(coarse, cv2.COLOR_RGB2GRAY), np.uint8)
    low = math.floor(plan.min_disparity_px * scale)
    count = 16 * max(1, math.ceil((plan.max_disparity_px * scale - low) / 16))
    found, agreed = semi_global(left, cv2.resize(right, size, interpolation=cv2.INTER_AREA), low, count)
    trust = evidence(found, agreed, left)
    return smooth_nearness(coarse, found - np.float32(offset_px * scale), trust)
