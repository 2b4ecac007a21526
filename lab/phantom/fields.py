"""Seeded random fields over a rectangle in millimetres, for shape, colour and wetness.

A field's lattice follows its wavelength, not the picture's size. So a larger picture of the same seed shows the same
tissue with finer detail.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image32 = NDArray[np.float32]

_LATTICE_PER_WAVELENGTH = 4.0  # samples of white noise in one wavelength
_BLUR_LATTICE = 1.3  # Gaussian sigma in lattice steps: isotropic, no visible lattice


def smooth_field(
    rng: np.random.Generator, extent_mm: tuple[float, float], wavelength_mm: float, shape: tuple[int, int]
) -> Image32:
    """A Gaussian random field [rows, columns], mean 0, deviation 1, with bumps about wavelength_mm across.

    Args:
        extent_mm: (height, width) of the rectangle that shape covers.
    """
    pitch = wavelength_mm / _LATTICE_PER_WAVELENGTH
    rows, columns = (max(4, int(np.ceil(side / pitch))) for side in extent_mm)
    lattice = rng.standard_normal((rows, columns), dtype=np.float32)
    lattice = cv2.GaussianBlur(lattice, (0, 0), _BLUR_LATTICE, borderType=cv2.BORDER_REFLECT)
    lattice = (lattice - lattice.mean()) / lattice.std()
    shrinks = rows > shape[0]
    return _resized(lattice, shape, cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def fine_field(rng: np.random.Generator, shape: tuple[int, int], blur_texels: float) -> Image32:
    """White noise, blurred by blur_texels, deviation 1: the fine detail that stereo matching needs."""
    own_rng = rng.spawn(1)[0]  # the number of draws depends on shape; the next draws from rng must not
    field = cv2.GaussianBlur(own_rng.standard_normal(shape, dtype=np.float32), (0, 0), blur_texels)
    return np.asarray(field / field.std(), dtype=np.float32)


def lobed(field: Image32, crease: float) -> Image32:
    """Rounded lobes between narrow creases: |field|, rounded by crease where the field crosses 0."""
    return np.asarray(np.sqrt(field * field + np.float32(crease * crease)) - crease, dtype=np.float32)


def smoothstep(x: Image32 | NDArray[np.float64], low: float, high: float) -> Image32:
    """0 below low, 1 above high, a cubic in between."""
    unit = np.clip((x.astype(np.float32) - low) / (high - low), 0.0, 1.0)
    return np.asarray(unit * unit * (3.0 - 2.0 * unit), dtype=np.float32)


def _resized(field: Image32, shape: tuple[int, int], interpolation: int) -> Image32:
    return np.asarray(cv2.resize(field, (shape[1], shape[0]), interpolation=interpolation), dtype=np.float32)
