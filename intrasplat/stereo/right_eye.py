"""Depth and masks of the right eye of a matched clip, warped from the left eye.

Symbols: T frames, H W pixels of one eye; d disparity, x_left - x_right in px. Both pixels of a rectified match have the
same depth, so the right eye needs no search of its own. Surfaces that the left eye does not see get no depth.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Number = TypeVar("Number", bound=np.generic)

SMOOTHED_PX = 3
"""Side of the median filter that closes cracks of a stretched surface and removes background visible through them."""
MAX_STEP_PX = 1.0
"""Disparities of neighbouring left pixels are averaged only if they differ by at most this."""
CLOSED_SHARE, GROWN_SHARE = 0.03, 0.014
"""Share of the width: gaps in a warped instrument mask that are closed; how far it grows: matching blurs outlines."""
ROWS_AT_ONCE = 64
"""Rows that are warped at once: few enough to stay in the processor's cache, which halves the time."""
DIRECTION_SHARE, MIN_DIRECTION_PX, MAX_SLOPE, BORDER_PX = 0.06, 6, 3.0, 8
"""An instrument's direction at the border is measured over this share of the width, and at least this many px."""
MAX_OVERLAY_LEVELS = 8.0
"""Maximum median difference of the eyes, of 255, at equal pixels of an overlay such as a label."""


def moved_depth(
    depth_mm: Image, confidence: NDArray[np.uint8], focal_baseline: float, offset_px: float
) -> tuple[Image, NDArray[np.uint8]]:
    """Depth in mm and confidence [H, W] of the right eye, from those of the left; 0 where the left eye sees nothing.

    The nearest surface wins: of left pixels that map to one right pixel, the last in the row has the most disparity.
    """
    height, width = depth_mm.shape
    valid = depth_mm > 0
    left_px = _ratio(focal_baseline, depth_mm, valid, offset_px)
    right_px = cv2.medianBlur(_moved(left_px, valid, left_px), SMOOTHED_PX)
    x, y = right_px + np.arange(width, dtype=np.float32), _row_numbers(height, width)
    known = cv2.remap(valid.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=0)
    between = cv2.remap(left_px, x, y, cv2.INTER_LINEAR, borderValue=0)
    smooth = cv2.absdiff(between, right_px) < MAX_STEP_PX
    smooth &= known > 0.999
    found = right_px > 0
    beyond_infinity_px = right_px
    np.copyto(beyond_infinity_px, between, where=smooth)
    beyond_infinity_px -= np.float32(offset_px)
    found &= beyond_infinity_px > 0
    trust = np.asarray(cv2.remap(confidence, x, y, cv2.INTER_NEAREST, borderValue=0), np.uint8)
    return _ratio(focal_baseline, beyond_infinity_px, found), trust * found


def moved_tissue(tissue: Mask, depth_mm: Image, focal_baseline: float, offset_px: float) -> Mask:
    """Tissue [H, W] of the right eye: all pixels without the left eye's instruments.

    An instrument's pixels without depth get that of its nearest pixel with depth. An instrument that leaves the left
    picture on the right is extended straight into the strip that only the right eye sees.
    """
    tool = ~tissue
    if not tool.any():
        return np.ones_like(tissue)
    width = tissue.shape[1]
    found = depth_mm > 0
    disparity = _ratio(focal_baseline, depth_mm, found, offset_px)
    left, top, across, down = cv2.boundingRect(tool.astype(np.uint8))
    box = slice(top, top + down), slice(left, left + across)  # contains all wanted and all known pixels
    disparity[box] = nearest_known(disparity[box], (found & tool)[box], (~found & tool)[box])
    moved = _moved(disparity, tool, tool.astype(np.uint8))
    for run in _runs(np.asarray(tool[:, -2:].any(axis=1))):
        _go_on(moved, tool, disparity, run)
    closed = cv2.morphologyEx(moved, cv2.MORPH_CLOSE, _box(CLOSED_SHARE * width))
    grown: Mask = cv2.dilate(closed, _box(GROWN_SHARE * width)) == 0
    return grown


def seen_nowhere(depth_mm: Image, focal_baseline: float, offset_px: float, supported: NDArray[np.uint8]) -> Mask:
    """The pixels [H, W] of the left eye with a depth whose match lies where the right eye sees nothing.

    supported: [H, W] 1 where the right eye sees something.
    """
    height, width = depth_mm.shape
    valid = depth_mm > 0
    there = np.arange(width, dtype=np.float32) - _ratio(focal_baseline, depth_mm, valid, offset_px)
    seen = cv2.remap(supported, there, _row_numbers(height, width), cv2.INTER_NEAREST, borderValue=0)
    return np.asarray(valid & (seen == 0))


def _runs(chosen: Mask) -> list[slice]:
    """The runs of chosen pixels in a column [H]."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]))).tolist()
    return [slice(first, end) for first, end in zip(ends[::2], ends[1::2], strict=True)]


def _go_on(moved: NDArray[np.uint8], tool: Mask, disparity: Image, run: slice) -> None:
    """Extend, in the right eye's mask [H, W], the instrument in rows `run` of the left picture's right border.

    Its upper and lower edge are extended straight; an edge at the picture's own border stays there.
    """
    height, width = tool.shape
    edges, here = [(run.start, run.stop)], run
    for column in range(width - 3, width - 3 - round(DIRECTION_SHARE * width), -1):
        touching = [each for each in _runs(tool[:, column]) if each.start <= here.stop and each.stop >= here.start]
        if not touching:
            break
        here = max(touching, key=lambda each: min(each.stop, here.stop) - max(each.start, here.start))
        edges.append((here.start, here.stop))
    slopes = np.polyfit(-np.arange(len(edges)), edges, 1)[0] if len(edges) >= MIN_DIRECTION_PX else np.zeros(2)
    slopes = np.clip(slopes, -MAX_SLOPE, MAX_SLOPE)
    at_border = np.where(tool[run], disparity[run], -np.inf)[:, -BORDER_PX:]
    if not np.isfinite(at_border).any():
        return
    nearest_px = float(at_border.max())
    top = 0.0 if run.start == 0 else slopes[0] * nearest_px
    bottom = 0.0 if run.stop == height else slopes[1] * nearest_px
    first = max(int(width - 2 - nearest_px), 0)
    corners = [(first, run.start), (width, run.start + top), (width, run.stop - 1 + bottom), (first, run.stop - 1)]
    cv2.fillPoly(moved, [np.rint(corners).astype(np.int32)], 1)


def painted_over(left: NDArray[np.uint8], right: NDArray[np.uint8], never_tissue: Mask) -> Mask:
    """Labels: the pixels [H, W] that are never tissue and look the same in both eyes [H, W, 3]."""
    count, part = cv2.connectedComponents(never_tissue.astype(np.uint8))
    difference = cv2.absdiff(left, right).mean(axis=2)
    found = np.zeros_like(never_tissue)
    for label in range(1, count):
        if np.median(difference[part == label]) < MAX_OVERLAY_LEVELS:
            found |= part == label
    return found


def _ratio(numerator: float, values: Image, chosen: Mask, offset: float = 0.0) -> Image:
    """numerator / values + offset [H, W] where chosen, else 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found: Image = np.float32(numerator) / values
    found += np.float32(offset)
    np.copyto(found, 0, where=~chosen)
    return found


@lru_cache(1)
def _row_numbers(height: int, width: int) -> Image:
    """The row number [H, W] of each pixel."""
    rows = np.repeat(np.arange(height, dtype=np.float32), width).reshape(height, width)
    rows.flags.writeable = False
    return rows


def _moved(disparity: Image, chosen: Mask, values: NDArray[Number]) -> NDArray[Number]:
    """The chosen values [H, W] warped to the right eye, 0 elsewhere; the last of a row wins."""
    height, width = disparity.shape
    columns = np.arange(width, dtype=np.float64)
    moved = np.zeros(height * width, values.dtype)
    for top in range(0, height, ROWS_AT_ONCE):
        rows = slice(top, min(top + ROWS_AT_ONCE, height))
        there = np.rint(columns - disparity[rows]).astype(np.intp)
        inside = chosen[rows] & (there >= 0) & (there < width)
        there += width * np.arange(rows.start, rows.stop)[:, None]
        moved[there[inside]] = values[rows][inside]
    return moved.reshape(height, width)


def nearest_known(values: Image, known: Mask, wanted: Mask | None = None) -> Image:
    """values [H, W] with wanted pixels replaced by the nearest known pixel; unchanged if none is known.

    Args:
        wanted: [H, W]; None: all unknown pixels.
    """
    wanted = ~known if wanted is None else wanted
    if not known.any() or not wanted.any():
        return values
    _, label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.zeros(label.max() + 1, np.float32)
    by_label[label[known]] = values[known]
    found = values.copy()
    found[wanted] = by_label[label[wanted]]
    return found


def _box(side_px: float) -> NDArray[np.uint8]:
    side = 2 * max(round(side_px / 2), 0) + 1
    return np.ones((side, side), np.uint8)
