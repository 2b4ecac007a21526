"""The tissue's paint: colour and wetness over the atlas.

Tissue scatters light and blood absorbs it: scatter * exp(-blood * ABSORPTION) (Beer-Lambert). So more blood turns pale
pink into red and dark red, as in the body. All colours are linear light, not sRGB.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.phantom.fields import Image32, fine_field, smooth_field, smoothstep
from lab.phantom.surface import Surface
from lab.phantom.vessels import draw_vessels

SCATTER = np.array([0.86, 0.66, 0.62], dtype=np.float32)  # bloodless mucosa
FAT_SCATTER = np.array([0.90, 0.60, 0.36], dtype=np.float32)
DEEP_SCATTER = np.array([0.70, 0.50, 0.46], dtype=np.float32)  # muscle under the serosa
ABSORPTION = np.array([0.40, 1.20, 1.02], dtype=np.float32)  # by oxygenated blood
VEIN_ABSORPTION = np.array([0.85, 1.15, 0.72], dtype=np.float32)  # by blood in veins: towards blue

BLOOD_OCTAVES = ((48.0, 0.16), (17.0, 0.15), (6.0, 0.10), (2.2, 0.09), (0.9, 0.08))  # (wavelength mm, deviation)
FINE_DEVIATION = 0.14  # of blood, from texel to texel
CREASE_MM = 7.0  # places deeper than their surroundings of this size get less light
CREASE_DIMMING_PER_MM = 0.2
ARTERY_BLOOD, VEIN_BLOOD, CAPILLARY_BLOOD = 1.0, 0.85, 0.38
CAPILLARIES_MM = ((6.5, 0.055), (3.2, 0.07))  # (mesh size, line width as share of the field's deviation)

FILM_OCTAVES = ((7.0, 0.10), (2.6, 0.15), (1.1, 0.16))  # (wavelength mm, deviation of slope) of the wet film
FILM_FINE_SLOPE = 0.10
WET_MM = 11.0  # patches of more and of less wetness


@dataclass(frozen=True)
class Paint:
    """Over the atlas, in texels.

    albedo [rows, columns, 3] float32, linear light
    film   [rows, columns, 3] float32: slope right, slope down (mm/mm) of the wet film; wetness in [0, 1]
    """

    albedo: Image32
    film: Image32


def paint_tissue(surface: Surface, rng: np.random.Generator) -> Paint:
    """The paint of the sheet and, if it will be cut, of the tissue beneath."""
    atlas = surface.atlas
    albedo = np.zeros((*atlas.shape, 3), dtype=np.float32)
    film = np.zeros((*atlas.shape, 3), dtype=np.float32)
    sheet_rng, groove_rng = rng.spawn(2)
    half_u, half_v = surface.half_extent_mm
    rows, columns = atlas.sheet_shape
    albedo[:rows, :columns] = _paint_sheet(surface, (2 * half_v, 2 * half_u), sheet_rng)
    film[:rows, :columns] = _wet_film((2 * half_v, 2 * half_u), atlas.sheet_shape, sheet_rng)
    if atlas.groove_shape[0]:
        groove = slice(atlas.groove_row, None), slice(0, atlas.groove_shape[1])
        extent = atlas.groove_shape[0] * atlas.texel_mm, atlas.groove_shape[1] * atlas.texel_mm
        albedo[groove] = _paint_groove(extent, atlas.groove_shape, groove_rng)
        film[groove] = _wet_film(extent, atlas.groove_shape, groove_rng)
    return Paint(albedo, film)


def _paint_sheet(surface: Surface, extent: tuple[float, float], rng: np.random.Generator) -> Image32:
    shape, texel_mm = surface.atlas.sheet_shape, surface.atlas.texel_mm
    depth = cv2.resize(surface.rest_z_mm, shape[::-1], interpolation=cv2.INTER_CUBIC)
    hollow_mm = np.maximum(depth - _blurred(depth, CREASE_MM / texel_mm), 0)
    blood = _blood(rng, extent, shape)
    fat = smoothstep(smooth_field(rng, extent, 15.0, shape) + 0.12 * hollow_mm, 1.5, 2.4)
    fat *= np.clip(1 + 0.25 * smooth_field(rng, extent, 1.6, shape), 0, 1)
    for wavelength, width in CAPILLARIES_MM:
        lines = np.exp(-((smooth_field(rng, extent, wavelength, shape) / width) ** 2))
        blood += CAPILLARY_BLOOD * lines * np.clip(0.6 + 0.5 * smooth_field(rng, extent, 14.0, shape), 0, 1)
    arteries, veins = draw_vessels(rng, extent, texel_mm, shape)
    blood = blood * (1 - 0.7 * fat) + ARTERY_BLOOD * arteries
    scatter = SCATTER + fat[..., None] * (FAT_SCATTER - SCATTER)
    dimming = np.exp(-CREASE_DIMMING_PER_MM * hollow_mm)[..., None]
    absorbed = np.exp(-blood[..., None] * ABSORPTION - (VEIN_BLOOD * veins)[..., None] * VEIN_ABSORPTION)
    return np.asarray(scatter * absorbed * dimming, dtype=np.float32)


def _paint_groove(extent: tuple[float, float], shape: tuple[int, int], rng: np.random.Generator) -> Image32:
    """Darker muscle with fibres along the cut, beads of fat on the floor, bleeding edges."""
    fibres = smooth_field(rng, (extent[0] / 8, extent[1]), 0.9, shape)
    blood = 1.75 * _blood(rng, extent, shape) * np.exp(0.25 * fibres)
    across = np.abs(np.linspace(-1, 1, shape[1], dtype=np.float32))[None, :]
    fat = smoothstep(smooth_field(rng, extent, 2.4, shape), 0.9, 1.5) * (1 - smoothstep(across, 0.35, 0.6))
    blood = blood * (1 - 0.65 * fat) + 1.2 * smoothstep(across, 0.8, 1.0)
    scatter = DEEP_SCATTER + fat[..., None] * (FAT_SCATTER - DEEP_SCATTER)
    return np.asarray(scatter * np.exp(-blood[..., None] * ABSORPTION), dtype=np.float32)


def _blood(rng: np.random.Generator, extent: tuple[float, float], shape: tuple[int, int]) -> Image32:
    """Blood in the capillary bed, about 1; detail down to the texel."""
    log_blood = np.zeros(shape, dtype=np.float32)
    for wavelength, deviation in BLOOD_OCTAVES:
        log_blood += deviation * smooth_field(rng, extent, wavelength, shape)
    log_blood += FINE_DEVIATION * fine_field(rng, shape, 0.9)
    return np.exp(log_blood)


def _wet_film(extent: tuple[float, float], shape: tuple[int, int], rng: np.random.Generator) -> Image32:
    slopes = np.zeros((*shape, 2), dtype=np.float32)
    for wavelength, deviation in FILM_OCTAVES:
        slopes += _slopes(smooth_field(rng, extent, wavelength, shape), deviation)
    slopes += _slopes(fine_field(rng, shape, 1.2), FILM_FINE_SLOPE)
    wet = smoothstep(smooth_field(rng, extent, WET_MM, shape), -1.2, 1.4)
    return np.concatenate([slopes, wet[..., None]], axis=-1)


def _slopes(height: Image32, deviation: float) -> Image32:
    """(right, down) derivatives of a field, scaled to a deviation."""
    down, right = np.gradient(height)
    both = np.stack([right, down], axis=-1)
    return np.asarray(both * np.float32(deviation / max(float(both.std()), 1e-9)), dtype=np.float32)


def _blurred(image: NDArray[np.float32], sigma: float) -> Image32:
    """Gaussian blur with a sigma of many pixels, computed on a smaller picture; exact enough for dimming."""
    shrink = max(1, int(sigma / 4))
    small = cv2.resize(image, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma / shrink, borderType=cv2.BORDER_REFLECT)
    return np.asarray(cv2.resize(small, image.shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32)
