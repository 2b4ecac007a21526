"""Keyframes, links between frames, and an initial estimate of every camera from them.

A keyframe is followed while most of it stays in view. The next keyframe starts where less than KEY_OVERLAP of it is
visible. Each frame is linked to the keyframe before it and to the one after it. Loop closure: keyframes that show the
same tissue at other times are linked, too, so that a camera that returns gets the same pose again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from intrasplat.clip import spread
from intrasplat.poses.links import FrameLink, Frames
from intrasplat.poses.rigid import Reals, align, exp, inverse, log

KEY_OVERLAP = 0.6
KEY_FRAMES = 16
"""Most frames between keyframes, so that the depth noise of one frame does not enter all poses."""
LOOP_OVERLAP, MIN_OVERLAP = 0.5, 0.25
"""Minimum predicted overlap of two keyframes for a loop link; minimum measured overlap of any link."""

MAX_LOOKS, MAX_LOOPS = 32, 64
"""Most keyframes among which loop pairs are searched, and most links between them."""


@dataclass(frozen=True, eq=False)
class Chain:
    """Linked frames, and their camera poses under the assumption that all tissue is rigid.

    frames             [K]       indices in the clip, rising
    world_from_camera  [K, 4, 4] mm; the world is the first one's camera
    links                        a and b are indices in the clip
    """

    frames: Sequence[int]
    world_from_camera: Reals
    links: list[FrameLink]


def chained(frames: Frames, train: Sequence[int], on_progress: Callable[[float], None] = lambda share: None) -> Chain:
    """Follow the training frames, link by link."""
    poses, links, keys = {train[0]: np.eye(4)}, list[FrameLink](), [train[0]]
    flow = None

    def linked(i: int, last: int) -> tuple[FrameLink, float]:
        """Link the current keyframe to frame i, which sets i's pose; also the share of the keyframe that agrees."""
        key, start = keys[-1], inverse(_ahead(poses, last, i)) @ poses[keys[-1]]
        link = frames.link(key, i, frames.predicted(key, start)[0] if flow is None else flow)
        aligned = align(frames.camera, link.before, link.after, link.trust, start)
        poses[i] = poses[key] @ inverse(aligned.motion)
        return link, link.agreeing(aligned.residual_px)

    def turn_to(i: int) -> None:
        """Make frame i the current keyframe."""
        links.extend(_from_behind(frames, i, [each for each in train if keys[-1] < each < i]))
        keys.append(i)

    for last, i in pairwise(train):
        link, share = linked(i, last)
        if share < MIN_OVERLAP and keys[-1] != last:  # most was lost: the last frame shows more of it
            turn_to(last)
            flow = None
            link, _ = linked(i, last)
        links.append(link)
        flow = link.flow
        if link.overlap < KEY_OVERLAP or train.index(i) - train.index(keys[-1]) == KEY_FRAMES:
            turn_to(i)
            flow = None
        on_progress(train.index(i) / (len(train) - 1))
    links += _loops(frames, keys, poses)
    return Chain(train, np.stack([poses[i] for i in train]), [each for each in links if each.overlap >= MIN_OVERLAP])


def _ahead(poses: dict[int, Reals], last: int, index: int) -> Reals:
    """The camera pose in a later frame, extrapolated at constant velocity."""
    before = max((each for each in poses if each < last), default=last)
    if before == last:
        return poses[last]
    step = log(poses[last] @ inverse(poses[before]))
    return exp(step * (index - last) / (last - before)) @ poses[last]


def _from_behind(frames: Frames, key: int, between: Sequence[int]) -> list[FrameLink]:
    """Links from a keyframe back to the frames before it."""
    found, flow = list[FrameLink](), None
    for i in reversed(between):
        link = frames.link(key, i, flow)
        flow = link.flow
        found.append(link)
    return found


def _loops(frames: Frames, keys: Sequence[int], poses: dict[int, Reals]) -> list[FrameLink]:
    """Links between non-adjacent keyframes that see the same tissue, those of the largest predicted overlap."""
    some = spread(keys, MAX_LOOKS)
    pairs = [(a, b) for later, b in enumerate(some) for a in some[:later] if keys.index(b) - keys.index(a) > 1]
    shares = {(a, b): frames.predicted(a, inverse(poses[b]) @ poses[a])[1] for a, b in pairs}
    chosen = sorted((pair for pair in pairs if shares[pair] > LOOP_OVERLAP), key=lambda pair: -shares[pair])
    found = []
    for a, b in sorted(chosen[:MAX_LOOPS], key=pairs.index):
        flow, _ = frames.predicted(a, inverse(poses[b]) @ poses[a])
        found.append(frames.link(a, b, flow))
    return found
