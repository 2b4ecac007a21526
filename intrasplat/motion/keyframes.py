"""Keyframes: training frames whose views together cover the clip, and the tracks that start in them.

A clip of a fixed camera has one keyframe, the first training frame. If the camera moves on, tissue that comes into view
is tracked from the keyframe that shows it, through the frames that see enough of that keyframe.

Symbols: K training frames, M sampled pixels of a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import to_camera, unproject
from intrasplat.clip import DepthClip
from intrasplat.motion.tracks import Tracks, track

Reals = NDArray[np.float64]

SAMPLE_SHARE = 1 / 32
"""Distance between sampled pixels, as a share of the image's width."""
MAX_NEW_SHARE = 0.5
"""A frame becomes a keyframe if more than this share of its tissue lies in no earlier keyframe's view."""
MAX_NEARER = 1.3
"""A keyframe counts as showing tissue up to this multiple of the frame's distance from it."""
MIN_OVERLAP = 0.2
"""A keyframe is tracked to the frames that show at least this share of its tissue."""


def keyframes(clip: DepthClip, train: Sequence[int], blurred: Collection[int] = ()) -> list[tuple[int, list[int]]]:
    """Indices (into `train`) of the keyframes, each with the indices of the frames to which it is tracked.

    The tissue is taken as at rest. Keyframes that show it from nearby come first, else the earlier ones. The frames of
    `train` that are `blurred` become no keyframes, unless all are.
    """
    sharp = [place for place, index in enumerate(train) if index not in blurred] or list(range(len(train)))
    poses = clip.world_from_camera[list(train)]
    if (poses == poses[0]).all():
        return [(sharp[0], list(range(len(train))))]
    seen_mm = [_tissue_mm(clip, index) for index in train]
    keys = list[int]()
    for place in sharp:
        points_mm = seen_mm[place]
        if not len(points_mm):
            continue
        depth_mm = to_camera(points_mm, poses[place])[:, 2]
        found = [_depth_in_view(clip, points_mm, poses[key]) for key in keys]
        known = np.any([depth <= MAX_NEARER * depth_mm for depth in found], axis=0)
        if not keys or known.mean() < 1 - MAX_NEW_SHARE:
            keys.append(place)
    if not keys:  # no sampled pixel has a depth
        return [(sharp[0], list(range(len(train))))]
    near_mm = {key: np.median(to_camera(seen_mm[key], poses[key])[:, 2]) for key in keys}
    least_mm = min(near_mm.values())
    keys.sort(key=lambda key: int(np.log(near_mm[key] / least_mm) / np.log(MAX_NEARER)))
    followed = []
    for key in keys:
        shares = [np.isfinite(_depth_in_view(clip, seen_mm[key], pose)).mean() for pose in poses]
        followed.append((key, [place for place, share in enumerate(shares) if share >= MIN_OVERLAP or place == key]))
    return followed


def track_keyframes(
    clip: DepthClip,
    train: Sequence[int],
    on_progress: Callable[[float], None] = lambda share: None,
    blurred: Collection[int] = (),
) -> list[Tracks]:
    """The tracks of each keyframe. on_progress is called as by `track`; blurred: as for `keyframes`."""
    followed, tracks = keyframes(clip, train, blurred), list[Tracks]()
    total, done = sum(len(places) for _, places in followed), 0
    for key, places in followed:
        share, before = len(places) / total, done / total

        def report(part: float, share: float = share, before: float = before) -> None:
            on_progress(before + share * part)

        tracks.append(track(clip, train, report, reference=key, places=places))
        done += len(places)
    return tracks


def _tissue_mm(clip: DepthClip, index: int) -> Reals:
    """Sampled tissue points [M, 3] of a frame where its depth is measured, world frame, mm."""
    height, width = clip.tissue.shape[1:]
    step = max(1, round(width * SAMPLE_SHARE))
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step].reshape(2, -1)
    depth_mm = clip.depth_mm[index][rows, columns]
    measured = clip.tissue[index][rows, columns] & (depth_mm > 0)
    clip.let_go(index)
    pixels = (rows * width + columns)[measured]
    return unproject(pixels, depth_mm[measured], clip.intrinsics, clip.world_from_camera[index])


def _depth_in_view(clip: DepthClip, points_mm: Reals, world_from_camera: Reals) -> Reals:
    """Camera z [M], mm, of points within a camera's image; infinity for points outside."""
    k, (x, y, z) = clip.intrinsics, to_camera(points_mm, world_from_camera).T
    ahead = np.maximum(z, 1e-6)
    column, row = k.fx * x / ahead + k.cx, k.fy * y / ahead + k.cy
    inside = (z > 0) & (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height)
    return np.asarray(np.where(inside, z, np.inf))
