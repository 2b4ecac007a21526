"""The camera's path, estimated from a stereo clip.

Training frames alone decide on the path and on what the tissue does. Any other frame, a held-out one above all, gets
its pose from its own picture against them, one by one, and changes nothing else.

Symbols: T frames of the clip, K frames that are fitted together, S courses of the tissue's deformation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np

from worker.input.clip import DepthClip, spread
from worker.machine.opencv import one_opencv_thread
from worker.poses.chain import chained
from worker.poses.fitting import Fit, fitted
from worker.poses.gauge import Gauged, gauged
from worker.poses.links import Frames, Link
from worker.poses.rigid import Reals, align, exp, inverse, log

MAX_FITTED = 128
"""Frames that are fitted together; in a longer clip the others are placed between them."""
CHAINING, FITTING = 0.45, 0.45
"""Shares of the progress."""
AGREES_PX, MIN_AGREEING, GOOD = 1.5, 0.15, 0.4
"""A frame is sure if such a share of a keyframe's tissue is found in it this near to where the fit expects it.
A frame that is placed asks no second one with the last share."""
MOVED_MM, MOVED_DEG = 1.2, 0.6
"""Root mean square about its mean below which a camera counts as fixed."""
MAX_DEFORMED_PX, LARGE_MM, LARGE_DEG = 0.6, 12.0, 6.0
"""Without a course to go by, tissue that deforms by more than this may be all that moves, up to these sizes."""


@dataclass(frozen=True, eq=False)
class FoundPath:
    """The camera's path.

    world_from_camera  [T, 4, 4] mm; the world is the first training frame's camera
    sigma_mm, sigma_deg  typical standard deviation
    alone_mm, alone_deg  the same without what follows the tissue's courses
    extent_mm, extent_deg  largest distance and angle between two cameras; path_mm: length of the path
    spread_mm, spread_deg  root mean square about the mean
    rigid_fit_mm  median distance by which tissue that moves as the fit says misses its place
    tissue_mm   root mean square of the common motion that was given to the tissue
    period_frames  of the tissue's motion, or None
    unsure      frames whose pose is not to be relied on
    told_apart  False: tissue deforms, and the clip is too short to tell its motion from the camera's
    """

    world_from_camera: Reals
    sigma_mm: float
    sigma_deg: float
    path_mm: float
    extent_mm: float
    extent_deg: float
    spread_mm: float
    spread_deg: float
    alone_mm: float
    alone_deg: float
    rigid_fit_mm: float
    tissue_mm: float
    period_frames: float | None
    unsure: tuple[int, ...]
    told_apart: bool

    @property
    def moves(self) -> bool:
        """Whether the camera moved, beyond doubt."""
        large = self.extent_mm > LARGE_MM or self.extent_deg > LARGE_DEG
        return self.seems_to_move and (self.told_apart or large)

    @property
    def seems_to_move(self) -> bool:
        """Whether camera or tissue moved as a whole."""
        sure = self.spread_mm > max(MOVED_MM, 2 * self.sigma_mm), self.spread_deg > max(MOVED_DEG, 2 * self.sigma_deg)
        return any(sure) or self.alone_mm > MOVED_MM or self.alone_deg > MOVED_DEG


def find_path(
    clip: DepthClip, train: Sequence[int], on_progress: Callable[[float], None] = lambda share: None
) -> FoundPath:
    """The path of the clip's camera.

    Args:
        train: rising; the frames that decide. All others are placed against them.
    """
    with one_opencv_thread():
        return _found(clip, train, on_progress)


def _found(clip: DepthClip, train: Sequence[int], on_progress: Callable[[float], None]) -> FoundPath:
    frames = Frames(clip)
    used = spread(train, MAX_FITTED)
    chain = chained(frames, used, lambda share: on_progress(CHAINING * share))
    if not chain.links:
        return _unknown(clip.frame_count)
    fit = fitted(frames.camera, chain, lambda share: on_progress(CHAINING + FITTING * share))
    on_progress(CHAINING + FITTING)
    t = np.asarray(used, np.float64)
    k = clip.intrinsics
    half_mm = fit.middle_mm[2] * k.width / k.fx / 2
    gauge = gauged(fit.poses, t, fit.field.courses, fit.field.sizes_mm(float(fit.middle_mm[2])), fit.middle_mm, half_mm)
    path = np.tile(np.eye(4), (clip.frame_count, 1, 1))
    path[list(used)] = gauge.poses
    agreeing = _agreeing(fit, chain.links)
    unsure = [i for i in used[1:] if agreeing.get(i, 0.0) < MIN_AGREEING]
    others = sorted(set(range(clip.frame_count)) - set(used) - set(clip.left_out))
    for done, i in enumerate(others):
        pose, share = _placed(frames, used, fit, gauge, i)
        path[i] = pose
        frames.forget(i)
        unsure += [i] if share < MIN_AGREEING else []
        on_progress(1 - (1 - CHAINING - FITTING) * (1 - done / len(others)))
    _fill(path, sorted({*used, *others}), clip.left_out)
    return _told(path, used, fit, gauge, frames, unsure)


def _unknown(count: int) -> FoundPath:
    """No path: no two frames show the same tissue."""
    still = np.tile(np.eye(4), (count, 1, 1))
    nothing = dict.fromkeys((each.name for each in fields(FoundPath) if each.type == "float"), 0.0)
    return FoundPath(still, period_frames=None, unsure=tuple(range(count)), told_apart=False, **nothing)


def _agreeing(fit: Fit, links: Sequence[Link]) -> dict[int, float]:
    """For each frame, the largest share of a keyframe's tissue that a link finds where the fit expects it."""
    found: dict[int, float] = {}
    for link, residual in zip(links, fit.residual_px, strict=True):
        share = link.overlap * float(np.mean(residual < AGREES_PX)) if len(residual) else 0.0
        for end in (link.a, link.b):
            found[end] = max(found.get(end, 0.0), share)
    return found


def _placed(frames: Frames, used: Sequence[int], fit: Fit, gauge: Gauged, index: int) -> tuple[Reals, float]:
    """A frame's camera, from its own picture against the nearest fitted frames; the share that agrees."""
    course = fit.field.course_at(index, used)
    found = []
    for number in np.argsort(np.abs(np.asarray(used) - index), kind="stable")[:2]:
        link = frames.link(used[number], index)
        pose = fit.poses[number]
        points = frames.camera.points_mm(link.before)
        world = points @ pose[:3, :3].T + pose[:3, 3]
        moved = world + fit.field.displacement(world, course - fit.field.courses[number])
        seen = frames.camera.seen((moved - pose[:3, 3]) @ pose[:3, :3])  # as that frame would see it
        aligned = align(frames.camera, seen, link.after, link.trust, np.eye(4))
        share = link.overlap * float(np.mean(aligned.residual_px < AGREES_PX)) if len(link.cells) else 0.0
        found.append((share, gauge.tissue_at(course) @ pose @ inverse(aligned.motion)))
        if share > GOOD:
            break
    share, pose = max(found, key=lambda each: each[0])
    return pose, share


def _fill(path: Reals, known: Sequence[int], left_out: Sequence[int]) -> None:
    """Give frames that nobody looks at poses between their neighbours'."""
    for i in left_out:
        before = max((each for each in known if each < i), default=None)
        after = min((each for each in known if each > i), default=None)
        if before is None or after is None:
            path[i] = path[after if before is None else before]
            continue
        step = log(path[after] @ inverse(path[before]))
        path[i] = exp(step * (i - before) / (after - before)) @ path[before]


def _told(
    path: Reals, used: Sequence[int], fit: Fit, gauge: Gauged, frames: Frames, unsure: Sequence[int]
) -> FoundPath:
    mine = path[list(used)]
    places = mine[:, :3, 3]
    turns = np.degrees([log(inverse(mine[0]) @ each)[3:] for each in mine])
    residual, weight = np.concatenate(fit.residual_px), np.concatenate(fit.weight)
    px = float(np.median(residual[weight > 0.25])) if (weight > 0.25).any() else float("inf")
    deformed_px = float(np.median(residual))
    twists = np.stack([log(each) for each in gauge.tissue])
    shifts = twists[:, :3] + np.cross(twists[:, 3:], fit.middle_mm)
    sigma = np.sqrt(np.square(gauge.sigma).mean(0))
    return FoundPath(
        world_from_camera=path,
        sigma_mm=float(np.linalg.norm(sigma[:3])),
        sigma_deg=float(np.degrees(np.linalg.norm(sigma[3:]))),
        path_mm=float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()),
        extent_mm=_extent(places),
        extent_deg=_extent(turns),
        spread_mm=float(np.sqrt(np.square(places - places.mean(0)).sum(1).mean())),
        spread_deg=float(np.sqrt(np.square(turns - turns.mean(0)).sum(1).mean())),
        alone_mm=_alone(places, fit.field.courses),
        alone_deg=_alone(turns, fit.field.courses),
        rigid_fit_mm=px * float(fit.middle_mm[2]) / frames.camera.fx,
        tissue_mm=float(np.sqrt(np.square(shifts - shifts.mean(0)).sum(1).mean())),
        period_frames=fit.field.period,
        unsure=tuple(sorted(unsure)),
        told_apart=fit.field.period is not None or deformed_px < MAX_DEFORMED_PX,
    )


def _alone(values: Reals, courses: Reals) -> float:
    """Root mean square of [K, 3] without what follows the tissue's courses [K, S]."""
    known = np.concatenate([np.ones((len(values), 1)), courses], axis=1)
    rest = values - known @ np.linalg.lstsq(known, values, rcond=None)[0]
    return float(np.sqrt(np.square(rest).sum(1).mean()))


def _extent(values: Reals) -> float:
    """The largest distance between two of [K, 3]."""
    return float(max(np.linalg.norm(values - each, axis=1).max() for each in values))
