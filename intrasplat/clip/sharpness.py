"""How sharp each frame is beside the frames around it in time, and how often training should draw it.

A frame's detail is measured in patches, as variance between neighbouring means over squares: fine detail, which blur
takes first, and coarse detail, which it leaves. Their ratio does not depend on light or contrast.

Symbols: H W pixels, K blocks of BLOCK_PX squared pixels, P patches of some blocks, T frames, N training frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import Eye
from intrasplat.machine.cores import cores
from intrasplat.machine.opencv import one_opencv_thread

Reals = NDArray[np.float64]
Grey = NDArray[np.float32]  # [H, W], levels of 255

BLOCK_PX, FINE_STEPS, STEPS = 16, 2, 4
"""A block is halved STEPS times to one value; the first FINE_STEPS halvings remove fine detail, the others coarse."""
PATCHES = 8
"""Patches along either side of the picture, if there are so many blocks."""
MIN_INSIDE = 0.5
"""Least share of a patch's blocks that show tissue alone."""
MASK_MARGIN_PX = 5
ANALYSED_WIDTH = 640
"""Larger pictures are shrunk to about this width: those of 4K endoscopes are soft at the pixel scale even in focus."""
NEAR, SHARP_PERCENTILE = 8, 75.0
"""Training frames before and behind one that it is compared with, twice as many at the clip's ends; which of them is
taken as sharp. Half may be blurred; where all are blurred alike, none is."""
NEAREST = 4
"""Training frames on either side whose whole pictures are compared as well, for tissue moves from patch to patch and
changes with the camera; the second sharpest of them counts as sharp."""
MIN_BLOCKS = 80
"""Blocks of the smallest picture that is judged: 160 x 128 pixels."""
MIN_COMPARED = 3
"""Fewest frames that a patch is compared with."""
MIN_COARSE_LEVELS, MIN_COARSE_SHARE = 1.0, 0.25
"""Coarse detail of a patch that is compared, and its least share of the usual one: less is blur that takes this too."""
MIN_RATIO = 1e-3
"""Fine over coarse detail: with less, as in pictures enlarged without smoothing, nothing can be compared."""
MIN_CONTINUITY, MIN_COMPARED_BLOCKS = 0.95, 9
"""Correlation of successive frames' blocks: 0.99 in videos; 0.6 in stills 3 s apart, which show different tissue."""
BLURRED = 0.82
"""Relative sharpness of a frame that is drawn less often: 0.9 and more in clean clips, 0.83 where an endoscope
advances by 30 mm in a second, 0.8 at a blur of 4 px of 640."""
STEEPNESS = 40.0
"""weight = (sharpness / BLURRED) ** STEEPNESS: 0.4 at 0.8, 0.1 at 0.78, 0 below 0.76, to a tenth."""
WEIGHT_STEPS = 10


@dataclass(frozen=True, eq=False)
class Detail:
    """Detail of a frame. NaN: masked.

    fine, coarse  [P] levels^2
    means         [K] levels
    """

    fine: Reals
    coarse: Reals
    means: Reals


def detail_of(grey: Grey, inside: NDArray[np.bool_] | None = None) -> Detail | None:
    """The detail of a picture where `inside` [H, W] (None: everywhere); None if it is smaller than a block."""
    rows, columns = (side // BLOCK_PX for side in grey.shape)
    if not rows or not columns:
        return None
    used, size = np.s_[: rows * BLOCK_PX, : columns * BLOCK_PX], (columns, rows)
    means, squares = np.ascontiguousarray(grey[used]), []
    for step in range(STEPS + 1):
        squares.append(cv2.resize(means * means, size, interpolation=cv2.INTER_AREA))
        if step < STEPS:
            means = cv2.resize(means, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    whole = np.ones((rows, columns), np.bool_)
    if inside is not None:
        whole = cv2.resize(inside[used].astype(np.float32), size, interpolation=cv2.INTER_AREA) > 1 - 1e-4
    fine, coarse = squares[0] - squares[FINE_STEPS], squares[FINE_STEPS] - squares[STEPS]
    return Detail(_patch_means(fine, whole), _patch_means(coarse, whole), np.where(whole, means, np.nan).ravel())


def sharpness_and_contrast(eye: Eye, index: int) -> tuple[float, float]:
    """Logarithms of a frame's fine over coarse detail and of its coarse detail, levels: medians over patches.

    NaN in a picture that is too small to be judged, or without detail.
    """
    found = detail_of(*_analysed(eye, index))
    eye.let_go(index)
    if found is None or found.means.size < MIN_BLOCKS:
        return math.nan, math.nan
    textured = np.isfinite(found.fine) & (np.nan_to_num(found.coarse) > MIN_COARSE_LEVELS**2) & (found.fine > 0)
    if not textured.any():
        return math.nan, math.nan
    fine, coarse = np.log(found.fine[textured]) / 2, np.log(found.coarse[textured]) / 2
    return float(np.median(fine - coarse)), float(np.median(coarse))


def relative_sharpness(details: Mapping[int, Detail], train: Sequence[int]) -> dict[int, float]:
    """The sharpness of frames, each relative to sharp training frames near it; 1 where nothing can be compared.

    Args:
        details: of frames, by index, among them those of `train`.
        train: rising.
    """
    if len(train) < MIN_COMPARED:
        return dict.fromkeys(details, 1.0)
    fine, coarse = (np.stack([getattr(details[index], name) for index in train]) for name in ("fine", "coarse"))
    alike = np.array([_correlation(details[one].means, details[two].means) for one, two in pairwise(train)])
    whole, found = {index: _ratio(detail) for index, detail in details.items()}, {}
    for index, detail in details.items():
        near, nearest = _around(index, train, NEAR), _around(index, train, NEAREST)
        found[index] = 1.0
        if np.median(alike[near]) >= MIN_CONTINUITY:
            usual = sorted(whole[other] for other in train[nearest])[-2]
            by_whole = whole[index] / usual if usual > MIN_RATIO else 1.0
            found[index] = max(by_whole, _sharpness(detail, fine[near], coarse[near]))
    return found


def frame_weights(eye: Eye, frames: Sequence[int], train: Sequence[int]) -> dict[int, float]:
    """The weights below 1, in tenths, of those of `frames` that are blurred beside the training frames around them.

    frames: indices, among them those of `train`, rising.
    """

    def look(index: int) -> Detail | None:
        found = detail_of(*_analysed(eye, index))
        eye.let_go(index)
        return found

    with one_opencv_thread(), ThreadPoolExecutor(cores()) as pool:
        analysed = zip(frames, pool.map(look, frames), strict=True)
        details = {index: each for index, each in analysed if each is not None and each.means.size >= MIN_BLOCKS}
    found = relative_sharpness(details, [index for index in train if index in details])
    steps = {index: round(WEIGHT_STEPS * (share / BLURRED) ** STEEPNESS) for index, share in found.items()}
    return {index: step / WEIGHT_STEPS for index, step in steps.items() if step < WEIGHT_STEPS}


def _around(index: int, train: Sequence[int], count: int) -> slice:
    """The places in `train` of the `count` frames on either side of a frame, and twice as many at the clip's ends."""
    place = int(np.searchsorted(train, index))
    first = max(0, min(place - count, len(train) - 2 * count - 1))
    return slice(first, first + 2 * count + 1)


def _analysed(eye: Eye, index: int) -> tuple[Grey, NDArray[np.bool_]]:
    """Grey levels of a frame, shrunk to about ANALYSED_WIDTH, and where it shows tissue away from masks."""
    side = max(1, round(eye.intrinsics.width / ANALYSED_WIDTH))
    height, width = (length // side * side for length in eye.tissue.shape[1:])
    grey = cv2.cvtColor(np.ascontiguousarray(eye.rgb[index][:height, :width]), cv2.COLOR_RGB2GRAY)
    size, margin = (width // side, height // side), np.ones((MASK_MARGIN_PX * side,) * 2, np.uint8)
    inside = cv2.erode(eye.tissue[index][:height, :width].astype(np.uint8), margin)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return small, cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST) > 0


def _patch_means(values: NDArray[np.float32], whole: NDArray[np.bool_]) -> Reals:
    """Means [P] over the whole blocks of each patch; NaN where too few are whole."""
    sums = []
    for each in (np.where(whole, values, 0), whole, np.ones_like(whole)):
        rows, columns = (np.linspace(0, side, min(PATCHES, side), endpoint=False).astype(int) for side in each.shape)
        sums.append(np.add.reduceat(np.add.reduceat(each, rows, axis=0, dtype=np.float64), columns, axis=1).ravel())
    total, inside, blocks = sums
    return np.where(inside >= MIN_INSIDE * blocks, total / np.maximum(inside, 1), np.nan)


def _ratio(detail: Detail) -> float:
    """Fine over coarse detail of a whole frame, as levels over levels; 0 without any."""
    textured = np.isfinite(detail.fine) & (np.nan_to_num(detail.coarse) > MIN_COARSE_LEVELS**2)
    return float(np.sqrt(detail.fine[textured].sum() / detail.coarse[textured].sum())) if textured.any() else 0.0


def _correlation(one: Reals, two: Reals) -> float:
    both = np.isfinite(one) & np.isfinite(two)
    if both.sum() < MIN_COMPARED_BLOCKS or not (one[both].std() and two[both].std()):
        return 0.0
    return float(np.corrcoef(one[both], two[both])[0, 1])


def _sharpness(detail: Detail, fine: Reals, coarse: Reals) -> float:
    """The sharpness of a frame relative to others of detail fine, coarse [N, P]: a median over patches."""
    usual = _percentile(coarse, 50.0)
    compared = np.isfinite(detail.fine) & (np.nan_to_num(usual) > MIN_COARSE_LEVELS**2)
    if not compared.any():
        return 1.0
    fine, coarse, least = fine[:, compared], coarse[:, compared], MIN_COARSE_SHARE**2 * usual[compared]
    sharp = _percentile(fine / np.maximum(coarse, least), SHARP_PERCENTILE)
    own = detail.fine[compared] / np.maximum(detail.coarse[compared], least)
    return float(np.sqrt(np.median(own / np.maximum(sharp, 1e-9))))


def _percentile(values: Reals, percentile: float) -> Reals:
    """A percentile [P] of the numbers in each column of values [N, P]; NaN where they are fewer than MIN_COMPARED."""
    counts = np.isfinite(values).sum(axis=0)
    rows = np.rint((counts - 1) * percentile / 100).astype(int)
    found = np.sort(values, axis=0)[np.maximum(rows, 0), np.arange(values.shape[1])]  # NaN come last
    return np.where(counts >= MIN_COMPARED, found, np.nan)
