"""Find the pixels of a render that show what no training frame saw, and mark them with a hatch.

Symbols: N Gaussians, H W pixels, w blending weights. docs/conventions.md ("Unseen") has the definition.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

NEVER_SEEN = -0.1
"""Value of an unseen Gaussian in the blend: it cancels an equal weight of trust 0.1. So one blended plane decides what
is unseen and, where it is positive, contains the trust."""
SMOOTHED_SHARE = 1 / 128
"""Side of the square of pixels that vote, as a share of the image's width: 5 pixels of 640."""
STRIPE_SHARE = 1 / 96
"""Width of a stripe of the hatch along a row, as a share of the image's width: 3 mm where the picture is 30 cm wide."""
DARK_GREY, LIGHT_GREY = 40, 74
"""Greys of the stripes, of 255 (luminance 2 and 7 %): distinct from 3 m away; nothing in a body is grey and striped."""
MAX_CACHED_HATCHES = 8


def blended_values(seen: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """[N] values to blend for a scene's `seen` [N]; None if `seen` was not measured, as in a snapshot of training."""
    if not seen.any():
        return None
    return np.where(seen > 0, seen, np.float32(NEVER_SEEN))


def missing_pixels(solid: NDArray[np.bool_], blended: NDArray[np.float32] | None) -> NDArray[np.bool_]:
    """[H, W] whether each pixel, without its neighbours, shows nothing solid or mostly what no training frame saw.

    Args:
        solid: [H, W] whether the pixel shows something solid.
        blended: [H, W] sum of w * blended_values; None: not known.
    """
    return ~solid if blended is None else ~(solid & (blended >= 0))


def unseen_pixels(missing: NDArray[np.bool_], picture_width: int | None = None) -> NDArray[np.bool_]:
    """[H, W] whether most pixels around each pixel are missing [H, W].

    picture_width: width of the whole picture, if these pixels are a part of it; None: they are the whole picture.
    """
    if not missing.any():
        return missing
    side = 2 * round((picture_width or missing.shape[1]) * SMOOTHED_SHARE / 2) + 1
    return np.asarray(cv2.blur(missing.astype(np.uint8) * np.uint8(255), (side, side)) > 127)


def hatched(rgb: NDArray[np.uint8], unseen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A copy of rgb [H, W, 3] with the hatch in the unseen pixels [H, W]."""
    return np.asarray(cv2.copyTo(_hatch(*unseen.shape), unseen.astype(np.uint8), rgb.copy()), np.uint8)


@lru_cache(MAX_CACHED_HATCHES)
def _hatch(height: int, width: int) -> NDArray[np.uint8]:
    """[H, W, 3] diagonal stripes of two dark greys."""
    stripe_px = max(2, round(width * STRIPE_SHARE))
    i, j = np.ogrid[:height, :width]
    grey = np.where((i + j) // stripe_px % 2, LIGHT_GREY, DARK_GREY).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)
