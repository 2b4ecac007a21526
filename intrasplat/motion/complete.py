"""Completion of missing depth and colour: a smooth membrane between the surroundings.

Symbols: H W pixels. Lengths in mm.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

RELAXATIONS = 12
"""Jacobi sweeps per pyramid level. Few suffice, because the coarser level has solved the low frequencies."""


def complete_depth(
    depth_mm: NDArray[np.float32], valid: NDArray[np.bool_], tissue: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Depth [H, W] on all tissue: measured where valid, elsewhere a membrane between its surroundings; 0 off tissue.

    The membrane is the harmonic function (zero Laplacian) of inverse depth, which is linear over the image for a plane.
    The result is zero if no depth on tissue is valid.
    """
    known = valid & tissue & (depth_mm > 0)
    if not known.any():
        return np.zeros_like(depth_mm)
    inverse = np.divide(1.0, depth_mm, out=np.zeros_like(depth_mm), where=known)
    completed = 1.0 / _membrane(inverse, known)
    return np.where(known, depth_mm, np.where(tissue, completed, 0)).astype(np.float32)


def complete_colour(rgb: NDArray[np.uint8], tissue: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Colour [H, W, 3] in [0, 1]: the picture's on tissue, which must not be empty; elsewhere a membrane."""
    planes = [_membrane(plane, tissue) for plane in cv2.split(rgb / np.float32(255))]
    return np.stack(planes, axis=-1)


def _membrane(value: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Harmonic function through the known values, from coarse to fine (cascadic multigrid)."""
    height, width = value.shape
    if known.all():
        return value
    if min(height, width) < 4:
        return np.where(known, value, value[known].mean()).astype(np.float32)
    half = ((width + 1) // 2, (height + 1) // 2)
    weight = cv2.resize(known.astype(np.float32), half, interpolation=cv2.INTER_AREA)
    summed = cv2.resize(np.where(known, value, np.float32(0)), half, interpolation=cv2.INTER_AREA)
    coarse = _membrane(np.divide(summed, weight, out=np.zeros_like(summed), where=weight > 0), weight > 0)
    guess = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32) / 4
    for _ in range(RELAXATIONS):
        np.copyto(guess, value, where=known)
        guess = np.asarray(cv2.filter2D(guess, -1, cross, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)
    np.copyto(guess, value, where=known)
    return guess
