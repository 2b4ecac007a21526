"""Degraded pictures: highlights, blood, blur, borders, lost colour.

Symbols: T frames, H W pixels.

Each function degrades a clean clip by `level`; `random` is seeded by the cell. Lengths in pixels refer to a picture 640
wide. Depth stays true: effects on stereo are not measured here.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.conditions.clean import CleanClip, Given, given, to_bytes

HIGHLIGHT_PX, HIGHLIGHT_STEP_PX = 10.0, 8.0  # radius, and standard deviation of the step per frame
BLOOD = (104.0, 14.0, 12.0)
BLOOD_OPACITY, BLOOD_FROM = 0.92, 0.25  # blood appears after this share of the clip
BLURRED_SHARE = 0.5  # share of blurred frames


def highlights(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """`level` white spots, 10 px in radius, wander over the tissue by about 8 px per frame."""
    height, width = clean.clip.tissue.shape[1:]
    places = random.uniform(0, 1, (round(level), 2)) * (width, height)
    rgb = clean.clip.rgb.copy()
    for picture in rgb:
        for x, y in places:
            cv2.circle(picture, (int(x), int(y)), max(1, round(HIGHLIGHT_PX * clean.px)), (255, 255, 255), -1)
        places = (places + random.normal(0, HIGHLIGHT_STEP_PX * clean.px, places.shape)) % (width, height)
    return given(clean, dataclasses.replace(clean.clip, rgb=rgb))


def blood(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Blood rises from below and in the end covers `level` of the picture. Scored against the covered tissue."""
    frames, height, width = clean.clip.tissue.shape
    wave = cv2.GaussianBlur(random.standard_normal((1, width)), (0, 0), width / 12)[0]
    wave *= 0.05 * height / max(float(wave.std()), 1e-9)
    rise = level * height * np.clip((np.arange(frames) / frames - BLOOD_FROM) / (1 - BLOOD_FROM), 0, 1)
    depth = np.arange(height)[None, :, None] - (height - rise[:, None, None] + wave * (rise > 0)[:, None, None])
    opacity = (BLOOD_OPACITY * np.clip(depth + 0.5, 0, 1))[..., None]
    tissue = clean.clip.tissue[..., None]
    flooded = np.where(tissue, (1 - opacity) * clean.clip.rgb + opacity * np.array(BLOOD), clean.clip.rgb)
    truth = (1 - opacity) * clean.rgb + opacity * np.array(BLOOD) / 255
    return given(clean, dataclasses.replace(clean.clip, rgb=to_bytes(flooded)), rgb=truth.astype(np.float32))


def motion_blur(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Half of the frames, drawn at random, are blurred over `level` px, each in its own direction."""
    rgb = clean.clip.rgb.copy()
    for index in random.permutation(len(rgb))[: round(BLURRED_SHARE * len(rgb))]:
        rgb[index] = cv2.filter2D(rgb[index], -1, _line(level * clean.px, random.uniform(0, np.pi)))
    return given(clean, dataclasses.replace(clean.clip, rgb=rgb))


def defocus(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """All frames are out of focus: blurred by a Gaussian of `level` px."""
    del random
    rgb = np.stack([cv2.GaussianBlur(picture, (0, 0), level * clean.px) for picture in clean.clip.rgb])
    return given(clean, dataclasses.replace(clean.clip, rgb=rgb))


def black_border(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """`level` of the picture, outside a circle, is black, without depth, and not masked. Scored inside."""
    del random
    height, width = clean.clip.tissue.shape[1:]
    rows, columns = np.indices((height, width))
    away = np.hypot(rows + 0.5 - height / 2, columns + 0.5 - width / 2)
    border = away > np.quantile(away, 1 - level)
    spoilt = dataclasses.replace(
        clean.clip,
        rgb=np.where(border[..., None], np.uint8(0), clean.clip.rgb),
        depth_mm=np.where(border, np.float32(0), clean.clip.depth_mm),
        depth_confidence=np.where(border, np.uint8(0), clean.clip.depth_confidence),
        tissue=clean.clip.tissue | border,
    )
    return given(clean, spoilt, scored=clean.seen & ~border)


def grey_scale(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Colour is reduced by `level`: 1 is grey. Scored against the tissue with the same reduction."""
    del random
    grey = clean.rgb.mean(axis=-1, keepdims=True)
    recorded = clean.clip.rgb.mean(axis=-1, keepdims=True)
    truth = (1 - level) * clean.rgb + level * grey
    rgb = to_bytes((1 - level) * clean.clip.rgb + level * recorded)
    return given(clean, dataclasses.replace(clean.clip, rgb=rgb), rgb=truth.astype(np.float32))


def _line(length_px: float, angle: float) -> NDArray[np.float32]:
    """A kernel of linear motion blur; sums to 1."""
    half = int(np.ceil(length_px / 2)) + 1
    offset = np.arange(-half, half + 1)
    kernel = np.zeros((offset.size, offset.size))
    for along in np.linspace(-length_px / 2, length_px / 2, 8 * half + 1):  # each point shared by its four neighbours
        row, column = (np.maximum(0, 1 - np.abs(offset - along * way)) for way in (np.sin(angle), np.cos(angle)))
        kernel += np.outer(row, column)
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
