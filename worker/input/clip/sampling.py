"""Frames that show nothing new: repeats, a paused recording, tissue that rests or hardly moves.

Symbols: T frames, h w pixels of a thumbnail, P patches of PATCH x PATCH pixels of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.wire.notices import Notice, NoticeCode
from worker.input.clip.split import training_frames
from worker.input.clip.types import DepthClip, RgbFrame
from worker.machine.mapped import let_go

KEPT_FRAMES = 64
"""About so many frames are used at least: a clip of less than twice as many keeps all of them."""
MAX_MOVED = 1 / 640
"""Of the picture's width: what moved less since the last frame that is used shows nothing new."""
SAME_LEVELS = 0.2
"""Of 255, in a thumbnail: what changed less is the same, also where there is no noise."""
THUMBNAIL_WIDTH = 80
PATCH = 8
NOISE_PERCENTILE = 5.0
"""Of a patch's changes over time, which the noise alone makes: most clips rest in a twentieth of their frames."""
NOISE_MARGIN = 2.0
"""Over that: of 64 pixels, one frame in twenty shows 0.7 of the noise, and the noisiest of all patches 1.4."""

Thumbnail = NDArray[np.float32]
"""Grey [h, w], levels of 255."""
Mapping = Callable[[Callable[[int], Thumbnail], Iterable[int]], Iterable[Thumbnail]]


def thumbnail(rgb: RgbFrame) -> Thumbnail:
    """A picture [H, W, 3] in grey, THUMBNAIL_WIDTH to twice as many pixels wide; each is the mean of a square.

    The picture leaves memory, as far as it lies in a file.
    """
    side = max(1, rgb.shape[1] // THUMBNAIL_WIDTH)
    height, width = max(1, rgb.shape[0] // side), rgb.shape[1] // side
    grey = cv2.cvtColor(np.ascontiguousarray(rgb[: height * side, : width * side]), cv2.COLOR_RGB2GRAY)
    let_go(rgb)
    return np.asarray(cv2.resize(grey.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA))


def nothing_new(rgb: NDArray[np.uint8], frames: Sequence[int], mapping: Mapping = map) -> tuple[int, ...]:
    """Those of `frames` that show nothing new since the last of them that is used, rising.

    Beyond the clip's own noise no patch changed as if something in it had moved by MAX_MOVED. After T // KEPT_FRAMES
    frames one is used in any case. Frames that are not in `frames`, such as held-out ones, are not looked at.

    Args:
        rgb: [T, H, W, 3] of the whole clip.
        frames: rising.
        mapping: as map(); it may use several threads.
    """
    longest = len(rgb) // KEPT_FRAMES
    if longest < 2 or min(rgb.shape[1:3]) < THUMBNAIL_WIDTH // 2:
        return ()
    thumbnails = dict(zip(frames, mapping(lambda i: thumbnail(rgb[i]), frames), strict=True))
    noise = _noise(list(thumbnails.values()))
    used, left_out = frames[0], []
    for i in frames[1:]:
        moved = _moved(thumbnails[used], thumbnails[i], noise)
        if i - used < longest and moved <= MAX_MOVED:
            left_out.append(i)
        else:
            used = i
    return tuple(left_out)


def told_of(left_out: Sequence[int], frame_count: int) -> tuple[Notice, ...]:
    """What the report says of frames that show nothing new."""
    if not left_out:
        return ()
    text = (
        f"frames: {len(left_out):,} of {frame_count:,} show nothing new and were left out; times stay those of the clip"
    )
    return (Notice.info(NoticeCode.NOTHING_NEW, text),)


def sampled(clip: DepthClip, holdout: str) -> DepthClip:
    """A clip whose depth is known, with its training frames that show nothing new in left_out."""
    left_out = nothing_new(clip.rgb, training_frames(clip.frame_count, holdout))
    told = told_of(left_out, clip.frame_count)
    return replace(clip, left_out=left_out, assumptions=(*clip.assumptions, *told))


def _noise(thumbnails: Sequence[Thumbnail]) -> NDArray[np.float64]:
    """Variance of the noise of each patch [P], levels^2. Motion that is not even adds to it.

    Second differences in time have six times the noise's variance, and even motion cancels in them.
    """
    triples = zip(thumbnails, thumbnails[1:], thumbnails[2:], strict=False)
    changes = [_by_patch(np.square(one - 2 * two + three)) / 6 for one, two, three in triples]
    return np.asarray(np.percentile(changes, NOISE_PERCENTILE, axis=0) if changes else 0.0)


def _moved(earlier: Thumbnail, later: Thumbnail, noise: NDArray[np.float64]) -> float:
    """The motion that would explain the change of the patch that changed most, in picture widths; 0 for noise [P].

    A texture that moves by u px changes by u^2 / 2 times its squared gradient, in the mean over directions.
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
