"""Keyframes, links between frames, and an initial estimate of every camera from them.

A keyframe is followed while most of it stays in view. The next keyframe starts where less than KEY_OVERLAP of it is
visible. Each frame is linked to the keyframe before it and to the one after it. Loop closure: keyframes that show the
same tissue at other times are linked, too, so that a camera that returns gets the same pose again.

Where optical flow loses the tissue, between stills or after a jump, features place the frame (wide.py). Frames that
nothing ties to the largest set of linked frames are left out of the chain.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from intrasplat.clip import spread
from intrasplat.machine.hooks import ignore
from intrasplat.poses.links import FrameLink, Frames
from intrasplat.poses.rigid import Reals, align, exp, inverse, log

KEY_OVERLAP = 0.6
KEY_FRAMES = 16
"""Most frames between keyframes, so that the depth noise of one frame does not enter all poses."""
LOOP_OVERLAP, MIN_OVERLAP = 0.5, 0.25
"""Minimum predicted overlap of two keyframes for a loop link; minimum measured overlap of any link."""
MIN_AGREEING = 0.15
"""Minimum share of a frame's tissue that is found where the poses expect it: below it, a link ties nothing."""
MAX_LOOKS, MAX_LOOPS = 32, 64
"""Most keyframes among which loop pairs are searched, and most links between them."""
PART_LOOKS = 8
"""Most frames of a part that are matched with those of other parts."""


@dataclass(frozen=True, eq=False)
class Chain:
    """Linked frames, and their camera poses under the assumption that all tissue is rigid.

    frames             [K]       indices in the clip, rising: the largest set that links tie together
    world_from_camera  [K, 4, 4] mm; the world is the first one's camera
    links                        a and b are indices in the clip
    """

    frames: Sequence[int]
    world_from_camera: Reals
    links: list[FrameLink]


def chained(
    frames: Frames, train: Sequence[int], pool: ThreadPoolExecutor, on_progress: Callable[[float], None] = ignore
) -> Chain:
    """Follow the training frames, link by link. Links that no pose depends on are left to the pool."""
    poses, links, keys = {train[0]: np.eye(4)}, list[FrameLink](), [train[0]]
    behind = list[Future[list[FrameLink]]]()
    parts = [[train[0]]]
    flow = None

    def linked(i: int, last: int) -> tuple[FrameLink, float]:
        """Link the current keyframe to frame i, which sets i's pose; also the share of the keyframe that agrees."""
        key, start = keys[-1], inverse(_ahead(poses, parts[-1], i)) @ poses[keys[-1]]
        link = frames.link(key, i, frames.predicted(key, start)[0] if flow is None else flow)
        aligned = align(frames.camera, link.before, link.after, link.trust, start)
        poses[i] = poses[key] @ inverse(aligned.motion)
        return link, link.agreeing(aligned.residual_px)

    def turn_to(i: int) -> None:
        """Make frame i the current keyframe."""
        behind.append(pool.submit(_from_behind, frames, i, [each for each in train if keys[-1] < each < i]))
        keys.append(i)

    for last, i in pairwise(train):
        link, share = linked(i, last)
        if share < MIN_OVERLAP and keys[-1] != last:  # most was lost: the last frame shows more of it
            turn_to(last)
            flow = None
            link, share = linked(i, last)
        if share < MIN_OVERLAP and (far := frames.far_motion(keys[-1], i)) is not None:
            far_link, aligned = frames.far_link(keys[-1], i, far)
            if (far_share := far_link.agreeing(aligned.residual_px)) > share:
                link, share, poses[i] = far_link, far_share, poses[keys[-1]] @ inverse(aligned.motion)
        on_progress(train.index(i) / (len(train) - 1))
        if share < MIN_AGREEING:
            poses[i] = poses[last]
            keys.append(i)
            parts.append([i])
            flow = None
            continue
        parts[-1].append(i)
        links.append(link)
        flow = link.flow
        if link.overlap < KEY_OVERLAP or train.index(i) - train.index(keys[-1]) == KEY_FRAMES:
            turn_to(i)
            flow = None
    links += [link for job in behind for link in job.result()]
    if len(parts) > 1:
        links += _joined(frames, parts, poses)
        main: list[int] = max(parts, key=len)
        train = sorted(main)
        keys = [key for key in keys if key in train]
        links = [link for link in links if link.a in train and link.b in train]
    links = [link for link in (*links, *_loops(frames, keys, poses, pool)) if link.overlap >= MIN_OVERLAP]
    train = tied(train, links)
    links = [link for link in links if link.a in train]
    return Chain(train, np.stack([inverse(poses[train[0]]) @ poses[i] for i in train]), links)


def tied(frames: Sequence[int], links: Sequence[FrameLink]) -> list[int]:
    """The largest set of these frames that links between them tie together, in their order."""
    places = {frame: place for place, frame in enumerate(frames)}
    ends = np.array([(places[link.a], places[link.b]) for link in links], np.intp).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), ends.T), shape=(len(frames), len(frames)))
    _, part = connected_components(graph, directed=False)
    largest = np.bincount(part).argmax()
    return [frame for frame, each in zip(frames, part, strict=True) if each == largest]


def _joined(frames: Frames, parts: list[list[int]], poses: dict[int, Reals]) -> list[FrameLink]:
    """Links between parts that show common tissue. The parts become one in parts, and in poses."""
    looks, links = dict[int, list[int]](), list[FrameLink]()
    for number in sorted(range(len(parts)), key=lambda each: -len(parts[each])):
        left = MAX_LOOKS - sum(map(len, looks.values()))
        looks[number] = list(spread(parts[number], min(PART_LOOKS, left))) if left else []
    pairs = [(a, b) for one, other in combinations(looks.values(), 2) for a in one for b in other]
    found = {pair: far for pair in pairs if (far := frames.far_motion(*pair)) is not None}
    for a, b in sorted(found, key=lambda pair: -len(found[pair].before))[:MAX_LOOPS]:
        link, aligned = frames.far_link(a, b, found[a, b])
        if link.agreeing(aligned.residual_px) < MIN_AGREEING:
            continue
        links.append(link)
        one, other = (next(part for part in parts if each in part) for each in (a, b))
        if one is not other:
            moved = poses[a] @ inverse(aligned.motion) @ inverse(poses[b])
            poses.update({i: moved @ poses[i] for i in other})
            one += other
            parts.remove(other)
    return links


def _ahead(poses: dict[int, Reals], part: Sequence[int], index: int) -> Reals:
    """The camera pose in a later frame, extrapolated at constant velocity from the last two frames of a part."""
    if len(part) < 2:
        return poses[part[-1]]
    before, last = part[-2:]
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


def _loops(frames: Frames, keys: Sequence[int], poses: dict[int, Reals], pool: ThreadPoolExecutor) -> list[FrameLink]:
    """Links between non-adjacent keyframes that see the same tissue, those of the largest predicted overlap."""
    some = spread(keys, MAX_LOOKS)
    pairs = [(a, b) for later, b in enumerate(some) for a in some[:later] if keys.index(b) - keys.index(a) > 1]
    shares = {(a, b): frames.predicted(a, inverse(poses[b]) @ poses[a])[1] for a, b in pairs}
    chosen = sorted((pair for pair in pairs if shares[pair] > LOOP_OVERLAP), key=lambda pair: -shares[pair])

    def linked(pair: tuple[int, int]) -> FrameLink:
        a, b = pair
        return frames.link(a, b, frames.predicted(a, inverse(poses[b]) @ poses[a])[0])

    return list(pool.map(linked, sorted(chosen[:MAX_LOOPS], key=pairs.index)))
