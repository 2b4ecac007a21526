"""The split of a clip into training frames and held-out frames (the test split).

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.sharpness import frame_weights
from intrasplat.clip.types import DepthClip
from intrasplat.errors import InputError
from intrasplat.machine.mapped import let_go
from intrasplat.notices import Notice, NoticeCode, named_frames

MIN_FRAMES = 9  # shorter clips have no held-out frames
REPEAT_LEVELS = 0.2  # mean |difference| in 8-bit levels; two frames below it are the same picture
PAUSE_FRAMES = 8
"""A picture that lasts for more frames is a pause: it is trained on, so held-out frames in it test nothing."""
RULES = ("every8", "blocks8", "none")
_FIELD = "options.holdout"
_REMEDY = 'Say "every8", "blocks8", "none", or frame numbers like "1,9,17".'


@dataclass(frozen=True)
class FrameSplit:
    """The training and held-out frames, as rising lists of indices. No part of training reads held-out frames.

    repeated lists frames in neither set: training frames that repeat a held-out frame, held-out frames that repeat
    training frames in a pause, held-out frames that are blurred, and frames that the clip skips (skipped). weights has
    the shares below 1 of the epochs in which blurred training frames are drawn (sharpness.py).
    """

    train: list[int]
    held_out: list[int]
    repeated: list[int]
    warnings: tuple[Notice, ...] = ()
    weights: Mapping[int, float] = field(default_factory=dict)

    @property
    def sharp(self) -> list[int]:
        """The training frames that are not blurred beside those around them, rising."""
        return [index for index in self.train if index not in self.weights]

    @property
    def sharp_first(self) -> list[int]:
        """The training frames: the sharp ones, then those that are blurred."""
        return [*self.sharp, *(index for index in self.train if index in self.weights)]


def split_frames(clip: DepthClip, holdout: str = "every8") -> FrameSplit:
    """The split of the clip's T frames.

    holdout  "every8": frames i with (i - 1) % 8 == 0, as in the papers; "blocks8": i in [8, T - 8) with
             (i // 8) % 3 == 1, which tests more strictly with a fixed camera; "none"; or a list, "1,9,17"
    Clips under 9 frames have no held-out frames, with a warning. InputError for unknown rules and missing frames.
    """
    count = clip.frame_count
    held_out = [index for index in held_out_frames(count, holdout) if index not in clip.skipped]
    train = sorted(set(range(count)) - set(held_out) - set(clip.skipped))
    if holdout == "none":
        weights = frame_weights(clip, train, train)
        return FrameSplit(train, [], list(clip.skipped), _blur_warnings(weights, (), count), weights)
    if count < MIN_FRAMES:
        return _nothing_held_out(clip, f"the clip has {count} frames, fewer than {MIN_FRAMES}")
    if not held_out:
        return _nothing_held_out(clip, f"{holdout} finds no frame to hold out in {count}")
    paused = find_paused(clip.rgb, held_out)
    judged = [index for index in held_out if index not in paused]
    if not judged:
        return _nothing_held_out(clip, "every held-out frame repeats training frames: the picture does not change")
    repeated = find_repeats(clip.rgb, train, judged)
    if len(repeated) == len(train):
        return _nothing_held_out(clip, "every training frame repeats a held-out one: the picture does not change")
    train = [index for index in train if index not in repeated]
    weights = frame_weights(clip, sorted({*train, *judged}), train)
    sharp = [index for index in judged if index not in weights] or judged
    unscored = sorted(set(judged) - set(sharp))
    return FrameSplit(
        train,
        held_out=sharp,
        repeated=sorted({*repeated, *paused, *clip.skipped, *unscored}),
        warnings=(*_warnings(len(repeated), len(paused)), *_blur_warnings(weights, unscored, count)),
        weights={index: weight for index, weight in weights.items() if index in set(train)},
    )


def held_out_frames(frame_count: int, holdout: str) -> list[int]:
    """The held-out frames of split_frames, rising, before its check for repeats. It reads no picture.

    Stages before the split use it to avoid these frames. InputError as in split_frames.
    """
    wanted = _held_out_by_rule(holdout, frame_count)
    return sorted(wanted) if frame_count >= MIN_FRAMES else []


def training_frames(frame_count: int, holdout: str) -> list[int]:
    """The frames that are not held out, rising, including repeats of held-out frames. InputError as in split_frames."""
    held_out = set(held_out_frames(frame_count, holdout))
    return [index for index in range(frame_count) if index not in held_out]


def check_holdout(holdout: str) -> None:
    """Check that holdout is a rule of split_frames or a list of frames, whatever the clip.

    Raises:
        InputError: it is neither.
    """
    if holdout not in RULES and not re.fullmatch(r"\s*\d+\s*(,\s*\d+\s*)*", holdout):
        raise InputError(_FIELD, f"{holdout!r} is not known.", _REMEDY)


def spread(indices: Sequence[int], count: int) -> list[int]:
    """At most `count` of the indices, evenly spread, the first and the last included."""
    places = np.unique(np.linspace(0, len(indices) - 1, min(count, len(indices))).round().astype(int))
    return [indices[place] for place in places]


def find_repeats(rgb: NDArray[np.uint8], train: list[int], held_out: list[int]) -> list[int]:
    """Training frames of rgb [T, H, W, 3] whose mean |difference| to some held-out frame is below REPEAT_LEVELS of 255.

    Differences of column sums are a lower bound of the mean difference (triangle inequality). Whole frames are compared
    only if the bound does not rule a repeat out.
    """
    values_per_frame = float(np.prod(rgb.shape[1:]))
    limit = REPEAT_LEVELS * values_per_frame
    column_sums = {}
    for index in (*train, *held_out):
        column_sums[index] = _column_sums(rgb[index])
        let_go(rgb[index])
    held_out_sums = np.stack([column_sums[index] for index in held_out])
    repeats = []
    for index in train:
        bounds = np.abs(held_out_sums - column_sums[index]).sum(axis=1)
        candidates = [held_out[k] for k in np.flatnonzero(bounds < limit)]
        if any(_closer_than(limit, rgb[index], rgb[other]) for other in candidates):
            repeats.append(index)
    return repeats


def find_paused(rgb: NDArray[np.uint8], held_out: Sequence[int]) -> set[int]:
    """Held-out frames of rgb [T, H, W, 3] in a pause that also has training frames.

    A pause is a run of more than PAUSE_FRAMES frames that repeat its first.
    """
    limit, found, start = REPEAT_LEVELS * float(np.prod(rgb.shape[1:])), set[int](), 0
    for index in range(1, len(rgb) + 1):
        if index < len(rgb) and _closer_than(limit, rgb[start], rgb[index]):
            let_go(rgb[index])
            continue
        within = set(range(start, index)) & set(held_out)
        if index - start > max(PAUSE_FRAMES, len(within)):
            found |= within
        let_go(rgb[start])
        start = index
    return found


def _closer_than(limit: float, frame: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Whether the sum of |differences| is below the limit. Every 8th row is tried first, which often suffices."""
    return all(cv2.norm(frame[::step], other[::step], cv2.NORM_L1) < limit for step in (8, 1))


def _column_sums(frame: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Sum over the rows of a frame [H, W, 3], flattened to [3 W]."""
    return np.asarray(cv2.reduce(frame, 0, cv2.REDUCE_SUM, dtype=cv2.CV_32S), dtype=np.int64).ravel()


def _held_out_by_rule(holdout: str, count: int) -> set[int]:
    check_holdout(holdout)
    if holdout == "none":
        return set()
    if holdout == "every8":
        return {index for index in range(count) if (index - 1) % 8 == 0}
    if holdout == "blocks8":
        return {index for index in range(8, count - 8) if (index // 8) % 3 == 1}
    wanted = {int(number) for number in holdout.split(",")}
    if max(wanted) >= count:
        raise InputError(_FIELD, f"frame {max(wanted)} is not in a clip of {count} frames.", f"Use 0 to {count - 1}.")
    if len(wanted) == count:
        raise InputError(_FIELD, f"all {count} frames are held out.", "Leave frames to train on.")
    return wanted


def _warnings(repeated: int, paused: int) -> tuple[Notice, ...]:
    texts = []
    if repeated:
        texts.append(f"frames that repeat a held-out frame are not used: {repeated}")
    if paused:
        texts.append(f"held-out frames of a paused picture, on which the scene is trained, are not scored: {paused}")
    return tuple(Notice.warning(NoticeCode.HELD_OUT_REPEATED, text) for text in texts)


def _blur_warnings(weights: Mapping[int, float], unscored: Sequence[int], frame_count: int) -> tuple[Notice, ...]:
    if not weights:
        return ()
    text = (
        f"frames are blurred beside those around them: {named_frames(sorted(weights))} ({len(weights)} of "
        f"{frame_count:,}); training draws them less often or not at all"
    )
    text += f", and the {len(unscored)} held-out ones among them are not scored" if unscored else ""
    return (Notice.warning(NoticeCode.BLURRED_FRAMES, text),)


def _nothing_held_out(clip: DepthClip, reason: str) -> FrameSplit:
    text = f"no frames are held out, so quality is not measured: {reason}"
    skipped = set(clip.skipped)
    train = [index for index in range(clip.frame_count) if index not in skipped]
    weights = frame_weights(clip, train, train)
    warnings = (Notice.warning(NoticeCode.NOTHING_HELD_OUT, text), *_blur_warnings(weights, (), clip.frame_count))
    return FrameSplit(train, [], list(clip.skipped), warnings, weights)
