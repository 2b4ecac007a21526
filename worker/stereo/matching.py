"""Dense disparity of one rectified pair, with a confidence.

Symbols: H W pixels of one eye; d disparity, x_left - x_right in px of the full image; h w pixels the matcher works on.

Semi-global matching (Hirschmueller 2008; OpenCV's 3-way form) runs on half the resolution or less, where it costs an
eighth. Both directions feed an edge-aware weighted-least-squares filter (Min et al. 2014, cv2.ximgproc), which fills
what the left-right check rejects. One Lucas-Kanade step along the row at full resolution then restores the sub-pixel
part that the reduction lost (docs/decisions/001-stereo-at-half-resolution.md has figures).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]  # [H, W]
Image = NDArray[np.float32]  # [H, W]

MATCHING_WIDTH = 480  # px; wider images are matched smaller by a whole factor: 2 for 640, 3 for 1280
BLOCK_PX = 5
SPARE_STEPS = 1.5  # of the range's margin, dropped if they would cost sixteen more disparities
DISPARITY_STEPS = 16  # a px: the unit of OpenCV's matchers
SMALL_STEP_PENALTY, LARGE_STEP_PENALTY = 8, 32  # SGBM's P1, P2 per block pixel, OpenCV's own advice
PREFILTER_CAP = 31
SMOOTHNESS, COLOUR_SIGMA = 8000.0, 1.0  # of the edge-aware filter
REFERENCE_WIDTH = 640  # px at which windows and gradients are stated: wider images have wider, flatter edges
REFINE_WINDOW_PX, HIGH_PASS_PX = 11, 15
REFINE_DAMPING = 20.0  # grey levels squared: below this mean squared gradient the matcher's own value wins
MAX_REFINEMENT_PX = 1.0  # beyond it the linearisation of one step does not hold
TEXTURE_FOR_TRUST = 8.0  # mean squared gradient (grey levels squared) below which errors grow, measured
RESIDUAL_FOR_TRUST = 8.0  # mean |left - warped right| (grey levels) above which errors grow, measured
BLACK_LEVEL, SATURATED_LEVEL = 10, 250
SATURATED_TRUST = 0.25  # highlights move with the eye: a match there may not be the surface
MIN_CONFIDENCE = 16  # of 255: below it a depth is a guess
MAX_DEPTH_MM = 400.0  # beyond it an endoscope's disparity is a fraction of a pixel


@dataclass(frozen=True)
class MatchPlan:
    """The disparities to search and the shift between the eyes' rows, common to all frames of a clip.

    min_disparity_px <= d < max_disparity_px. row_shift_px is y_right - y_left of matching points; 0: no resampling.
    """

    min_disparity_px: float
    max_disparity_px: float
    row_shift_px: float = 0.0


def match(left: Grey, right: Grey, plan: MatchPlan) -> tuple[Image, NDArray[np.uint8]]:
    """Disparity [H, W] float32 in px and confidence [H, W] uint8 of one pair, in the left eye's pixels.

    Confidence is 0 where the right eye cannot see the point or the image is black, low where the left-right check
    fails, the image is flat or saturated, or the match explains the image badly.
    """
    right = shift_rows(right, plan.row_shift_px)
    height, width = left.shape
    factor = -(-width // MATCHING_WIDTH)
    size = (round(width / factor), round(height / factor))
    scale = size[0] / width
    low = int(np.floor(plan.min_disparity_px * scale))
    count = 16 * max(1, int(np.ceil((plan.max_disparity_px * scale - low - SPARE_STEPS) / 16)))
    coarse, consistency = _semi_global(_resized(left, size), _resized(right, size), low, count)
    disparity = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR) / np.float32(scale)
    disparity, texture, residual = _refine(disparity, left, right)
    trust = cv2.resize(consistency, (width, height), interpolation=cv2.INTER_LINEAR)
    trust *= np.minimum(texture / TEXTURE_FOR_TRUST, 1.0)
    trust *= np.minimum(RESIDUAL_FOR_TRUST / np.maximum(residual, 1e-3), 1.0)
    trust[left >= SATURATED_LEVEL] *= SATURATED_TRUST
    trust[left <= BLACK_LEVEL] = 0
    x_right = np.arange(width, dtype=np.float32) - disparity
    trust[(x_right < 0) | (x_right > width - 1)] = 0
    return disparity, np.rint(trust).astype(np.uint8)


def shift_rows(image: Grey, shift_px: float) -> Grey:
    """The image moved up by shift_px: row y holds what was at row y + shift_px."""
    if shift_px == 0:
        return image
    matrix = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, shift_px]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    shifted: Grey = cv2.warpAffine(image, matrix, image.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return shifted


def semi_global_matcher(low: int, count: int) -> cv2.StereoSGBM:
    """The matcher for integer disparities low <= d < low + count; count is a multiple of 16."""
    return cv2.StereoSGBM.create(
        minDisparity=low,
        numDisparities=count,
        blockSize=BLOCK_PX,
        P1=SMALL_STEP_PENALTY * BLOCK_PX**2,
        P2=LARGE_STEP_PENALTY * BLOCK_PX**2,
        disp12MaxDiff=1_000_000,  # off: the filter checks left against right with both full maps
        uniquenessRatio=0,
        preFilterCap=PREFILTER_CAP,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )


def padded(left: Grey, right: Grey, low: int, count: int) -> tuple[Grey, Grey, int]:
    """Both images, widened so that the matcher keeps their left and right margins; and the pixels added a side."""
    pad = max(abs(low), abs(low + count)) + BLOCK_PX
    wide_left = cv2.copyMakeBorder(left, 0, 0, pad, pad, cv2.BORDER_REPLICATE)
    wide_right = cv2.copyMakeBorder(right, 0, 0, pad, pad, cv2.BORDER_REPLICATE)
    return wide_left, wide_right, pad


def _resized(image: Grey, size: tuple[int, int]) -> Grey:
    same = image.shape[::-1] == size
    smaller: Grey = image if same else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return smaller


def _semi_global(left: Grey, right: Grey, low: int, count: int) -> tuple[Image, Image]:
    """Filtered disparity [h, w] and left-right consistency [h, w] in [0, 255]."""
    wide_left, wide_right, pad = padded(left, right, low, count)
    matcher = semi_global_matcher(low, count)
    right_matcher = cv2.ximgproc.createRightMatcher(matcher)
    smoother = cv2.ximgproc.createDisparityWLSFilter(matcher)
    smoother.setLambda(SMOOTHNESS)
    smoother.setSigmaColor(COLOUR_SIGMA)
    filtered = smoother.filter(
        matcher.compute(wide_left, wide_right),
        wide_left,
        disparity_map_right=right_matcher.compute(wide_right, wide_left),
    )
    columns = slice(pad, pad + left.shape[1])
    disparity = filtered[:, columns].astype(np.float32) / DISPARITY_STEPS
    return disparity, np.ascontiguousarray(smoother.getConfidenceMap()[:, columns])


def _refine(disparity: Image, left: Grey, right: Grey) -> tuple[Image, Image, Image]:
    """One Lucas-Kanade step in x: d, texture (mean squared gradient) and residual (mean |difference|), all [H, W].

    With R(x - d) the right image warped onto the left one L, minimise sum over the window of (R(x - d) - dd R' - L)^2:
    dd = sum(R' (R - L)) / sum(R'^2). Both images lose their local mean first, as the eyes differ in exposure.
    """
    height, width = left.shape
    x = np.arange(width, dtype=np.float32) - disparity
    y = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
    fineness = max(1.0, width / REFERENCE_WIDTH)
    reference = _high_pass(left, fineness)
    warped = cv2.remap(_high_pass(right, fineness), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    difference = warped - reference
    gradient = cv2.filter2D((warped + reference) * np.float32(0.5), -1, np.array([[-0.5, 0.0, 0.5]], np.float32))
    window = _window(REFINE_WINDOW_PX, fineness)
    texture = cv2.boxFilter(gradient * gradient, -1, window) * np.float32(fineness**2)
    pull = cv2.boxFilter(gradient * difference, -1, window) * np.float32(fineness**2)
    step = pull / (texture + REFINE_DAMPING)
    residual = cv2.boxFilter(np.abs(difference), -1, window)
    return disparity + np.clip(step, -MAX_REFINEMENT_PX, MAX_REFINEMENT_PX), texture, residual


def _high_pass(image: Grey, fineness: float) -> Image:
    values = image.astype(np.float32)
    values -= cv2.boxFilter(values, -1, _window(HIGH_PASS_PX, fineness))
    return values


def _window(size_px: int, fineness: float) -> tuple[int, int]:
    """A square window of odd size, size_px at the reference width."""
    size = 2 * round(size_px * fineness / 2 - 0.5) + 1
    return size, size
