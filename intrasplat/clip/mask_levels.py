"""Finds which grey levels masks use, for masks that give each part of an instrument a level of its own.

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.images import ImageSequence, as_levels
from intrasplat.clip.video import VideoFile

MASK_THRESHOLD = 128  # of 255: masks of black and white have grey edges where they are lossy or resized
MAX_EXACT_LEVELS = 16
"""PNGs of at most so many values hold labels, of which each counts; more values are edges and losses of a coder."""
MERGED_LEVELS = 16
"""Values of lossy masks that lie nearer together are one level."""
MIN_LOSSY_SHARE = 5e-4
"""Share of all pixels; fewer inside areas of one value are a coder's losses."""
_COLOUR_BITS = 3
"""A colour that counts as another one differs in these bits of a channel."""


@dataclass(frozen=True)
class MaskLevels:
    """Masks as levels.

    values   [T, H, W] uint8, the largest colour channel of each pixel
    levels   the levels that fill areas, rising; edges between them are none
    shares   the share of all pixels that each level fills
    colours  number of colours that fill areas of PNGs, or of levels; a level may stand for several colours
    """

    values: NDArray[np.uint8]
    levels: tuple[int, ...]
    shares: tuple[float, ...]
    colours: int

    @property
    def several(self) -> bool:
        """Whether there are more classes than an instrument and tissue."""
        return self.colours > 2

    @property
    def has_colours(self) -> bool:
        """Whether classes differ by their colours, and not by levels alone."""
        return self.several and self.colours > len(self.levels)

    @property
    def thresholds(self) -> tuple[int, int]:
        """The least value above the lowest level, and the least value of the highest level."""
        low, high = self.levels[:2], self.levels[-2:]
        if len(self.levels) < 2 or (low == high and low[0] < MASK_THRESHOLD <= low[1]):
            return MASK_THRESHOLD, MASK_THRESHOLD
        return (low[0] + low[1] + 1) // 2, (high[0] + high[1] + 1) // 2

    def __str__(self) -> str:
        """The levels and their shares: 0 (90 %), 100 (4 %), 255 (6 %)."""
        return ", ".join(f"{each} ({100 * share:.2g} %)" for each, share in zip(self.levels, self.shares, strict=True))


def read_levels(frames: ImageSequence | VideoFile) -> MaskLevels:
    """The masks, decoded, with the levels that they use. InputError if one is damaged."""
    values = np.empty((frames.frame_count, frames.height, frames.width), dtype=np.uint8)
    found, inside = np.zeros(256, np.int64), np.zeros(256, np.int64)
    colours = np.zeros((1 << _COLOUR_BITS,) * 3, np.int64)
    lossless = _is_lossless(frames)
    for index, image in enumerate(_decoded(frames)):
        levels = as_levels(image)
        channels = (levels,) if levels.ndim == 2 else cv2.split(levels)
        values[index] = functools.reduce(cv2.max, channels)
        flat = _flat(values[index])
        found += _counts([values[index]], None, 256)
        inside += _counts([values[index]], flat, 256)
        if lossless and len(channels) > 1:
            colours += _counts(channels, flat, 1 << _COLOUR_BITS)
    exact = lossless and np.count_nonzero(found) <= MAX_EXACT_LEVELS
    least = 1 if exact else MIN_LOSSY_SHARE * values.size
    groups = _groups(inside, 1 if exact else MERGED_LEVELS)
    groups = [group for group in groups if inside[group].sum() >= least]
    return MaskLevels(
        values,
        levels=tuple(int(group[inside[group].argmax()]) for group in groups),
        shares=tuple(float(inside[group].sum() / values.size) for group in groups),
        colours=max(len(groups), int(np.count_nonzero(colours)) if exact else 0),
    )


def _decoded(frames: ImageSequence | VideoFile) -> Iterator[NDArray[Any]]:
    return map(frames.decode, frames.names) if isinstance(frames, ImageSequence) else frames.frames()


def _is_lossless(frames: ImageSequence | VideoFile) -> bool:
    return isinstance(frames, ImageSequence) and all(
        PurePosixPath(name).suffix.lower() == ".png" for name in frames.names
    )


def _flat(values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Not 0 where the neighbours have a pixel's value, apart from a coder's losses: edges are none."""
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.compare(cv2.morphologyEx(values, cv2.MORPH_GRADIENT, kernel), MERGED_LEVELS // 2, cv2.CMP_LT))


def _counts(channels: Sequence[NDArray[Any]], among: NDArray[np.uint8] | None, bins: int) -> NDArray[np.int64]:
    """How often each value or colour occurs where `among` is not 0, in `bins` bins a channel."""
    count = len(channels)
    counted = cv2.calcHist(channels, list(range(count)), among, [bins] * count, [0, 256] * count)
    return np.asarray(counted, np.int64).reshape((bins,) * count)


def _groups(inside: NDArray[np.int64], gap: int) -> list[NDArray[np.intp]]:
    """The values that occur, split where two neighbours are `gap` or more apart."""
    occurring = np.flatnonzero(inside)
    return np.split(occurring, np.flatnonzero(np.diff(occurring) >= gap) + 1) if occurring.size else []
