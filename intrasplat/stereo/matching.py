"""Dense disparity of one rectified pair, with a confidence.

Symbols: H W pixels of one eye; d disparity, x_left - x_right in px of the full image; h w pixels the matcher works on.

Semi-global matching (Hirschmueller 2008; OpenCV's form with five paths) runs at half the resolution or less, where it
costs an eighth, on contrast-normalised pictures. An edge-aware weighted-least-squares filter (Min et al. 2014,
cv2.ximgproc) smooths disparities on which both eyes agree and fills the rest. One Lucas-Kanade step along the row at
full resolution then restores the sub-pixel part that the reduction lost (docs/decisions/stereo-depth.md has figures).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.options import MAX_DEPTH_MM, MIN_DEPTH_MM

Grey = NDArray[np.uint8]  # [H, W]
Image = NDArray[np.float32]  # [H, W]

MATCHING_WIDTH = 480  # px; wider images are reduced by a whole factor: 2 for 640, 3 for 1280
BLOCK_PX = 5
SPARE_STEPS = 1.5  # this much of the range's margin is dropped if it would cost sixteen more disparities
DISPARITY_STEPS = 16  # per px: the unit of OpenCV's matchers
SMALL_STEP_PENALTY, LARGE_STEP_PENALTY = 8, 64  # SGBM's P1, P2 per block pixel
PREFILTER_CAP = 127
AGREEMENT_PX = 1  # of the reduced image: largest difference between the disparities of both directions
CONTRAST_PX, CONTRAST, NOISE = 11, 25.0, 5.0
"""Contrast normalisation: (level - window mean) * CONTRAST / (window standard deviation + NOISE)."""
ROUGHNESS_PX, ROUGHNESS_PER_PX2 = 5, 0.256
"""Side of the window, and the trust lost per px^2 of disparity variance in it: matches near depth edges are blurred."""
ENDS_PX = 1.0  # a match this near an end of the range may be a point beyond it
EVIDENCE_PX, EVIDENCE_TEXTURE = 7, 3.0  # window, and mean squared gradient (grey levels) that gives half the trust
BESIDE_INSTRUMENTS_PX = 3  # of the reduced image: matching windows overlap the edge and match the instrument
SURE_TRUST, SURFACE_PERCENTILE = 0.3, 25  # matches and percentile that give the tissue's disparity near instruments
SATURATED_TRUST = 0.02  # highlights move with the eye: a match there may not be the surface
SMOOTHNESS, COLOUR_SIGMA = 10.0, 10.0  # parameters of the edge-aware filter
MIN_WEIGHT = 1e-12  # below it, no trusted match is within the filter's reach
REFERENCE_WIDTH = 640  # px; windows and gradients refer to this width: wider images have wider, flatter edges
REFINE_WINDOW_PX, HIGH_PASS_PX = 11, 15
REFINE_DAMPING = 20.0  # grey levels squared: below this mean squared gradient the matcher's own value wins
MAX_REFINEMENT_PX = 1.0  # beyond it the linearisation of one step is invalid
BLACK_LEVEL, BLACK_PX = 10, 5  # no confidence where the mean over the window is at most this level
SATURATED_LEVEL = 250
MAX_DEVIATION_PX, UNKNOWN_DEVIATION_PX = 3.0, 1.0  # the latter where the matching directions disagree
DEVIATION_FLOOR_PX, DEVIATION_EXPONENT = 0.03, 0.37
EVIDENCE_FLOOR, EVIDENCE_EXPONENT = 0.1, 0.3
NOISE_FLOOR = 0.02
"""Fitted model of the expected error: offset and power of deviation (reduced px) and of evidence; offset of noise."""
ERROR, ERROR_PX = 1.0, 0.5
"""Measured factor of the expected error; expected error at which confidence is a half."""
TEXTURE_FOR_TRUST = 1.0  # below this mean squared gradient (grey levels squared) confidence falls: nothing to match
UNSURE_TRUST = 0.25  # factor on confidence where highlights hide the surface or one eye does not see it
MIN_CONFIDENCE = 12  # of 255: below it a depth is a guess


@dataclass(frozen=True)
class MatchPlan:
    """The disparities to search, common to all frames of a clip.

    min_disparity_px <= d < max_disparity_px. Depth outside depth_range_mm is dropped.
    """

    min_disparity_px: float
    max_disparity_px: float
    depth_range_mm: tuple[float, float] = (MIN_DEPTH_MM, MAX_DEPTH_MM)


def match(
    left: Grey, right: Grey, plan: MatchPlan, tissue: NDArray[np.bool_] | None = None
) -> tuple[Image, NDArray[np.uint8]]:
    """Disparity [H, W] float32 in px and confidence [H, W] uint8 of one rectified pair, in the left eye's pixels.

    Confidence falls with the expected error (ERROR_PX); 0: the picture is black or the match is a guess. Pixels that
    are flat, saturated or visible to one eye alone are filled from their surroundings at low confidence.

    tissue [H, W]: of the left eye; the rest is instruments. Neither is filled from the other. None: all is tissue.
    """
    height, width = left.shape
    factor = -(-width // MATCHING_WIDTH)
    size = (round(width / factor), round(height / factor))
    scale = size[0] / width
    low = int(np.floor(plan.min_disparity_px * scale))
    count = 16 * max(1, int(np.ceil((plan.max_disparity_px * scale - low - SPARE_STEPS) / 16)))
    small = _resized(left, size)
    found, agreed = semi_global(small, _resized(right, size), low, count)
    trust = evidence(found, agreed, small)
    trust[(found < low + ENDS_PX) | (found > low + count - 1 - ENDS_PX)] = 0
    if tissue is None or tissue.all():
        coarse = _smoothed(found, trust, small)
    else:
        instrument = cv2.resize((~tissue).view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA) > 0
        coarse = _smoothed(found, trust * instrument, small)
        trust[~instrument & beside_instruments(found, trust, instrument)] = 0
        coarse = np.where(instrument, coarse, _smoothed(found, trust * ~instrument, small))
    deviation = np.where(agreed, np.minimum(np.abs(found - coarse), MAX_DEVIATION_PX), UNKNOWN_DEVIATION_PX)
    uncertainty = uncertainty_of(_mean(deviation.astype(np.float32), ROUGHNESS_PX), _mean(trust, EVIDENCE_PX))
    disparity, texture, residual = _refine(_enlarged(coarse, left) / np.float32(scale), left, right)
    confidence = confidence_of(_enlarged(uncertainty, left), texture, residual)
    x_right = np.arange(width, dtype=np.float32) - disparity
    unsure = (left >= SATURATED_LEVEL) | (x_right < 0) | (x_right > width - 1)
    confidence[unsure] = np.maximum(confidence[unsure] * UNSURE_TRUST, np.minimum(confidence[unsure], MIN_CONFIDENCE))
    confidence[cv2.blur(left, (BLACK_PX, BLACK_PX)) <= BLACK_LEVEL] = 0
    return disparity, np.rint(confidence).astype(np.uint8)


def semi_global(left: Grey, right: Grey, low: int, count: int) -> tuple[Image, NDArray[np.bool_]]:
    """Disparity [h, w], low <= d < low + count, and where both matching directions agree. count is a multiple of 16.

    Where they disagree, the disparity is below low.
    """
    before, after = max(low + count, 0), max(-low, 0)  # padding, so that the matcher covers the image's margins
    wide = [
        cv2.copyMakeBorder(_even_contrast(image), 0, 0, before, after, cv2.BORDER_REPLICATE) for image in (left, right)
    ]
    matcher = cv2.StereoSGBM.create(
        minDisparity=low,
        numDisparities=count,
        blockSize=BLOCK_PX,
        P1=SMALL_STEP_PENALTY * BLOCK_PX**2,
        P2=LARGE_STEP_PENALTY * BLOCK_PX**2,
        disp12MaxDiff=AGREEMENT_PX,
        uniquenessRatio=0,
        preFilterCap=PREFILTER_CAP,
        mode=cv2.STEREO_SGBM_MODE_SGBM,
    )
    found = matcher.compute(wide[0], wide[1])[:, before : before + left.shape[1]]
    return found.astype(np.float32) / DISPARITY_STEPS, found >= low * DISPARITY_STEPS


def _even_contrast(image: Grey) -> Grey:
    """Contrast-normalised picture: shows dark tissue and removes the fall-off of illumination."""
    values = image.astype(np.float32)
    mean = _mean(values, CONTRAST_PX)
    deviation = cv2.sqrt(np.maximum(_mean(values * values, CONTRAST_PX) - mean * mean, 0))
    even: Grey = np.clip(128 + CONTRAST * (values - mean) / (deviation + NOISE), 0, 255).astype(np.uint8)
    return even


def evidence(found: Image, agreed: NDArray[np.bool_], image: Grey) -> Image:
    """Weight [h, w] in [0, 1] of each match when pixels are filled from it."""
    counted = agreed.astype(np.float32)
    number = np.maximum(_mean(counted, ROUGHNESS_PX), 1e-6)
    mean = _mean(found * counted, ROUGHNESS_PX) / number
    variance = _mean(found * found * counted, ROUGHNESS_PX) / number - mean * mean
    values = image.astype(np.float32)
    gradient = cv2.Sobel(values - _mean(values, CONTRAST_PX), -1, 1, 0, ksize=1) * np.float32(0.5)
    texture = _mean(gradient * gradient, EVIDENCE_PX)
    trust: Image = counted * np.clip(1 - ROUGHNESS_PER_PX2 * variance, 0, 1) * (texture / (texture + EVIDENCE_TEXTURE))
    burnt_out = cv2.dilate((image >= SATURATED_LEVEL).astype(np.uint8), np.ones((3, 3), np.uint8))
    trust[burnt_out > 0] *= SATURATED_TRUST
    trust[(image <= BLACK_LEVEL) | (found > np.arange(found.shape[1]))] = 0  # the latter lie outside the right picture
    return trust


def beside_instruments(found: Image, trust: Image, instrument: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels [h, w] whose match may be an instrument's: near one, or occluded by one in the right eye.

    An instrument of disparity D occludes, for the right eye, a strip D - d wide to its left; d is the tissue's.
    """
    side = 2 * BESIDE_INSTRUMENTS_PX + 1
    beside = np.asarray(cv2.dilate(instrument.view(np.uint8), np.ones((side, side), np.uint8)), np.bool_)
    surface = found[~beside & (trust >= SURE_TRUST)]
    row, column = np.nonzero(instrument & (trust > 0))
    if surface.size and row.size:
        hidden = found[row, column] - np.percentile(surface, SURFACE_PERCENTILE)
        start = np.clip(column - 1 - np.ceil(np.maximum(hidden, 0)).astype(np.intp), 0, None)
        delta = np.zeros(found.shape, np.int32)
        np.add.at(delta, (row, start), 1)
        np.add.at(delta, (row, column), -1)
        beside |= delta.cumsum(axis=1) > 0
    return np.asarray(beside)


def _smoothed(found: Image, trust: Image, image: Grey) -> Image:
    """Edge-aware weighted mean of the trusted disparities; it fills every pixel."""
    guide = np.rint(np.sqrt(255 * image.astype(np.float32))).astype(np.uint8)  # the root makes shot noise even
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, SMOOTHNESS, COLOUR_SIGMA)
    weighted, weight = smoother.filter(found * trust), smoother.filter(trust)
    return np.where(weight > MIN_WEIGHT, weighted / np.maximum(weight, MIN_WEIGHT), found)


def uncertainty_of(deviation: Image, evidence: Image) -> Image:
    """The expected error's part from the reduced images: deviation from the smooth surface, over evidence."""
    by_deviation = cv2.pow(deviation + np.float32(DEVIATION_FLOOR_PX), DEVIATION_EXPONENT)
    uncertainty: Image = by_deviation / cv2.pow(evidence + np.float32(EVIDENCE_FLOOR), EVIDENCE_EXPONENT)
    return uncertainty


def confidence_of(uncertainty: Image, texture: Image, residual: Image) -> Image:
    """Confidence [H, W] in [0, 255] for the expected error in px: uncertainty times the root of the window's noise."""
    noise = residual / cv2.sqrt(texture + 1) + np.float32(NOISE_FLOOR)
    expected_px: Image = np.float32(ERROR) * uncertainty * cv2.sqrt(noise)
    confidence = 255 / (1 + (expected_px / np.float32(ERROR_PX)) ** 2)
    least = np.minimum(confidence, MIN_CONFIDENCE)
    textured: Image = np.maximum(confidence * np.minimum(texture / TEXTURE_FOR_TRUST, 1), least)
    return textured


def _mean(image: Image, size_px: int) -> Image:
    mean: Image = cv2.boxFilter(image, -1, (size_px, size_px))
    return mean


def _enlarged(image: Image, like: Grey) -> Image:
    enlarged: Image = cv2.resize(image, like.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return enlarged


def _resized(image: Grey, size: tuple[int, int]) -> Grey:
    same = image.shape[::-1] == size
    smaller: Grey = image if same else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return smaller


def _refine(disparity: Image, left: Grey, right: Grey) -> tuple[Image, Image, Image]:
    """One Lucas-Kanade step in x: d, texture (mean squared gradient) and residual (mean |difference|), all [H, W].

    R(x - d) is the right image warped onto the left image L. Minimise the window's sum of (R(x - d) - dd R' - L)^2:
    dd = sum(R' (R - L)) / sum(R'^2). The local means are subtracted first, because the eyes differ in exposure.
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
