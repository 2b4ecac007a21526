"""Too few, lost or repeated frames. Symbols: T frames of the clean clip.

The given frame k shows the clean frame source[k] but is trained as if frames were evenly spaced, because a clip has no
other times.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from intrasplat.clip.types import DepthClip
from lab.conditions.clean import CleanClip, Given, given


def few_frames(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """`level` frames, evenly spread over the clip; 1 is its first."""
    del random
    kept = np.unique(np.linspace(0, clean.clip.frame_count - 1, round(level)).round().astype(int)).tolist()
    return dataclasses.replace(given(clean, taken(clean.clip, kept)), source=tuple(kept))


def dropped_frames(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """`level` of the frames, drawn at random, are lost, and the rest follow without gaps."""
    count = clean.clip.frame_count
    lost = random.permutation(np.arange(1, count))[: round(level * count)]
    kept = sorted(set(range(count)) - set(lost.tolist()))
    return dataclasses.replace(given(clean, taken(clean.clip, kept)), source=tuple(kept))


def duplicated_frames(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """`level` of the frames, drawn at random, repeat the one before. Scored against the true frames."""
    shown = np.arange(clean.clip.frame_count)
    for index in sorted(random.permutation(shown[1:])[: round(level * len(shown))]):
        shown[index] = shown[index - 1]
    return given(clean, taken(clean.clip, shown.tolist()))


def taken(clip: DepthClip, frames: Sequence[int]) -> DepthClip:
    """The clip of these frames, in this order, at the clip's own frame rate."""
    index = list(frames)
    return dataclasses.replace(
        clip,
        rgb=clip.rgb[index],
        tissue=clip.tissue[index],
        depth_mm=clip.depth_mm[index],
        depth_confidence=clip.depth_confidence[index],
        world_from_camera=clip.world_from_camera[index],
        frame_times_s=clip.frame_times_s[: len(index)],
    )
