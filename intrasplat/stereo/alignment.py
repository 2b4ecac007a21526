"""The shift between the eyes' rows and the disparity range of a clip, measured on a few pairs.

Symbols: H W pixels of one eye; d disparity, x_left - x_right in px; dy = y_right - y_left of matching points in px.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.features import Features, matched
from intrasplat.clip.sampling import Mapping
from intrasplat.errors import InputError
from intrasplat.stereo.matching import Grey, Image, evidence, semi_global

Agreed = Callable[[NDArray[np.uint8], NDArray[np.uint8], int, int], tuple[Image, NDArray[np.bool_]]]
"""The signature of agreed_disparities, which another device may implement."""

MAX_MATCH_DY_PX = 48.0  # matches farther apart in y are wrong
MIN_MATCHES = 20
MAX_CORRECTION_PX = 8.0  # a larger row shift means that the calibration belongs to other frames
MAX_EQUAL_ROWS_PX = 1.0  # row difference below which frames count as rectified already
SWAPPED_SHARE = 0.8
COARSE_WIDTH = 176  # px; wide enough for tissue, so that a search of all disparities takes milliseconds
MAX_DISPARITY_SHARE = 0.6  # of the width: beyond it the eyes overlap too little
MIN_EVIDENCE = 0.8  # minimum evidence of a match that counts
MIN_TEXTURE = 8.0  # mean |gradient| in grey levels; below it matches are random
RANGE_PERCENTILES = (0.5, 99.5)
RANGE_MARGIN_PX, RANGE_MARGIN = 3.0, 0.1  # the sampled frames do not show every disparity of the clip


@dataclass(frozen=True)
class RowShift:
    """Median dy of the inlier matches, and their number."""

    shift_px: float
    matches: int


def match_features(left: Features, right: Features) -> NDArray[np.float64]:
    """Matches [M, 4] (x_left, y_left, x_right, y_right) that pass the ratio test and lie on similar rows."""
    one, other = matched(left, right).T
    matches = np.concatenate([left.points[one], right.points[other]], axis=1)
    near: NDArray[np.float64] = matches[np.abs(matches[:, 3] - matches[:, 1]) <= MAX_MATCH_DY_PX]
    return near


def measure_row_shift(matches: NDArray[np.float64], infinity_px: float, equal_rows_px: float = 0.0) -> RowShift:
    """The shift between the eyes' rows from matches [M, 4] of several frames.

    infinity_px is the disparity of a point at infinity; real points have more. equal_rows_px is the shift that
    rectification gives to points on equal rows of the recorded frames.

    Raises:
        InputError: the frames are rectified already, the eyes seem to be swapped, or their rows differ by more than
            MAX_CORRECTION_PX.
    """
    dy = matches[:, 3] - matches[:, 1]
    disparity_px = matches[:, 0] - matches[:, 2]
    if len(dy) < MIN_MATCHES:
        return RowShift(0.0, 0)
    centre = _densest(dy)
    spread = np.median(np.abs(dy[np.abs(dy - centre) < 3.0] - centre))
    inliers = np.abs(dy - centre) < max(1.5, 4 * float(spread))
    shift = RowShift(shift_px=float(np.median(dy[inliers])), matches=int(inliers.sum()))
    if shift.matches < max(MIN_MATCHES, len(dy) // 4):
        return RowShift(0.0, 0)
    _check_recorded(shift.shift_px, equal_rows_px)
    _check_eyes(disparity_px[inliers] - infinity_px)
    if abs(shift.shift_px) > MAX_CORRECTION_PX:
        raise InputError(
            "calibration",
            f"after rectification the rows of left and right differ by {shift.shift_px:.1f} px; "
            f"at most {MAX_CORRECTION_PX:.0f} can be corrected.",
            "Give the calibration that was made for this recording, and frames that were not cropped.",
        )
    return shift


def choose_range(
    pairs: Sequence[tuple[Grey, Grey]],
    infinity_px: float,
    focal_baseline_px_mm: float,
    depth_range_mm: tuple[float, float],
    agreed: Agreed,
) -> tuple[float, float]:
    """The disparity range (low, high) in px of rectified pairs, from a coarse search over depth_range_mm.

    Only textured pixels count at which both matching directions agree.

    Raises:
        InputError: no pair has matching points.
    """
    height, width = pairs[0][0].shape
    scale = min(1.0, COARSE_WIDTH / width)
    size = (round(width * scale), round(height * scale))
    farthest, nearest = (infinity_px + focal_baseline_px_mm / depth_mm for depth_mm in reversed(depth_range_mm))
    nearest = min(nearest, farthest + MAX_DISPARITY_SHARE * width)
    low = int(np.floor(farthest * scale))
    count = 16 * max(1, int(np.ceil((nearest * scale - low) / 16)))
    lefts = np.stack([_resized(left, size) for left, _ in pairs])
    rights = np.stack([_resized(right, size) for _, right in pairs])
    found, both_agree = agreed(lefts, rights, low, count)
    textured = np.stack([cv2.boxFilter(np.abs(cv2.Sobel(left, cv2.CV_32F, 1, 0)), -1, (5, 5)) for left in lefts])
    within = (found >= farthest * scale) & (found <= nearest * scale)
    disparities = found[both_agree & within & (textured > MIN_TEXTURE)].astype(np.float64) / scale
    if disparities.size < 0.02 * size[0] * size[1] * len(pairs):
        raise InputError(
            "clip",
            f"left and right have hardly a matching point {depth_range_mm[0]:g} to {depth_range_mm[1]:g} mm away.",
            "Check that both eyes show the same scene at the same time, in focus, and that the layout and the "
            "calibration are right; for other distances give min_depth_mm and max_depth_mm.",
        )
    near_low, near_high = np.percentile(disparities, RANGE_PERCENTILES)
    margin = RANGE_MARGIN_PX + RANGE_MARGIN * (near_high - near_low)
    return max(float(near_low - margin), farthest), min(float(near_high + margin), nearest)


def outside_share(
    matches: NDArray[np.float64],
    shift: RowShift,
    infinity_px: float,
    focal_baseline_px_mm: float,
    depth_range_mm: tuple[float, float],
) -> float:
    """Share of the matches [M, 4] on equal rows whose depth is outside depth_range_mm; 0 if there are few."""
    on_row = np.abs(matches[:, 3] - matches[:, 1] - shift.shift_px) < MAX_EQUAL_ROWS_PX
    if on_row.sum() < MIN_MATCHES:
        return 0.0
    per_mm = (matches[on_row, 0] - matches[on_row, 2] - infinity_px) / focal_baseline_px_mm
    return float(np.mean((per_mm > 1 / depth_range_mm[0]) | (per_mm < 1 / depth_range_mm[1])))


def _densest(values: NDArray[np.float64]) -> float:
    """Median of the 2 px window with the most values: a robust initial value even if most matches are wrong."""
    ordered = np.sort(values)
    counts = np.searchsorted(ordered, ordered + 2.0, side="right") - np.arange(len(ordered))
    first = int(np.argmax(counts))
    return float(np.median(ordered[first : first + counts[first]]))


def _check_recorded(shift_px: float, equal_rows_px: float) -> None:
    """Refuse frames whose rows match before rectification but not after it: they are rectified already."""
    if abs(equal_rows_px) <= 2 * MAX_EQUAL_ROWS_PX or abs(shift_px - equal_rows_px) > MAX_EQUAL_ROWS_PX:
        return
    raise InputError(
        "calibration",
        f"the rows of left and right match in the frames as given, to {abs(shift_px - equal_rows_px):.1f} px, and this "
        f"calibration moves them {abs(shift_px):.1f} px apart: the frames are rectified already.",
        "Give the calibration of the rectified pair (our JSON, model rectified), or the frames as recorded.",
    )


def _check_eyes(beyond_infinity_px: NDArray[np.float64]) -> None:
    """Refuse pairs whose points lie behind the cameras: swapped eyes, or one eye shown twice."""
    if float(np.mean(beyond_infinity_px <= 0)) < SWAPPED_SHARE:
        return
    raise InputError(
        "clip",
        f"matching points have a median disparity of {float(np.median(beyond_infinity_px)):.1f} px relative to "
        "infinity, which places them behind the cameras.",
        "Left and right are probably swapped, or both eyes show the same picture: swap them or check the layout.",
    )


def agreed_disparities(
    left: NDArray[np.uint8], right: NDArray[np.uint8], low: int, count: int, each: Mapping = map
) -> tuple[Image, NDArray[np.bool_]]:
    """Disparities [F, h, w] of pairs, with low <= d < low + count, and where both matching directions agree.

    each: a thread pool's map matches pairs in parallel.
    """

    def of_pair(pair: tuple[Grey, Grey]) -> tuple[Image, NDArray[np.bool_]]:
        disparity, both = semi_global(*pair, low, count)
        return disparity, evidence(disparity, both, pair[0]) > MIN_EVIDENCE

    disparity, agreed = zip(*each(of_pair, zip(left, right, strict=True)), strict=True)
    return np.stack(disparity), np.stack(agreed)


def _resized(image: Grey, size: tuple[int, int]) -> Grey:
    smaller: Grey = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return smaller
