"""Wrong or missing depth. Symbols: T frames, H W pixels.

Each function degrades a clean clip by `level`; `random` is seeded by the cell. Lengths in pixels refer to a picture 640
wide.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.conditions.clean import CleanClip, Given, given

NOISE_PX = 8.0  # stereo errors have patches of about its window, not single pixels
PATCH_PX = 24.0  # size of holes and of gross errors
GROSS_FACTOR = (0.4, 2.0)  # range of the factor of gross errors: too near or too far


def depth_noise(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Depth has relative errors of `level` (one sigma), in patches of 8 px, drawn anew for every frame."""
    noise = _patches(clean, random, NOISE_PX)
    depth_mm = (clean.clip.depth_mm * np.maximum(1 + level * noise, 0.05)).astype(np.float32)
    return given(clean, dataclasses.replace(clean.clip, depth_mm=depth_mm))


def depth_holes(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """`level` of every frame, in patches of 24 px, has no depth."""
    hole = _share(_patches(clean, random, PATCH_PX), level)
    spoilt = dataclasses.replace(
        clean.clip,
        depth_mm=np.where(hole, np.float32(0), clean.clip.depth_mm),
        depth_confidence=np.where(hole, np.uint8(0), clean.clip.depth_confidence),
    )
    return given(clean, spoilt)


def depth_outliers(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """`level` of every frame, in patches of 24 px, has 0.4 to 2 times its depth, with the same confidence."""
    wrong = _share(_patches(clean, random, PATCH_PX), level)
    factor = np.exp(random.uniform(np.log(GROSS_FACTOR[0]), np.log(GROSS_FACTOR[1]), wrong.shape))
    smooth = np.stack([cv2.blur(each, (3, 3)) for each in factor])
    depth_mm = np.where(wrong, clean.clip.depth_mm * smooth, clean.clip.depth_mm).astype(np.float32)
    return given(clean, dataclasses.replace(clean.clip, depth_mm=depth_mm))


def _patches(clean: CleanClip, random: np.random.Generator, size_px: float) -> NDArray[np.float64]:
    """Noise [T, H, W] of standard deviation 1, correlated over about size_px, independent between frames."""
    white = random.standard_normal(clean.clip.depth_mm.shape)
    sigma = max(0.5, size_px * clean.px / 2)
    smooth = np.stack([cv2.GaussianBlur(frame, (0, 0), sigma) for frame in white])
    return np.asarray(smooth / smooth.std(axis=(1, 2), keepdims=True))


def _share(field: NDArray[np.float64], share: float) -> NDArray[np.bool_]:
    """The `share` of each frame where a field is largest."""
    return np.asarray(field >= np.quantile(field, 1 - share, axis=(1, 2), keepdims=True))
