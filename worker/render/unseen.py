"""Pixels of a render that show what no training frame saw, and the hatch that marks them.

Symbols: N Gaussians, H W pixels, w blending weights. docs/conventions.md ("Unseen") has the definition.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

NEVER_SEEN = -0.1
"""What a Gaussian that no training frame saw counts in the blend: it outweighs as much that is trusted by a tenth. So
one blended plane decides what is unseen and, above 0, holds the trust."""
SMOOTHED_SHARE = 1 / 128
"""Side of the square of pixels whose majority decides, as a share of the image's width: 5 pixels of 640."""
STRIPE_SHARE = 1 / 96
"""Width of a stripe of the hatch along a row, as a share of the image's width: 3 mm where the picture is 30 cm wide."""
DARK_GREY, LIGHT_GREY = 40, 74
"""Of 255; a luminance of 2 and 7 %. Stripes 3 m away are told apart, and nothing in a body is neutral and striped."""
HATCHES_KEPT = 8


def blended_values(seen: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """[N] numbers to blend for a scene's `seen` [N]; None where none was measured, as of a snapshot of training."""
    if not seen.any():
        return None
    return np.where(seen > 0, seen, np.float32(NEVER_SEEN))


def missing_pixels(solid: NDArray[np.bool_], blended: NDArray[np.float32] | None) -> NDArray[np.bool_]:
    """[H, W] whether each pixel by itself shows nothing solid, or mostly what no training frame saw.

    Args:
        solid: [H, W] whether something solid is drawn.
        blended: [H, W] sum of w * blended_values; None: not known.
    """
    return ~solid if blended is None else ~(solid & (blended >= 0))


def unseen_pixels(missing: NDArray[np.bool_], picture_width: int | None = None) -> NDArray[np.bool_]:
    """[H, W] whether most pixels around are missing [H, W].

    picture_width: of the picture that these pixels are a part of; None: they are all of it.
    """
    if not missing.any():
        return missing
    side = 2 * round((picture_width or missing.shape[1]) * SMOOTHED_SHARE / 2) + 1
    return np.asarray(cv2.blur(missing.astype(np.uint8) * np.uint8(255), (side, side)) > 127)


def hatched(rgb: NDArray[np.uint8], unseen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A copy of rgb [H, W, 3] with the hatch in the unseen pixels [H, W]."""
    return np.asarray(cv2.copyTo(_hatch(*unseen.shape), unseen.astype(np.uint8), rgb.copy()), np.uint8)


@lru_cache(HATCHES_KEPT)
def _hatch(height: int, width: int) -> NDArray[np.uint8]:
    """[H, W, 3] diagonal stripes of two dark greys."""
    stripe_px = max(2, round(width * STRIPE_SHARE))
    i, j = np.ogrid[:height, :width]
    grey = np.where((i + j) // stripe_px % 2, LIGHT_GREY, DARK_GREY).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)
