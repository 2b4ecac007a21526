"""Illumination of wet tissue and metal. All light is linear until to_srgb. Symbols: P points.

The lamp sits in the endoscope: surfaces that face it are bright. Its light falls off with the squared distance and
towards the rim of its beam, which looks like gentle vignetting. Wet places that mirror the lamp to the eye glint. For a
free viewpoint the lamp stays in the endoscope: only glints depend on the viewer.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.machine.cache import kernel

Image32 = NDArray[np.float32]

REFERENCE_MM = 80.0  # tissue at this distance is lit with strength 1
EXPOSURE = 1.55
AMBIENT = 0.07  # light that the walls of the cavity scatter back
BEAM_POWER = 3.0  # the beam falls off with the cosine to this power
LAMP_IN_EYES_MM = (0.0, -3.5, 0.0)  # from the middle between the eyes

GLINT, GLINT_POWER = 3.2, 240.0  # the lamp mirrored in the film
MIN_GLINT_COSINE = 0.15  # of the angle between normal and lamp, below which nothing glints

TISSUE_WRAP = (0.40, 0.22, 0.20)  # light bleeds round edges inside tissue, red the farthest

NOISE_FLOOR, NOISE_GAIN = 0.003, 0.00004  # deviation of sRGB in the dark; variance per unit of brightness


@dataclass(frozen=True)
class Lamp:
    """place_mm [3], axis [3] (unit) in the world; strength of its light times the camera's exposure, usually 1."""

    place_mm: NDArray[np.float64]
    axis: NDArray[np.float64]
    strength: float = 1.0


@dataclass(frozen=True)
class Finish:
    """How a kind of surface reflects light.

    matte  share of the albedo that scatters to all sides
    wrap   [3] how far light bleeds round edges
    sheen, tint, power  add (sheen + tint * albedo) * cos^power about the mirror direction
    """

    matte: float
    wrap: NDArray[np.float64]
    sheen: float
    tint: float
    power: float


def tissue_finish() -> Finish:
    return Finish(1.0, np.array(TISSUE_WRAP), sheen=0.09, tint=0.0, power=14.0)


def metal_finish() -> Finish:
    return Finish(0.22, np.zeros(3), sheen=0.02, tint=1.3, power=11.0)


def endoscope_lamp(world_from_camera: NDArray[np.float64], baseline_mm: float) -> Lamp:
    """The lamp of an endoscope whose left eye is at world_from_camera [4, 4]."""
    offset = np.array([baseline_mm / 2, 0.0, 0.0]) + LAMP_IN_EYES_MM
    rotation, centre = world_from_camera[:3, :3], world_from_camera[:3, 3]
    return Lamp(rotation @ offset + centre, rotation[:, 2])


def shade(
    points_mm: Image32,
    normals: Image32,
    albedo: Image32,
    glint: Image32,
    finish: Finish,
    lamp: Lamp,
    eye_mm: NDArray[np.float64],
) -> Image32:
    """Linear light [P, 3] that points send to an eye.

    Args:
        points_mm: [P, 3] world.
        normals: [P, 3] of any length, towards the viewer.
        albedo: [P, 3] linear.
        glint: [P] strength of mirrored light, 0 = dull.
        eye_mm: [3] world.
    """
    light = np.empty_like(points_mm)
    lobe = np.array([finish.matte, finish.sheen, finish.tint, finish.power])
    exposure = EXPOSURE * lamp.strength
    _shade_points(
        points_mm, normals, albedo, glint, lobe, finish.wrap, lamp.place_mm, lamp.axis, exposure, eye_mm, light
    )
    return light


@kernel(error_model="numpy")  # type: ignore[untyped-decorator]
def _shade_points(
    points_mm: Image32,
    normals: Image32,
    albedo: Image32,
    glint: Image32,
    lobe: NDArray[np.float64],
    wrap: NDArray[np.float64],
    lamp_mm: NDArray[np.float64],
    axis: NDArray[np.float64],
    exposure: float,
    eye_mm: NDArray[np.float64],
    light: Image32,
) -> None:
    matte, sheen, tint, power = lobe
    for p in range(points_mm.shape[0]):
        x, y, z = points_mm[p]
        nx, ny, nz = normals[p]
        lx, ly, lz = lamp_mm[0] - x, lamp_mm[1] - y, lamp_mm[2] - z
        ex, ey, ez = eye_mm[0] - x, eye_mm[1] - y, eye_mm[2] - z
        distance, from_eye = np.sqrt(lx * lx + ly * ly + lz * lz), np.sqrt(ex * ex + ey * ey + ez * ez)
        lx, ly, lz = lx / distance, ly / distance, lz / distance
        hx, hy, hz = lx + ex / from_eye, ly + ey / from_eye, lz + ez / from_eye
        normal_length = np.sqrt(nx * nx + ny * ny + nz * nz)
        facing = (nx * lx + ny * ly + nz * lz) / normal_length
        # cosine to the direction half-way between lamp and eye: 1 where the surface mirrors one into the other
        half = (nx * hx + ny * hy + nz * hz) / (normal_length * np.sqrt(hx * hx + hy * hy + hz * hz))
        half = max(half, 0.0)
        shine = half**power
        gloss = 0.0
        if facing > MIN_GLINT_COSINE:
            gloss = glint[p] * (GLINT * half**GLINT_POWER + sheen * shine)
        beam = max(-(lx * axis[0] + ly * axis[1] + lz * axis[2]), 0.0) ** BEAM_POWER
        strength = exposure * beam * (REFERENCE_MM / distance) ** 2
        for c in range(3):
            diffuse = max((facing + wrap[c]) / (1.0 + wrap[c]), 0.0)
            light[p, c] = strength * (albedo[p, c] * (matte * (AMBIENT + diffuse) + tint * shine) + gloss)


def to_srgb(linear: Image32) -> Image32:
    """sRGB in [0, 1] of linear light [..., 3]; a soft shoulder keeps the detail of glints."""
    rolled = linear * (1 + linear / 9) / (1 + linear * 0.45)
    return np.asarray(cv2.pow(np.clip(rolled, 0, 1), 1 / 2.2), dtype=np.float32)


def add_noise(rgb: Image32, rng: np.random.Generator) -> Image32:
    """Sensor noise: a floor, and shot noise that grows with brightness."""
    deviation = np.sqrt(NOISE_FLOOR**2 + NOISE_GAIN * rgb)
    return np.asarray(rgb + deviation * rng.standard_normal(rgb.shape, dtype=np.float32), dtype=np.float32)
