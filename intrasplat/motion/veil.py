"""Smoke, steam or mist between the endoscope and the tissue: the frames behind it, and a picture seen through it.

A veil takes a share of the tissue's light and adds its own: recorded = m clear + (1 - m) airlight, where m, the
transmission, is exp(-thickness depth / reference depth) (Koschmieder's law, in recorded values).

Symbols: T frames, H W pixels, h w nodes of a coarse grid over the picture.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, Eye
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.motion.complete import complete_depth
from intrasplat.motion.recoloured import EyeOrClip, recoloured
from intrasplat.notices import Notice, NoticeCode

Floats = NDArray[np.float32]

MIN_TRANSMISSION = 0.2
"""Tissue of which less light arrives is unseen: at 8 bits its colour would be noise."""
MAX_TAKEN, MAX_THICK_SHARE = 0.5, 0.1
"""Share of the light, and of the frames in which smoke takes more, from which on a warning says so."""
STEP, LEVELS = np.float32(1 / 64), 255
"""The stored thickness is a whole number of steps, up to this many: 4, of which two percent of the light are left."""
MAX_NODES = 1 << 26
"""Of a stored veil: half an hour at 30 frames a second on the usual grid."""
DEPTH_STEP_PX = 8
"""Missing depth is completed on a grid of every eighth pixel."""


@dataclass(frozen=True, eq=False)
class Veil:
    """The veil before one eye.

    thickness  [T, h, w] at reference depth; node (i, j) lies in the middle of its cell of the picture
    airlight   [3] R G B in [0, 1]: the colour of a veil that hides everything
    depth_mm   reference depth
    """

    thickness: Floats
    airlight: Floats
    depth_mm: float

    def at(self, frame: float) -> Floats:
        """[h, w] thickness at a time in frames."""
        before = min(max(int(frame), 0), len(self.thickness) - 1)
        after, share = min(before + 1, len(self.thickness) - 1), np.float32(max(frame - before, 0))
        return np.asarray((1 - share) * self.thickness[before] + share * self.thickness[after], np.float32)

    def arriving(self, thickness: Floats, depth_mm: Floats) -> Floats:
        """[H, W] share of the light of tissue at these depths, mm, that arrives through this thickness."""
        return np.asarray(np.exp(-thickness * (depth_mm / np.float32(self.depth_mm))), np.float32)

    def transmission(self, frame: float, depth_mm: Floats) -> Floats:
        """[H, W] share of the light that arrives at the eye itself, from depths [H, W] in mm, at a time in frames."""
        fine = cv2.resize(self.at(frame), depth_mm.shape[::-1], interpolation=cv2.INTER_LINEAR)
        return self.arriving(np.asarray(fine, np.float32), depth_mm)

    def drawn_over(self, rgb: Floats, transmission: Floats) -> Floats:
        """A clear picture [H, W, 3] in [0, 1] as seen through the veil."""
        share = transmission[..., None]
        return np.asarray(share * rgb + (1 - share) * self.airlight, np.float32)

    def share_taken(self) -> NDArray[np.float64]:
        """[T] mean share of the light that the veil takes at reference depth, in every frame."""
        return np.asarray(1 - np.exp(-self.thickness.astype(np.float64)).mean(axis=(1, 2)))

    def rounded(self) -> Veil:
        """The veil as it is stored."""
        return replace(self, thickness=self._steps() * STEP)

    def _steps(self) -> NDArray[np.uint8]:
        return np.asarray(np.clip(np.rint(self.thickness / STEP), 0, LEVELS), np.uint8)

    def stored(self) -> dict[str, Any]:
        """The veil as JSON; thickness is rounded to whole steps."""
        steps = self._steps()
        return {
            "airlight": [float(each) for each in self.airlight],
            "depth_mm": self.depth_mm,
            "shape": list(steps.shape),
            "thickness": base64.b64encode(zlib.compress(steps.tobytes())).decode("ascii"),
        }

    @classmethod
    def read(cls, stored: Mapping[str, Any], frames: int) -> Veil:
        """The veil of a clip of T = frames that stored() wrote.

        Raises:
            ValueError: the values are not those of a veil, or of another number of frames.
        """
        try:
            shape = tuple(int(each) for each in stored["shape"])
            airlight, depth_mm = np.array(stored["airlight"], np.float32), float(stored["depth_mm"])
            content = base64.b64decode(stored["thickness"], validate=True)
        except (KeyError, TypeError) as error:
            raise ValueError(f"the veil lacks a value or has another type: {error}") from error
        if len(shape) != 3 or shape[0] != frames or min(shape) < 1 or math.prod(shape) > MAX_NODES:
            raise ValueError(f"the veil has shape {shape}, not {frames} x h x w")
        if airlight.shape != (3,) or not ((airlight >= 0) & (airlight <= 1)).all() or not 0 < depth_mm < np.inf:
            raise ValueError("the veil's airlight or depth is out of range")
        count, unpacker = math.prod(shape), zlib.decompressobj()
        try:
            steps = unpacker.decompress(content, count + 1)
        except zlib.error as error:
            raise ValueError(f"the veil's thickness cannot be unpacked: {error}") from error
        if len(steps) != count:
            raise ValueError(f"the veil's thickness has not {count} numbers")
        return cls(np.frombuffer(steps, np.uint8).reshape(shape) * STEP, airlight, depth_mm)


def notice_of(veil: Veil) -> Notice:
    """The report's sentence on the veil before the left eye."""
    taken = veil.share_taken()
    text = (
        f"smoke: a veil takes {taken.mean():.0%} of the light on average and {taken.max():.0%} at most, in frame "
        f"{int(taken.argmax())}; it is removed from training and from renders (smoke=show draws it)"
    )
    return Notice.info(NoticeCode.SMOKE, text)


def warnings_of(veil: Veil) -> tuple[Notice, ...]:
    """A warning if much of the tissue's light is lost."""
    thick = np.flatnonzero(veil.share_taken() > MAX_TAKEN)
    if len(thick) < MAX_THICK_SHARE * len(veil.thickness):
        return ()
    text = (
        f"In {len(thick)} of {len(veil.thickness)} frames, between {thick[0]} and {thick[-1]}, smoke takes more than "
        f"{MAX_TAKEN:.0%} of the light: what is left behind it is noisy, and its colours are less right. Take a part "
        "of the clip with less smoke."
    )
    return (Notice.warning(NoticeCode.VEILED, text),)


def without_veils(clip: DepthClip, veils: Sequence[Veil]) -> DepthClip:
    """The clip without its veils, the left eye's first. What they hide, MIN_TRANSMISSION, is no tissue any more."""
    right = clip.right if clip.right is None or len(veils) < 2 else _without_veil(clip.right, veils[1])
    return replace(_without_veil(clip, veils[0]), right=right)


def whole_depth_mm(eye: Eye, index: int) -> Floats:
    """[H, W] depth of a frame, mm; where it is not measured, a surface between its surroundings."""
    step, (height, width) = DEPTH_STEP_PX, eye.tissue.shape[1:]
    coarse = eye.depth_mm[index][step // 2 :: step, step // 2 :: step]
    usable = eye.tissue[index][step // 2 :: step, step // 2 :: step] & (coarse > 0)
    filled = complete_depth(coarse, usable, np.ones_like(usable))
    return np.asarray(cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _without_veil(eye: EyeOrClip, veil: Veil) -> EyeOrClip:
    tissue, airlight = mapped_zeros(eye.tissue.shape, np.bool_), veil.airlight * np.float32(255)

    def picture(index: int) -> NDArray[np.uint8]:
        share = veil.transmission(index, whole_depth_mm(eye, index))
        arrives = 1 / np.maximum(share, np.float32(MIN_TRANSMISSION))[..., None]
        tissue[index] = eye.tissue[index] & (share >= MIN_TRANSMISSION)
        let_go(tissue[index])
        clear = (eye.rgb[index] - airlight) * arrives + airlight + np.float32(0.5)
        return np.asarray(np.clip(clear, 0, 255).astype(np.uint8))

    return replace(recoloured(eye, picture), tissue=tissue)
