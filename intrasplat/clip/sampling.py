"""Selects training frames to skip: frames that show nothing new, and frames that a short training has no time for.

Nothing new are repeats, a paused recording, and tissue that rests or hardly moves.

Symbols: T frames, h w pixels of a thumbnail, P patches of PATCH x PATCH pixels of it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.split import training_frames
from intrasplat.clip.types import DepthClip, RgbFrame
from intrasplat.machine.mapped import let_go
from intrasplat.names import BUDGETS_S
from intrasplat.notices import Notice, NoticeCode
from intrasplat.options import ReconstructionOptions

FRAMES_A_SECOND, LEAST_FRAMES = 5.8, 32
"""Training frames for each second of training, and the minimum: two cores make some three steps on each of them."""
SKIPPED_CODES = (NoticeCode.NOTHING_NEW, NoticeCode.NO_TIME)
MIN_USED_FRAMES = 64
"""Approximate minimum of frames used: a clip of less than twice as many keeps all of them."""
MAX_MOVED = 1 / 640
"""Share of the picture's width: a frame with less motion since the last used frame shows nothing new."""
SAME_LEVELS = 0.2
"""A smaller change of a thumbnail, in levels of 255, counts as none even without noise."""
THUMBNAIL_WIDTH = 80
PATCH = 8
NOISE_PERCENTILE = 5.0
"""This percentile of a patch's changes over time is due to noise: most clips rest in a twentieth of their frames."""
NOISE_MARGIN = 2.0
"""Factor on that change: with 64 pixels, one frame in twenty has 0.7 of the noise, and the noisiest patch 1.4."""

Thumbnail = NDArray[np.float32]
"""Grey [h, w], levels of 255."""
Mapping = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""The signature of `map` for one argument."""


def thumbnail(rgb: RgbFrame) -> Thumbnail:
    """A grey thumbnail of a picture [H, W, 3], THUMBNAIL_WIDTH to twice as many pixels wide, by means over squares.

    If the picture is mapped from a file, it is released from memory.
    """
    side = max(1, rgb.shape[1] // THUMBNAIL_WIDTH)
    height, width = max(1, rgb.shape[0] // side), rgb.shape[1] // side
    grey = cv2.cvtColor(np.ascontiguousarray(rgb[: height * side, : width * side]), cv2.COLOR_RGB2GRAY)
    let_go(rgb)
    return np.asarray(cv2.resize(grey.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA))


@dataclass(frozen=True)
class SkippedFrames:
    """Skipped training frames, rising: those that show nothing new, and those for which there is no time."""

    nothing_new: tuple[int, ...] = ()
    no_time: tuple[int, ...] = ()

    @property
    def frames(self) -> tuple[int, ...]:
        """All skipped frames, rising."""
        return tuple(sorted({*self.nothing_new, *self.no_time}))

    def notices(self, frame_count: int) -> tuple[Notice, ...]:
        """The notices about them for the report."""
        found = []
        if self.nothing_new:
            text = f"frames: {len(self.nothing_new):,} of {frame_count:,} show nothing new and were left out"
            found.append(Notice.info(NoticeCode.NOTHING_NEW, f"{text}; times stay those of the clip"))
        if self.no_time:
            text = f"frames: {len(self.no_time):,} of {frame_count:,} were left out, because training is too short for"
            found.append(Notice.info(NoticeCode.NO_TIME, f"{text} more; a longer budget_s uses them"))
        return tuple(found)


def skippable_frames(
    rgb: NDArray[np.uint8], frames: Sequence[int], most: int | None = None, mapping: Mapping = map
) -> SkippedFrames:
    """The frames, out of `frames`, that training can skip. Others, such as held-out frames, are not read.

    A frame shows nothing new if, since the last used frame, no patch has changed beyond noise by as much as a motion of
    MAX_MOVED. One in T // MIN_USED_FRAMES frames is used in any case. If more than `most` remain, about `most` are
    used: half of them spread evenly over time, half evenly over the motion.

    Args:
        rgb: [T, H, W, 3] of the whole clip.
        frames: rising.
        most: maximum number of used frames; None: no limit.
        mapping: a replacement of map(), such as a thread pool's.
    """
    longest = len(rgb) // MIN_USED_FRAMES
    too_many = most is not None and len(frames) > most
    if (longest < 2 and not too_many) or min(rgb.shape[1:3]) < THUMBNAIL_WIDTH // 2:
        return SkippedFrames()
    thumbnails = dict(zip(frames, mapping(lambda i: thumbnail(rgb[i]), frames), strict=True))
    noise = _noise(list(thumbnails.values()))
    used: list[int] = [frames[0]]
    unused: list[int] = []
    for i in frames[1:]:
        moved = _moved(thumbnails[used[-1]], thumbnails[i], noise)
        (unused if i - used[-1] < longest and moved <= MAX_MOVED else used).append(i)
    if most is None or len(used) <= most:
        return SkippedFrames(tuple(unused))
    steps = [_moved(thumbnails[one], thumbnails[two], noise) for one, two in pairwise(used)]
    return SkippedFrames(tuple(unused), tuple(sorted(set(used) - set(_spread(used, steps, most)))))


def _spread(frames: Sequence[int], moved: Sequence[float], count: int) -> list[int]:
    """At most `count` of the frames, at equal steps of time and motion, the first and the last included.

    moved: the motion between each frame and the next.
    """
    shares = [np.asarray(each, np.float64) / max(np.sum(each), 1e-12) for each in (np.diff(frames), moved)]
    course = np.concatenate([[0.0], np.cumsum(np.mean(shares, axis=0))])
    places = np.abs(course[:, None] - np.linspace(0, course[-1], count)).argmin(0)
    return [frames[place] for place in np.unique(places)]


def most_frames(options: ReconstructionOptions) -> int | None:
    """The number of training frames for which a preset's time suffices; None: no limit."""
    if options.use_frames == "all" or options.iterations is not None or options.preset not in BUDGETS_S:
        return None
    return max(LEAST_FRAMES, round(FRAMES_A_SECOND * (options.budget_s or BUDGETS_S[options.preset])))


def sampled(clip: DepthClip, options: ReconstructionOptions, empty: Collection[int] = ()) -> DepthClip:
    """A clip with depth, with its empty frames and skipped training frames in skipped."""
    if options.use_frames == "all":
        return replace(clip, skipped=tuple(sorted(empty)))
    train = sorted(set(training_frames(clip.frame_count, options.holdout)) - set(empty))
    found = skippable_frames(clip.rgb, train, most_frames(options))
    assumptions = tuple(each for each in clip.assumptions if each.code not in SKIPPED_CODES)
    skipped = tuple(sorted({*empty, *found.frames}))
    return replace(clip, skipped=skipped, assumptions=(*assumptions, *found.notices(clip.frame_count)))


def _noise(thumbnails: Sequence[Thumbnail]) -> NDArray[np.float64]:
    """Noise variance of each patch [P], levels^2. Accelerated motion adds to it.

    Second differences in time have six times the noise's variance, and uniform motion cancels in them.
    """
    triples = zip(thumbnails, thumbnails[1:], thumbnails[2:], strict=False)
    changes = [_by_patch(np.square(one - 2 * two + three)) / 6 for one, two, three in triples]
    return np.asarray(np.percentile(changes, NOISE_PERCENTILE, axis=0) if changes else 0.0)


def _moved(earlier: Thumbnail, later: Thumbnail, noise: NDArray[np.float64]) -> float:
    """The motion, in picture widths, that explains the change of the patch that changed most; 0 if it is noise.

    A texture that moves by u px changes by u^2 / 2 times its squared gradient, averaged over directions. noise: [P].
    """
    change = _by_patch(np.square(later - earlier)) - 2 * NOISE_MARGIN * noise - SAME_LEVELS**2
    down, right = np.gradient(earlier)
    slope = _by_patch(np.square(down) + np.square(right)) + SAME_LEVELS**2
    moved_px = np.sqrt(np.maximum(2 * change / slope, 0).max())
    return float(moved_px / earlier.shape[1])


def _by_patch(values: NDArray[Any]) -> NDArray[np.float64]:
    """Means [P] of values [h, w] over patches; the last patch of a row or column is larger."""
    tops, lefts = (np.arange(max(side // PATCH, 1)) * PATCH for side in values.shape)
    heights, widths = (np.diff(starts, append=side) for starts, side in zip((tops, lefts), values.shape, strict=True))
    sums = np.add.reduceat(np.add.reduceat(values, tops, axis=0, dtype=np.float64), lefts, axis=1)
    return np.asarray(sums / np.outer(heights, widths)).ravel()
