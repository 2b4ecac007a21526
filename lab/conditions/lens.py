"""Drops on the lens: fixed in the picture, whatever the scene does. Symbols: T frames, H W pixels.

Lengths in pixels refer to a picture 640 wide.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import DepthClip
from intrasplat.motion.recoloured import EyeOrClip
from lab.conditions.clean import REFERENCE_WIDTH, CleanClip, Given, given, to_bytes
from lab.conditions.recording import recording_of
from lab.phantom import PhantomFrame

BLOOD, BLOOD_OPACITY, BLOOD_FROM = (88.0, 12.0, 10.0), 0.9, 0.25  # colour, opacity, and share of the clip before it
WATER_BLUR_PX, WATER_GLOW, WATER_FROM = 14.0, 0.15, 0.5  # water scatters what lies behind it, and some of the lamp
EDGE_PX = 6.0  # a drop is out of focus
RAGGED, RAGGED_PX = 0.2, 30.0  # deviation of the outline from a circle, as a share of its radius; and its smoothness


@dataclass(frozen=True, eq=False)
class Drops:
    """A drop of blood and one of water on the lens of an eye.

    blood, water  [H, W, 1] float32, share of each pixel's light that comes through it
    """

    blood: NDArray[np.float32]
    water: NDArray[np.float32]
    px: float

    def over(self, rgb: NDArray[np.uint8], done: float) -> NDArray[np.uint8]:
        """The picture [H, W, 3] when the share `done` of the clip has passed: blood appears first, then water."""
        seen = rgb.astype(np.float32)
        if done >= WATER_FROM:
            behind = cv2.GaussianBlur(seen, (0, 0), WATER_BLUR_PX * self.px)
            seen += self.water * ((1 - WATER_GLOW) * behind + WATER_GLOW * np.float32(255) - seen)
        if done >= BLOOD_FROM:
            seen += self.blood * BLOOD_OPACITY * (np.array(BLOOD, np.float32) - seen)
        return to_bytes(seen)


def drops_over(height: int, width: int, level: float, px: float, random: np.random.Generator) -> Drops:
    """Drops that cover `level` of a picture, together."""
    places = random.uniform(0.2, 0.8, (2, 2)) * (height, width)
    wave = cv2.GaussianBlur(random.standard_normal((height, width)), (0, 0), RAGGED_PX * px)
    rows, columns = np.indices((height, width))
    away = np.stack([np.hypot(rows - row, columns - column) for row, column in places])
    away *= np.exp(RAGGED * wave / wave.std())
    inside = away.min(axis=0) <= np.quantile(away.min(axis=0), level)
    blood, water = (
        cv2.GaussianBlur((inside & (away.argmin(axis=0) == drop)).astype(np.float32), (0, 0), EDGE_PX * px)
        for drop in (0, 1)
    )
    return Drops(blood[..., None], water[..., None], px)


def splash(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Drops cover `level` of the picture in the end; masks do not show them. Scored also behind them."""
    return given(clean, with_splash(clean.clip, level, random))


def with_splash(clip: DepthClip, level: float, random: np.random.Generator) -> DepthClip:
    """The clip with drops of its own before each eye, which cover `level` of its picture in the end."""
    right = clip.right and _splashed(clip.right, level, random)
    return dataclasses.replace(_splashed(clip, level, random), right=right)


def _splashed(eye: EyeOrClip, level: float, random: np.random.Generator) -> EyeOrClip:
    frames, height, width = eye.tissue.shape
    drops = drops_over(height, width, level, width / REFERENCE_WIDTH, random)
    rgb = np.stack([drops.over(picture, index / frames) for index, picture in enumerate(eye.rgb)])
    return dataclasses.replace(eye, rgb=rgb)


def splash_stereo(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files of the same; each lens has drops of its own."""
    frames, height, width = clean.clip.tissue.shape
    left, right = (drops_over(height, width, level, clean.px, random) for _ in range(2))

    def spoil(frame: PhantomFrame, index: int) -> PhantomFrame:
        done = index / frames
        return dataclasses.replace(frame, left=left.over(frame.left, done), right=right.over(frame.right, done))

    return given(clean, recording_of(clean.phantom, spoil))
