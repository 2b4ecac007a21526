"""The right eye of a matched clip: the left eye's depth and masks, moved to where the right eye sees them.

Symbols: T frames, H W pixels of one eye; d disparity, x_left - x_right in px. A rectified pair has one depth on both
sides of a match, so the right eye needs no search of its own. What the left eye does not see has no depth here.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

SMOOTHED_PX = 3
"""Side of the median that closes the cracks of a stretched surface and removes what shows through them."""
MAX_STEP_PX = 1.0
"""The left eye's disparities next to a match may differ by this much for their mean to be taken."""
CLOSED_SHARE, GROWN_SHARE = 0.03, 0.014
"""Of the width: gaps of a moved instrument mask that are closed, and how far it grows. Matching blurs its outline."""
MAX_OVERLAY_LEVELS = 8.0
"""Median difference of the eyes, of 255, at equal pixels of what is painted into both, such as a label."""


def moved_depth(
    depth_mm: Image, confidence: NDArray[np.uint8], focal_baseline: float, offset_px: float
) -> tuple[Image, NDArray[np.uint8]]:
    """Depth in mm and confidence [H, W] of the right eye, from those of the left; 0 where the left eye sees nothing.

    The nearest surface wins: of left pixels that meet in one right pixel, the last in the row has the most disparity.
    """
    height, width = depth_mm.shape
    valid = depth_mm > 0
    left_px = np.where(valid, focal_baseline / np.where(valid, depth_mm, 1) + offset_px, 0).astype(np.float32)
    right_px = np.zeros_like(left_px)
    _write_moved(right_px, left_px, valid, left_px)
    right_px = cv2.medianBlur(right_px, SMOOTHED_PX)
    x = np.arange(width, dtype=np.float32) + right_px
    y = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
    known = cv2.remap(valid.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=0)
    between = cv2.remap(left_px, x, y, cv2.INTER_LINEAR, borderValue=0)
    found = right_px > 0
    smooth = found & (known > 0.999) & (np.abs(between - right_px) < MAX_STEP_PX)
    beyond_infinity_px = np.where(smooth, between, right_px) - np.float32(offset_px)
    found &= beyond_infinity_px > 0
    moved_mm = np.where(found, focal_baseline / np.where(found, beyond_infinity_px, 1), 0).astype(np.float32)
    trust = cv2.remap(confidence, x, y, cv2.INTER_NEAREST, borderValue=0)
    return moved_mm, np.where(found, trust, 0).astype(np.uint8)


def moved_tissue(tissue: Mask, depth_mm: Image, focal_baseline: float, offset_px: float) -> Mask:
    """Tissue [H, W] of the right eye: where the left eye's instruments are not.

    An instrument's pixels without depth take that of its nearest pixel with one. One that leaves the left picture on
    the right goes on in the strip that only the right eye sees.
    """
    tool = ~tissue
    if not tool.any():
        return np.ones_like(tissue)
    width = tissue.shape[1]
    found = depth_mm > 0
    disparity = np.where(found, focal_baseline / np.where(found, depth_mm, 1) + offset_px, 0).astype(np.float32)
    disparity = nearest_known(disparity, found & tool)
    moved = np.zeros(tissue.shape, np.uint8)
    _write_moved(moved, disparity, tool, tool.astype(np.uint8))
    for row in np.flatnonzero(tool[:, -2:].any(axis=1)):
        moved[row, max(int(width - 2 - disparity[row, tool[row]].max()), 0) :] = 1
    closed = cv2.morphologyEx(moved, cv2.MORPH_CLOSE, _box(CLOSED_SHARE * width))
    grown: Mask = cv2.dilate(closed, _box(GROWN_SHARE * width)) == 0
    return grown


def painted_over(left: NDArray[np.uint8], right: NDArray[np.uint8], never_tissue: Mask) -> Mask:
    """Which pixels [H, W] that are tissue in no frame show the same in both eyes [H, W, 3]: labels, not instruments."""
    count, part = cv2.connectedComponents(never_tissue.astype(np.uint8))
    difference = cv2.absdiff(left, right).mean(axis=2)
    found = np.zeros_like(never_tissue)
    for label in range(1, count):
        if np.median(difference[part == label]) < MAX_OVERLAY_LEVELS:
            found |= part == label
    return found


def _write_moved(target: NDArray[np.generic], disparity: Image, chosen: Mask, values: NDArray[np.generic]) -> None:
    """Write the chosen values [H, W] to where the right eye sees them; the last of a row wins."""
    rows, columns = np.nonzero(chosen)
    there = np.rint(columns - disparity[rows, columns]).astype(np.intp)
    inside = (there >= 0) & (there < target.shape[1])
    target[rows[inside], there[inside]] = values[rows[inside], columns[inside]]


def nearest_known(values: Image, known: Mask) -> Image:
    """values [H, W], where not known those of the nearest pixel that is; as they are if none is."""
    if not known.any():
        return values
    _, label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.zeros(label.max() + 1, np.float32)
    by_label[label[known]] = values[known]
    return np.where(known, values, by_label[label])


def _box(side_px: float) -> NDArray[np.uint8]:
    side = 2 * max(round(side_px / 2), 0) + 1
    return np.ones((side, side), np.uint8)
