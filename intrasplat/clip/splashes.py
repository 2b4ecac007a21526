"""Drops on the lens of an eye: parts of its picture that lose their fine detail for a time, unlike the other eye's.

Symbols: T frames, S of them measured, H W pixels, h w blocks, F frames of a run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.field_of_view import Mask
from intrasplat.clip.split import spread
from intrasplat.machine.mapped import let_go
from intrasplat.notices import Notice, NoticeCode

Reals = NDArray[np.float64]
TissueOf = Callable[[int], Mask | None]
"""The tissue [H, W] of a frame; None: the whole picture."""

MEASURED_FRAMES, MIN_FRAMES = 48, 12
ANALYSED_WIDTH, BLOCK_PX = 320, 8
"""Pictures are shrunk to about this width; a block is about a fortieth of it."""
FINE_PX = 2.0
"""Standard deviation of the blur, in pixels of the shrunk picture, below which detail is fine."""
NOISE_LEVELS = 0.5
"""Added to the detail of a block, so that noise alone does not vary."""
WHOLE = 0.99
"""Least share of a block that is tissue."""
MIN_RUN, MIN_REST = 1 / 6, 1 / 8
"""Shares of the measured frames: with a drop and without it, at least."""
SEED, GROWN, MIN_SEEDS = 1.5, 1.0, 4
"""Fall of the logarithm of detail within a drop, and at its edge; least number of connected blocks of the first. In
clean clips at most two connected blocks lie above SEED; under drops of blood or water the median is 1.9 to 2.4."""
MAX_DETAIL = -1.0
"""Most of the median logarithm of detail in a drop, beside the frame's own: -1.3 and less in drops, -0.4 and more where
a camera moves on to smoother tissue."""
MAX_DROPS = 8
MIN_BOTH, MOST = 0.5, 0.7
"""If the other eye's detail falls by MIN_BOTH of it in MOST blocks where the same tissue may be, the scene changed.
With a MOST of 0.5, drops that lie on both lenses by chance are missed; with 0.85, tissue that changed counts as drops.
"""
MIN_VIEW = 0.5
"""Least share of a drop's blocks that the other eye has in view there."""


@dataclass(frozen=True, eq=False)
class Splash:
    """A drop on the lens of one eye.

    shown        [H, W] the pixels of that eye's picture that it covers
    first, last  frames
    """

    shown: Mask
    first: int
    last: int


@dataclass(frozen=True)
class Splashes:
    """The drops on the lenses of a clip's eyes."""

    left: tuple[Splash, ...] = ()
    right: tuple[Splash, ...] = ()

    def covered(self, frame: int, *, right: bool = False) -> Mask | None:
        """The pixels [H, W] of an eye that drops cover in a frame; None: there are none."""
        shown = [each.shown for each in (self.right if right else self.left) if each.first <= frame <= each.last]
        return np.logical_or.reduce(shown) if shown else None

    @property
    def notices(self) -> tuple[Notice, ...]:
        """The assumption for the report, where there is a drop."""
        if not self.left and not self.right:
            return ()
        drops = [
            f"{np.mean(each.shown):.1%} of the {eye} eye's picture in frames {each.first} to {each.last}"
            for eye, splashes in (("left", self.left), ("right", self.right))
            for each in splashes
        ]
        text = f"splashes on the lens: {', '.join(drops)}; nothing is read there"
        return (Notice.info(NoticeCode.SPLASHES, text),)


def _shortest_run(count: int) -> int:
    """The fewest frames of `count` in which a drop is found."""
    return max(1, round(MIN_RUN * count))


def falls(detail: Reals) -> tuple[Reals, NDArray[np.int64]]:
    """The largest fall [h, w] of mean detail in a run of frames beside all others, and that run's [2, h, w] bounds.

    detail: [S, h, w] logarithms; NaN where tissue is not in view.
    """
    count = len(detail)
    known = np.isfinite(detail)
    sums, counts = (
        np.concatenate([np.zeros((1, *detail.shape[1:])), np.cumsum(each, axis=0)])
        for each in (np.where(known, detail, 0), known)
    )
    shortest, rest = _shortest_run(count), max(1, round(MIN_REST * count))
    best, bounds = np.zeros(detail.shape[1:]), np.zeros((2, *detail.shape[1:]), np.int64)
    for first in range(count - shortest + 1):
        ends = np.arange(first + shortest, count + 1)
        inside, outside = counts[ends] - counts[first], counts[-1] - counts[ends] + counts[first]
        within = (sums[ends] - sums[first]) / np.maximum(inside, 1)
        without = (sums[-1] - sums[ends] + sums[first]) / np.maximum(outside, 1)
        fall = np.where((inside >= shortest) & (outside >= rest), without - within, 0)
        chosen = fall.argmax(axis=0)
        largest = np.take_along_axis(fall, chosen[None], axis=0)[0]
        better = largest > best
        best[better] = largest[better]
        bounds[0, better], bounds[1, better] = first, ends[0] + chosen[better]
    return best, bounds


def find_splashes(
    eyes: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    tissue: tuple[TissueOf, TissueOf],
    frames: Sequence[int],
    disparities_px: tuple[float, float],
    pool: Executor,
) -> Splashes:
    """The drops on the lenses of a clip's eyes.

    A drop that is there from the first frame to the last is not found.

    Args:
        eyes: [T, H, W, 3] of the left and the right eye.
        tissue: of each eye, as far as masks and the field of view show it.
        frames: those that may be measured, rising.
        disparities_px: the least and the largest x_left - x_right of the scene.
    """
    measured = spread(frames, MEASURED_FRAMES)
    count, height, width = eyes[0].shape[:3]
    details = [_details(rgb, masks, measured, pool) for rgb, masks in zip(eyes, tissue, strict=True)]
    if not all(details):
        return Splashes()
    left, right = (np.stack([job.result() for job in each]) for each in details)
    block = _shrunk_by(width) * BLOCK_PX
    least, most = int(np.floor(disparities_px[0] / block)), int(np.ceil(disparities_px[1] / block))
    in_right, in_left = range(-most, -least + 1), range(least, most + 1)
    left_parts, right_parts = list(_parts(left)), list(_parts(right))
    on_left = _drops(left_parts, left, right, in_right)
    on_right = _drops(right_parts, right, _without(left, on_left), in_left)
    on_left = _drops(left_parts, left, _without(right, on_right), in_right)
    bounds = [*measured, count]

    def splash(part: Part) -> Splash:
        shown = np.zeros((height, width), np.bool_)
        wide = cv2.dilate(part.blocks.astype(np.uint8), np.ones((3, 3), np.uint8))
        rows, columns = (length * block for length in wide.shape)
        shown[:rows, :columns] = np.kron(wide, np.ones((block, block), np.uint8)) > 0
        shown[rows:], shown[:, columns:] = shown[rows - 1], shown[:, columns - 1 : columns]
        return Splash(shown, bounds[part.first - 1] + 1 if part.first else 0, bounds[part.end] - 1)

    return Splashes(tuple(map(splash, on_left)), tuple(map(splash, on_right)))


def lost_detail(rgb: NDArray[np.uint8], tissue: TissueOf, frames: Sequence[int], pool: Executor) -> tuple[Notice, ...]:
    """A warning for each part of a clip of one eye that may be a drop on its lens; arguments as of find_splashes."""
    measured = spread(frames, MEASURED_FRAMES)
    jobs = _details(rgb, tissue, measured, pool)
    if not jobs:
        return ()
    return tuple(
        Notice.warning(
            NoticeCode.DETAIL_LOST,
            f"In frames {measured[part.first]} to {measured[part.end - 1]} {part.blocks.mean():.1%} of the picture has "
            "lost its fine detail, by a drop on the lens or by blood or water on the tissue; it is modelled as tissue. "
            "If it is a drop, give masks that cover it.",
        )
        for part in _parts(np.stack([job.result() for job in jobs]))
    )


@dataclass(frozen=True, eq=False)
class Part:
    """Connected blocks [h, w] whose detail falls in the same run of measured frames, first to end - 1."""

    blocks: NDArray[np.bool_]
    first: int
    end: int


def _drops(parts: Sequence[Part], own: Reals, other: Reals, shifts: range) -> list[Part]:
    """Those parts of an eye whose detail does not fall in the other eye, beside all frames or where the run starts."""
    return [
        part
        for part in parts
        if not all(_falls_too(part, own, other, near, shifts) for near in (slice(None), _around_an_end(part, len(own))))
    ]


def _without(detail: Reals, drops: Sequence[Part]) -> Reals:
    """The detail [S, h, w] of an eye as if nothing fell under its drops: they say nothing about the tissue there."""
    cleared = detail.copy()
    for drop in drops:
        cleared[:, drop.blocks] = 0
    return cleared


def _shrunk_by(width: int) -> int:
    return max(1, round(width / ANALYSED_WIDTH))


def _details(rgb: NDArray[np.uint8], tissue: TissueOf, measured: Sequence[int], pool: Executor) -> list[Future[Reals]]:
    """The jobs of the measured frames; none if they are too few, or the picture is smaller than a block."""
    side = _shrunk_by(rgb.shape[2])
    if len(measured) < MIN_FRAMES or min(rgb.shape[1:3]) < side * BLOCK_PX:
        return []
    return [pool.submit(_detail, rgb, tissue, index, side) for index in measured]


def _detail(rgb: NDArray[np.uint8], tissue: TissueOf, index: int, side: int) -> Reals:
    """[h, w] logarithm of a frame's fine detail, beside its median; NaN where a block is not tissue alone."""
    rows, columns = (length // (side * BLOCK_PX) for length in rgb.shape[1:3])
    used = np.s_[: rows * BLOCK_PX * side, : columns * BLOCK_PX * side]
    grey = cv2.cvtColor(np.ascontiguousarray(rgb[index][used]), cv2.COLOR_RGB2GRAY)
    let_go(rgb[index])
    small = cv2.resize(grey, (columns * BLOCK_PX, rows * BLOCK_PX), interpolation=cv2.INTER_AREA).astype(np.float32)
    fine = cv2.resize(
        (small - cv2.GaussianBlur(small, (0, 0), FINE_PX)) ** 2, (columns, rows), interpolation=cv2.INTER_AREA
    )
    detail = np.log(fine.astype(np.float64) + NOISE_LEVELS**2) / 2
    mask = tissue(index)
    if mask is not None:
        shown = cv2.resize(mask[used].astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
        let_go(mask)
        detail[shown < WHOLE] = np.nan
    return np.asarray(detail - np.nanmedian(detail)) if np.isfinite(detail).any() else detail


def _around_an_end(part: Part, count: int) -> slice:
    """The shortest run of frames, of `count`, before and after the start of a part, or its end if it starts first."""
    shortest, middle = _shortest_run(count), part.first or part.end
    return slice(max(0, middle - shortest), middle + shortest)


def _fall(detail: Reals, run: slice, frames: slice = slice(None)) -> Reals:
    """[h, w] fall of the mean detail [S, h, w] in a run beside all others of these frames; NaN: not known."""
    inside, compared = np.zeros((2, len(detail)), np.bool_)
    inside[run], compared[frames] = True, True
    return _mean(detail[compared & ~inside]) - _mean(detail[compared & inside])


def _mean(detail: Reals) -> Reals:
    """[h, w] mean over frames of detail [F, h, w]; NaN where it is known in less than half of them."""
    known = np.isfinite(detail)
    counts = known.sum(axis=0)
    return np.where(
        counts >= max(1, len(detail) / 2), np.where(known, detail, 0).sum(axis=0) / np.maximum(counts, 1), np.nan
    )


def _parts(detail: Reals) -> Iterator[Part]:
    """The parts of an eye's picture whose detail [S, h, w] falls for a time."""
    best, bounds = falls(detail)
    for _ in range(MAX_DROPS):
        row, column = divmod(int(best.argmax()), best.shape[1])
        if best[row, column] < SEED:
            return
        first, end = map(int, bounds[:, row, column])
        fall = np.nan_to_num(_fall(detail, slice(first, end)))
        _, label = cv2.connectedComponents((fall > GROWN).astype(np.uint8), connectivity=4)
        part = (label == label[row, column]) & (fall > GROWN)
        best[part] = 0
        best[row, column] = 0
        _, seeds = cv2.connectedComponents((part & (fall > SEED)).astype(np.uint8), connectivity=4)
        remaining = _mean(detail[first:end])[part]
        if np.bincount(seeds.ravel())[1:].max(initial=0) >= MIN_SEEDS and np.nanmedian(remaining) < MAX_DETAIL:
            yield Part(part, first, end)


def _falls_too(part: Part, own: Reals, other: Reals, frames: slice, shifts: range) -> bool:
    """Whether a part's detail falls in the other eye too, or may do so out of its view, beside all others of `frames`.

    own, other: [S, h, w] detail. shifts: columns by which its tissue may lie to the right in the other eye.
    """
    blocks, run = part.blocks, slice(part.first, part.end)
    ours, theirs = _fall(own, run, frames)[blocks], _fall(other, run, frames)
    least = MIN_BOTH * float(np.median(ours[np.isfinite(ours)])) if np.isfinite(ours).any() else 0.0
    for shift in shifts:
        width = blocks.shape[1] - abs(shift)
        moved = np.zeros_like(blocks)
        moved[:, max(0, shift) : max(0, shift) + width] = blocks[:, max(0, -shift) : max(0, -shift) + width]
        seen = theirs[moved & np.isfinite(theirs)]
        if len(seen) < MIN_VIEW * blocks.sum() or np.percentile(seen, 100 * (1 - MOST)) > least:
            return True
    return False
