"""SIFT features of pictures, and matches between two pictures. Symbols: N features, M matches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

FEATURE_WIDTH = 400  # px; pictures are reduced to it: the eyes' shift is as accurate, in a third of the time
FEATURES = 1500
RATIO = 0.8  # Lowe's ratio test
BIAS_PX = 0.25
"""OpenCV's SIFT places features so much too far right and down, because it doubles the picture by its outer edges."""


@dataclass(frozen=True, eq=False)
class Features:
    """SIFT features of a picture: points [N, 2] x, y in its pixels, descriptors [N, 128] float32."""

    points: NDArray[np.float64]
    descriptors: NDArray[np.float32]


def find_features(
    grey: NDArray[np.uint8],
    max_width_px: int = FEATURE_WIDTH,
    where: NDArray[np.bool_] | None = None,
    min_contrast: float = 0.04,
) -> Features:
    """Features of a picture [H, W], which is reduced to max_width_px if it is wider.

    Args:
        where: [H, W], the pixels in which features are wanted; None: all.
        min_contrast: of a feature, as SIFT defines it.
    """
    height, width = grey.shape
    scale = min(1.0, max_width_px / width)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    mask = None
    if where is not None:
        mask = cv2.resize(where.astype(np.uint8), grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    sift = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=min_contrast)
    points, descriptors = sift.detectAndCompute(grey, mask)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    places = np.array([point.pt for point in points], np.float64)
    pixels = (places - BIAS_PX + 0.5) * (np.array([width, height]) / grey.shape[::-1]) - 0.5
    return Features(pixels, descriptors)


def matched(one: Features, other: Features, *, mutual: bool = False) -> NDArray[np.intp]:
    """Matches [M, 2], indices of the features in one and other, that pass the ratio test.

    mutual: each feature is also the best match of its best match.
    """
    if not len(one.points) or len(other.points) < 2:
        return np.zeros((0, 2), np.intp)
    lengths = [np.square(each.descriptors).sum(1) for each in (one, other)]
    apart = lengths[0][:, None] + lengths[1] - 2 * one.descriptors @ other.descriptors.T  # squared distances
    rows, best = np.arange(len(apart)), apart.argmin(1)
    second = np.partition(apart, 1, axis=1)[:, 1]
    good = apart[rows, best] < RATIO**2 * second
    if mutual:
        good &= apart.argmin(0)[best] == rows
    pairs: NDArray[np.intp] = np.stack([rows, best], axis=1)[good]
    return pairs
