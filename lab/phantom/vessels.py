"""Blood vessels: branching random walks over the sheet, drawn as lines that get thinner with every fork."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.phantom.fields import Image32

STEP_MM = 0.9
PIECE_STEPS = 5  # a vessel is drawn in pieces of this many steps, each of one width
WANDER_RAD = 0.22  # turn of direction in one step
CURL_RAD = 0.05  # slow bend of a whole vessel
FORK_CHANCE = 0.5  # probability that a piece forks
FORK_SHARE = 0.72  # of the parent's width that a branch keeps; the parent keeps the rest by Murray's law, r^3
TAPER = 0.93  # of the width, from piece to piece
MIN_WIDTH_MM = 0.09
MM2_PER_ARTERY, MM2_PER_VEIN = 420.0, 1100.0  # area of sheet for one trunk
ARTERY_MM, VEIN_MM = (0.22, 0.62), (0.6, 1.3)  # width of trunks
ARTERY_BLUR_MM, VEIN_BLUR_MM = 0.05, 0.35  # veins lie deeper
SUBPIXEL_BITS = 4  # of OpenCV's line coordinates
MAX_PIECES = 40_000  # usual sheets need a tenth


@dataclass(frozen=True)
class _Sprout:
    place_mm: NDArray[np.float64]
    direction_rad: float
    width_mm: float


def draw_vessels(
    rng: np.random.Generator, extent_mm: tuple[float, float], texel_mm: float, shape: tuple[int, int]
) -> tuple[Image32, Image32]:
    """(arteries, veins) [rows, columns] in [0, 1], to be read: share of a texel's depth that the vessel fills.

    The last ones are remembered: phantoms of one seed and size have the same, whatever their motion.
    """
    arteries, veins, after = _remembered(pickle.dumps(rng.bit_generator.state), extent_mm, texel_mm, shape)
    rng.bit_generator.state = after
    return arteries, veins


@lru_cache(maxsize=8)
def _remembered(
    state: bytes, extent_mm: tuple[float, float], texel_mm: float, shape: tuple[int, int]
) -> tuple[Image32, Image32, Any]:
    """The same, and the generator's state afterwards."""
    rng = np.random.default_rng()
    rng.bit_generator.state = pickle.loads(state)
    arteries = _draw(rng, extent_mm, texel_mm, shape, MM2_PER_ARTERY, ARTERY_MM, ARTERY_BLUR_MM)
    veins = _draw(rng, extent_mm, texel_mm, shape, MM2_PER_VEIN, VEIN_MM, VEIN_BLUR_MM)
    for each in (arteries, veins):
        each.flags.writeable = False
    return arteries, veins, rng.bit_generator.state


def _draw(
    rng: np.random.Generator,
    extent_mm: tuple[float, float],
    texel_mm: float,
    shape: tuple[int, int],
    mm2_per_trunk: float,
    trunk_mm: tuple[float, float],
    blur_mm: float,
) -> Image32:
    canvas = np.zeros(shape, dtype=np.uint8)
    count = max(1, round(extent_mm[0] * extent_mm[1] / mm2_per_trunk))
    trunks = []
    for _ in range(count):
        place, angle, width_mm = (
            rng.uniform(0, 1, 2) * extent_mm[::-1],
            rng.uniform(0, 2 * np.pi),
            rng.uniform(*trunk_mm),
        )
        # a trunk grows in both directions from where it surfaces, so that none has a blunt end
        trunks += [_Sprout(place, angle, width_mm), _Sprout(place, angle + np.pi, width_mm)]
    # thin ones first, so that a trunk covers where its branches begin
    for width_mm, line_mm in sorted(_grow(rng, trunks), key=lambda piece: piece[0]):
        width = width_mm / texel_mm
        points = (line_mm / texel_mm * 2**SUBPIXEL_BITS).round().astype(np.int32)
        shade = int(255 * min(1.0, width) * min(1.0, 0.45 + 0.8 * width_mm / trunk_mm[1]))
        cv2.polylines(canvas, [points], False, shade, max(1, round(width)), cv2.LINE_AA, SUBPIXEL_BITS)
    blurred = cv2.GaussianBlur(canvas.astype(np.float32) / 255, (0, 0), max(0.45, blur_mm / texel_mm))
    return np.asarray(blurred, dtype=np.float32)


def _grow(rng: np.random.Generator, sprouts: list[_Sprout]) -> Iterator[tuple[float, NDArray[np.float64]]]:
    """Pieces (width mm, points [PIECE_STEPS + 1, 2] mm) of the vessels that grow from sprouts."""
    for _ in range(MAX_PIECES):
        if not sprouts:
            return
        sprout = sprouts.pop()
        turns = rng.normal(rng.normal(0, CURL_RAD), WANDER_RAD, PIECE_STEPS)
        directions = sprout.direction_rad + turns.cumsum()
        line = np.empty((PIECE_STEPS + 1, 2))
        line[0], line[1:, 0], line[1:, 1] = 0, np.cos(directions), np.sin(directions)
        line[1:] = (STEP_MM * line[1:]).cumsum(0)
        line += sprout.place_mm
        yield sprout.width_mm, line
        width = TAPER * sprout.width_mm
        if rng.random() < FORK_CHANCE:
            side = (-1.0, 1.0)[rng.integers(2)] * rng.uniform(0.45, 1.1)
            share = FORK_SHARE * rng.uniform(0.6, 1.0)
            if share * width > MIN_WIDTH_MM:
                sprouts.append(_Sprout(line[-1], directions[-1] + side, share * width))
            width *= (1 - 0.5 * share**3) ** (1 / 3)
            directions[-1] -= 0.25 * side
        if width > MIN_WIDTH_MM and rng.random() > 0.04:
            sprouts.append(_Sprout(line[-1], directions[-1], width))
