"""Scores of a render against the recorded frame (docs/conventions.md, "Scores").

Symbols: H W pixels. Colours are RGB: float in [0, 1], or uint8; tissue [H, W] bool, True = tissue.
Each function scores one frame, except depth_agreement_mm. A score is NaN if there is no pixel to compare, or if the
render is not finite at one of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.floating] | NDArray[np.uint8]

BEST_PSNR_DB = 100.0
"""The PSNR of equal images. The true value is infinite, which a mean over frames and JSON cannot represent."""
SSIM_SIGMA_PX = 1.5
SSIM_WINDOW_PX = 11
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""Stabilisers for a data range of 1 (Wang et al., 2004)."""
HIGHLIGHT_LEVEL, HIGHLIGHT_PX = 0.6, 7
"""A pixel whose least channel exceeds this level is a highlight, with the square of HIGHLIGHT_PX pixels around it."""
COVERED_ALPHA = 0.5
"""Least sum of blending weights at which a pixel counts as covered and its depth as valid."""
RIGHT_COLOUR, RIGHT_DEPTH = 0.03, 0.02
"""Largest errors that count as right: mean error of R G B, with white as 1, and relative error of depth."""
MASK_OVERREAD = 32
"""Bytes allocated after a mask: with AVX2, cv2.norm of OpenCV 4.14 reads up to 8 bytes past its end."""


def psnr_tissue(rendered: Image, truth: Image, tissue: NDArray[np.bool_]) -> float:
    """-10 log10 of the mean squared error over tissue pixels and RGB, in dB; the render is clamped to [0, 1] first.

    Tissue without depth is included. This is our main score.
    """
    _check_shapes(rendered, truth, tissue)
    return _decibel(_squared(rendered, truth, tissue, _unit), 3 * int(np.count_nonzero(tissue)))


def relit(rendered: Image, truth: Image, tissue: NDArray[np.bool_]) -> Image:
    """The render with the gain, one for all colours, that brings its tissue closest to the truth."""
    _check_shapes(rendered, truth, tissue)
    shown, true = (_unit(image)[tissue].astype(np.float64) for image in (rendered, truth))
    return np.asarray(_unit(rendered) * ((shown * true).sum() / max((shown**2).sum(), 1e-9)))


def clear_of_highlights(rendered: Image, truth: Image) -> NDArray[np.bool_]:
    """[H, W] pixels at least HIGHLIGHT_PX / 2 away from a highlight in either image.

    Each eye sees a highlight at another place. Scores without highlights show how well the tissue itself is modelled.
    """
    bright = (_least(_unit(rendered)) > HIGHLIGHT_LEVEL) | (_least(_unit(truth)) > HIGHLIGHT_LEVEL)
    box = np.ones((HIGHLIGHT_PX, HIGHLIGHT_PX), np.uint8)
    return np.asarray(cv2.dilate(bright.astype(np.uint8), box) == 0)


def psnr_paper(rendered: Image, truth: Image, tissue: NDArray[np.bool_]) -> float:
    """PSNR as the papers compute it, in dB: both images in 8 bit, instruments 0 in both, mean over all H W 3 values.

    It exceeds psnr_tissue by -10 log10(share of tissue), because the zeroed pixels have no error.
    """
    _check_shapes(rendered, truth, tissue)
    if not tissue.any():
        return math.nan
    return _decibel(_squared(rendered, truth, tissue, _levels) / 255**2, 3 * tissue.size)


def ssim(rendered: Image, truth: Image, tissue: NDArray[np.bool_]) -> float:
    """Structural similarity (Wang et al., 2004), 11 x 11 Gaussian, sigma 1.5, its map averaged over tissue and RGB.

    The instrument is 0 in both images, so that a window that overlaps it compares only tissue.
    """
    _check_shapes(rendered, truth, tissue)
    if not tissue.any():
        return math.nan

    def channel(image: Image, place: int) -> NDArray[np.float32]:
        return np.where(tissue, _unit(image[..., place]), np.float32(0))

    maps = (ssim_map(channel(rendered, place), channel(truth, place)) for place in range(3))
    return float(np.mean([similarity[tissue].mean(dtype=np.float64) for similarity in maps]))


def ssim_map(first: NDArray[np.floating], second: NDArray[np.floating]) -> NDArray[np.float32]:
    """SSIM at every pixel and channel of two images [H, W] or [H, W, 3] in [0, 1]; borders are mirrored.

    In single precision, which changes a frame's mean by some 1e-7.
    """
    x, y = first.astype(np.float32, copy=False), second.astype(np.float32, copy=False)
    mean_x, mean_y = _windowed(x), _windowed(y)
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    covariance = _windowed(x * y) - product
    variances = _windowed(x * x + y * y) - squares
    similarity = (2 * product + SSIM_C1) * (2 * covariance + SSIM_C2)
    return np.asarray(similarity / ((squares + SSIM_C1) * (variances + SSIM_C2)))


def depth_errors_mm(
    rendered_mm: NDArray[np.floating], stereo_mm: NDArray[np.floating], tissue: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """[M] |rendered - stereo| in mm at the tissue pixels where both depths are valid (above 0), or NaN if one is."""
    if not rendered_mm.shape == stereo_mm.shape == tissue.shape:
        raise ValueError(f"shapes differ: {rendered_mm.shape}, {stereo_mm.shape}, tissue {tissue.shape}")
    both = tissue & ~(rendered_mm <= 0) & ~(stereo_mm <= 0)
    return np.abs(rendered_mm[both] - stereo_mm[both]).astype(np.float32)


def depth_agreement_mm(errors_mm: list[NDArray[np.float32]]) -> float:
    """Median of the depth errors of all frames together, in mm; NaN if there is none."""
    together = np.concatenate(errors_mm) if errors_mm else np.empty(0)
    return float(np.median(together)) if together.size else math.nan


def coverage(alpha: NDArray[np.floating], tissue: NDArray[np.bool_]) -> float:
    """Share of tissue pixels whose alpha is at least COVERED_ALPHA; NaN counts as not covered."""
    if alpha.shape != tissue.shape:
        raise ValueError(f"shapes differ: {alpha.shape}, tissue {tissue.shape}")
    return float((alpha[tissue] >= COVERED_ALPHA).mean()) if tissue.any() else math.nan


def _unit(image: Image) -> NDArray[np.float32]:
    """float32 in [0, 1]."""
    if image.dtype == np.uint8:
        values = image.astype(np.float32)
        values /= 255
        return values
    return np.clip(image, 0, 1).astype(np.float32, copy=False)


def _levels(image: Image) -> NDArray[np.float32]:
    """Rounded to 0, 1, ... 255."""
    return image.astype(np.float32) if image.dtype == np.uint8 else np.rint(_unit(image) * 255)


def _least(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """[H, W] the least of three channels; ten times as fast as min() along the last axis."""
    return np.asarray(np.minimum(np.minimum(image[..., 0], image[..., 1]), image[..., 2]))


def _squared(
    first: Image, second: Image, chosen: NDArray[np.bool_], as_compared: Callable[[Image], NDArray[np.float32]]
) -> float:
    """The squared differences of two images [H, W, 3] at the chosen pixels, added up; NaN where one of them is NaN."""
    buffer = np.empty(chosen.size + MASK_OVERREAD, np.uint8)
    mask = buffer[: chosen.size].reshape(chosen.shape)
    np.copyto(mask, chosen)
    pairs = ((as_compared(first[..., place]), as_compared(second[..., place])) for place in range(3))
    return float(sum(cv2.norm(*pair, cv2.NORM_L2SQR, mask) for pair in pairs))


def _decibel(squared: float, count: int) -> float:
    """PSNR in dB from the sum of `count` squared errors; NaN without any."""
    if not count or math.isnan(squared):
        return math.nan
    return min(BEST_PSNR_DB, -10 * math.log10(squared / count)) if squared > 0 else BEST_PSNR_DB


def _windowed(image: NDArray[np.float32]) -> NDArray[np.float32]:
    window = (SSIM_WINDOW_PX, SSIM_WINDOW_PX)
    return np.asarray(cv2.GaussianBlur(image, window, SSIM_SIGMA_PX, borderType=cv2.BORDER_REFLECT))


def _check_shapes(rendered: Image, truth: Image, tissue: NDArray[np.bool_]) -> None:
    if rendered.shape != truth.shape or rendered.shape != (*tissue.shape, 3):
        raise ValueError(f"shapes do not fit: {rendered.shape}, {truth.shape}, tissue {tissue.shape}")
