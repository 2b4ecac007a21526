"""Warnings about a lens that is fogged or smeared for long: beside the other eye, and beside other frames.

Symbols: S sampled training frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.sharpness import sharpness_and_contrast
from intrasplat.clip.splashes import falls
from intrasplat.clip.types import DepthClip
from intrasplat.notices import Notice, NoticeCode
from intrasplat.train.scoring import sample_frames

Reals = NDArray[np.float64]

SAMPLED_FRAMES, MIN_FRAMES = 24, 6
MAX_UNLIKE = 0.25
"""Difference of the eyes' logarithms of sharpness or contrast in most frames: 0.07 at most in clean clips, 0.4 where
one is blurred by 2 px of 640, 0.5 where fog takes 40 % of its contrast."""
MAX_FALL, AROUND = 0.3, 3
"""Fall of the logarithm of sharpness in a run of sampled frames beside all others, and where that run starts or ends
beside as many frames: 0.2 at most in clean clips, in which an endoscope advances; 0.32 at a blur of 2 px of 640."""


def lens_warnings(clip: DepthClip, train: Sequence[int]) -> list[Notice]:
    """Warnings about lenses that are less sharp than the other, or for a time; held-out frames are not read."""
    frames = [index for index in sample_frames(train, SAMPLED_FRAMES) if clip.tissue[index].any()]
    eyes = [clip] if clip.right is None else [clip, clip.right]
    measured = np.array([[sharpness_and_contrast(eye, index) for index in frames] for eye in eyes])
    known = np.isfinite(measured).all(axis=(0, 2))
    if known.sum() < MIN_FRAMES:
        return []
    measured, frames = measured[:, known], [index for index, is_known in zip(frames, known, strict=True) if is_known]
    found = _unlike(measured[0] - measured[1], frames) if len(eyes) > 1 else []
    return found + _for_a_time(measured[..., 0].max(axis=0), frames)


def _unlike(left_over_right: Reals, frames: Sequence[int]) -> list[Notice]:
    """left_over_right: [S, 2] logarithms of sharpness and contrast."""
    found = []
    for name, over in zip(("sharpness", "contrast"), left_over_right.T, strict=True):
        worse, better, sign = ("right", "left", 1) if np.median(over) > 0 else ("left", "right", -1)
        unlike = np.flatnonzero(sign * over > MAX_UNLIKE)
        if len(unlike) > len(frames) / 2:
            share, first, last = np.exp(-np.median(sign * over[unlike])), frames[unlike[0]], frames[unlike[-1]]
            where = f"in about frames {first} to {last}"
            found.append(f"{where} the {worse} eye has {share:.0%} of the {better} one's {name}")
    if not found:
        return []
    text = (
        f"One eye is worse than the other: {'; '.join(found)}. Its lens is fogged, smeared or out of focus; stereo and "
        "colours suffer, and other warnings may follow from it."
    )
    return [Notice.warning(NoticeCode.EYES_UNLIKE, text)]


def _for_a_time(sharpness: Reals, frames: Sequence[int]) -> list[Notice]:
    """sharpness: [S] logarithms, of the sharper eye."""
    fall, bounds = falls(sharpness[:, None, None])
    first, end = bounds[:, 0, 0].tolist()
    jumps = [
        abs(float(np.mean(sharpness[max(0, at - AROUND) : at]) - np.mean(sharpness[at : at + AROUND])))
        for at in (first, end)
        if 0 < at < len(frames)
    ]
    if fall[0, 0] < MAX_FALL or max(jumps, default=0.0) < MAX_FALL:
        return []
    text = (
        f"In about frames {frames[first]} to {frames[end - 1]} the picture has {np.exp(-fall[0, 0]):.0%} of the "
        "sharpness that it has in the others: lenses are smeared, fogged or out of focus there, and the scene is as "
        "soft. Leave these frames out."
    )
    return [Notice.warning(NoticeCode.SHARPNESS_CHANGES, text)]
