"""Tells depth in millimetres from pictures that look like it: disparity, depth stretched for display, another unit.

Symbols: T frames, H W pixels, M points.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import RgbFrame
from intrasplat.errors import InputError
from intrasplat.notices import Notice, NoticeCode

Reals = NDArray[np.float64]

USUAL_DEPTH_MM = (5.0, 500.0)  # working distances of endoscopes with an ample margin; other units fall outside
LIKELY_DEPTH_MM = (20.0, 200.0)
FACTORS = {256.0: "times 256", 1000.0: "micrometres", 100.0: "hundredths of a millimetre", 0.001: "metres"}

TOPS = (255, 65535)
DISPLAY_LOW, DISPLAY_HIGH = 0.008, 0.996
"""Of a top: values stretched for display to 8 or 16 bits begin and end there in every frame."""
MIN_STRETCH = 3.0
"""Of the depths at 98 and 2 % of the pixels, in frames with values so low and so high; outliers alone have less."""
STRETCHED_SHARE = 0.9
MAX_SORTED = 10_000

FRAMES_LOOKED_AT = 8
FRAMES_APART = (6, 3, 1)
"""The farthest at which MIN_TRACKED corners are found again shows the most parallax."""
MIN_TRACKED = 150
MIN_RIM_PIXELS = 50
BEHIND = 1.05
"""Depth of instruments over that of the tissue around: 0.6 to 0.7 in real depth, 1.5 and more in disparity."""
MAX_POINTS, MIN_POINTS = 300, 40
MIN_PARALLAX_PX = 1.5
INVERTED_RANK = 0.4
"""Rank correlation of the values with the nearness that parallax shows; in depth it is negative."""
MIN_SCALE_OFF = 3.0
MIN_BEFORE = 0.8
"""Share of the points that the path places before the camera; with less the path itself is wrong."""

_NO_POINTS = np.empty((0, 2)), np.empty((0, 2))
_REMEDY = "Give millimetres as grey PNG, 16 bit for more than 255; depth_mm = focal_px * baseline_mm / disparity_px."
_STRETCHED_REMEDY = "Give the depth before it was scaled for display, in millimetres; set pixels without depth to 0."


def check_not_stretched(depth: NDArray[np.float32], field: str) -> None:
    """InputError if values [T, H, W] fill 8 or 16 bits in nearly every frame, as pictures for display do."""
    filled, spreads = [], []
    for frame in depth:
        if not (valid := frame[frame > 0]).size:
            continue
        least, most = float(valid.min()), float(valid.max())
        filled.append(any(least <= DISPLAY_LOW * top and DISPLAY_HIGH * top <= most <= top for top in TOPS))
        low, high = np.percentile(valid[:: max(1, valid.size // MAX_SORTED)], (2, 98))
        spreads.append(high / low)
    if filled and np.mean(filled) >= STRETCHED_SHARE and np.median(spreads) > MIN_STRETCH:
        problem = "depth/ fills its whole range of numbers in every frame: it was stretched for display."
        raise InputError(field, problem, _STRETCHED_REMEDY)


def unit_warnings(median: float) -> tuple[Notice, ...]:
    """The warning about a median depth that no endoscope has, with the unit that it may be in."""
    low, high = USUAL_DEPTH_MM
    if low <= median <= high:
        return ()
    low, high = LIKELY_DEPTH_MM
    likely = [f"{words} ({median / each:.0f} mm)" for each, words in FACTORS.items() if low <= median / each <= high]
    text = f"depth: its median is {median:.1f} mm, unusual for an endoscope; is it in millimetres?"
    return (Notice.warning(NoticeCode.DEPTH_UNUSUAL, text + (f" It may be {' or '.join(likely)}." if likely else "")),)


def instrument_warnings(depth: NDArray[np.float32], tissue: NDArray[np.bool_]) -> tuple[Notice, ...]:
    """The warning about instruments that lie behind the tissue around them: then near values are large.

    depth, tissue [T, H, W]. Of a camera that rests, with one eye, nothing else tells disparity from depth.
    """
    ratios = [ratio for i in _spread(len(depth)) if (ratio := _at_the_rim(depth[i], tissue[i])) is not None]
    behind = sum(ratio > BEHIND for ratio in ratios)
    before = sum(ratio < 1 / BEHIND for ratio in ratios)
    if behind <= max(len(ratios) / 2, 4 * before):
        return ()
    text = (
        f"depth: instruments lie behind the tissue around them, by {np.median(ratios):.1f} times its depth; does "
        "depth/ hold disparity, or are the masks inverted?"
    )
    return (Notice.warning(NoticeCode.DEPTH_INVERTED, text),)


def parallax_warnings(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    tissue: NDArray[np.bool_],
    world_from_camera: Reals,
    k: tuple[float, float, float],
    field: str,
) -> tuple[Notice, ...]:
    """The warning about depth of another scale than the given path of the camera shows; k is focal length, cx, cy.

    InputError if values grow where the parallax of a moving camera shows that tissue is nearer.
    """
    if np.allclose(world_from_camera[:, :3, 3], world_from_camera[0, :3, 3], atol=1e-6):
        return ()
    found = []
    for i in _spread(len(rgb)):
        for apart in FRAMES_APART:
            j = i + apart if i + apart < len(rgb) else i - apart
            points, moved = _tracked(rgb[i], rgb[j], tissue[i] & (depth[i] > 0)) if j >= 0 else _NO_POINTS
            if len(points) >= MIN_TRACKED:
                break
        second_from_first = np.linalg.inv(world_from_camera[j]) @ world_from_camera[i]
        nearness, parallax_px = _nearness(points, moved, second_from_first, k)
        far = parallax_px > MIN_PARALLAX_PX
        found.append((nearness[far], _values(depth[i], points[far])))
    nearness, values = (np.concatenate(each) for each in zip(*found, strict=True))
    if len(values) < MIN_POINTS or np.mean(nearness > 0) < MIN_BEFORE:
        return ()
    _check_not_inverted(found, field, "the moving camera")
    times = float(np.median(nearness * values))
    if 1 / MIN_SCALE_OFF < times < MIN_SCALE_OFF:
        return ()
    text = f"depth: by the camera's path it is {times:.3g} times the distance; are both in millimetres?"
    return (Notice.warning(NoticeCode.DEPTH_UNUSUAL, text),)


def check_with_right_eye(
    pairs: Iterable[tuple[RgbFrame, RgbFrame]], depth: Iterable[NDArray[np.float32]], field: str
) -> None:
    """InputError if values grow where the second eye shows that tissue is nearer. Its baseline may be unknown."""
    found = []
    for (left, right), values in zip(pairs, depth, strict=True):
        points, moved = _tracked(left, right, values > 0)
        level = np.abs(points[:, 1] - moved[:, 1]) < MIN_PARALLAX_PX
        found.append(((points - moved)[level, 0], _values(values, points[level])))
    _check_not_inverted(found, field, "the right eye")


def _check_not_inverted(found: Iterable[tuple[Reals, Reals]], field: str, witness: str) -> None:
    """InputError if, in most frames, values [M] rise with the nearness [M] that the witness shows."""
    ranks = [_rank_correlation(nearness, values) for nearness, values in found if len(values) >= MIN_POINTS]
    if ranks and np.median(ranks) > INVERTED_RANK:
        problem = f"depth/ grows where {witness} shows that tissue is nearer: it holds disparity or nearness."
        raise InputError(field, problem, _REMEDY)


def _spread(count: int) -> Iterator[int]:
    """FRAMES_LOOKED_AT frames, evenly over the clip."""
    yield from range(0, count, -(-count // FRAMES_LOOKED_AT))


def _at_the_rim(depth: NDArray[np.float32], tissue: NDArray[np.bool_]) -> float | None:
    """Median depth of the instruments over that of the tissue, within 1/40 of the width of their rim; None: too few."""
    kernel = np.ones((2 * (depth.shape[1] // 40) + 1,) * 2, np.uint8)
    sides = []
    for side in (~tissue, tissue):
        rim = side & (cv2.dilate((~side).astype(np.uint8), kernel) > 0) & (depth > 0)
        if np.count_nonzero(rim) < MIN_RIM_PIXELS:
            return None
        sides.append(float(np.median(depth[rim])))
    return sides[0] / sides[1]


def _tracked(first: RgbFrame, second: RgbFrame, where: NDArray[np.bool_]) -> tuple[Reals, Reals]:
    """Corners [M, 2] (x, y; pixel centres are whole) of the first picture and their places in the second."""
    grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (first, second)]
    corners = cv2.goodFeaturesToTrack(grey[0], MAX_POINTS, 0.01, 5, mask=where.astype(np.uint8))
    if corners is None:
        return _NO_POINTS
    there, good, _ = cv2.calcOpticalFlowPyrLK(grey[0], grey[1], corners, None)
    back, good_back, _ = cv2.calcOpticalFlowPyrLK(grey[1], grey[0], there, None)
    followed = (good & good_back).ravel().astype(bool) & (np.abs(back - corners).max(axis=(1, 2)) < 0.5)
    return corners[followed, 0].astype(np.float64), there[followed, 0].astype(np.float64)


def _values(depth: NDArray[np.float32], points: Reals) -> Reals:
    """The values [M] at points (x, y)."""
    x, y = np.rint(points).astype(int).T
    return np.asarray(depth[y, x], np.float64)


def _nearness(
    points: Reals, moved: Reals, second_from_first: Reals, k: tuple[float, float, float]
) -> tuple[Reals, Reals]:
    """1 / depth (1/mm) of points from where they are seen next, and how far this is from infinitely far points, px."""
    focal, cx, cy = k
    rays, seen = (
        np.column_stack([(each - (cx - 0.5, cy - 0.5)) / focal, np.ones(len(each))]) for each in (points, moved)
    )
    turned = rays @ second_from_first[:3, :3].T
    a, b = np.cross(seen, turned), np.cross(seen, second_from_first[:3, 3])
    nearness = -(a * b).sum(axis=1) / np.maximum((b * b).sum(axis=1), 1e-12)
    parallax_px = focal * np.linalg.norm(turned[:, :2] / turned[:, 2:] - seen[:, :2], axis=1)
    return nearness, parallax_px


def _rank_correlation(one: Reals, other: Reals) -> float:
    """Spearman's, of values that may be equal in part; 0 if either is constant."""
    if np.ptp(one) == 0 or np.ptp(other) == 0:
        return 0.0
    first, second = (np.unique(each, return_inverse=True)[1].astype(np.float64) for each in (one, other))
    return float(np.corrcoef(first, second)[0, 1])
