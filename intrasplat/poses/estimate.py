"""The camera's path, estimated from a stereo clip.

Training frames alone determine the path and the tissue's motion. Every other frame, held-out frames included, is
aligned by itself with the fitted frames and changes nothing else.

Symbols: T frames of the clip, K frames that are fitted together, S time courses of the tissue's deformation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np

from intrasplat.clip import DepthClip, spread
from intrasplat.machine.hooks import ignore
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.machine.pool import thread_a_core
from intrasplat.poses.beside import Beside, place_beside
from intrasplat.poses.certainty import aligned_sigma, by_place_and_turn
from intrasplat.poses.chain import MIN_AGREEING, chained, tied
from intrasplat.poses.common_motion import RIGID_PER_BENT, Gauged, gauged
from intrasplat.poses.fitting import Fit, fitted
from intrasplat.poses.links import FrameLink, Frames
from intrasplat.poses.rigid import Reals, between, inverse, log

MAX_FITTED = 128
"""Most frames that are fitted together; in a longer clip the others are aligned with them one by one."""
CHAINING, FITTING = 0.45, 0.45
"""Shares of the progress."""
MOVED_MM, MOVED_DEG = 1.2, 0.6
"""A camera whose root mean square about its mean is smaller counts as fixed."""
UNSURE_MM, UNSURE_DEG = 1.25, 1.0
"""Beyond these standard deviations, motion of camera and tissue may have been confused."""
LARGE_MM, LARGE_DEG = 12.0, 6.0
"""Without a time course of the deformation, motion up to these sizes may be the tissue's alone."""


@dataclass(frozen=True, eq=False)
class FoundPath:
    """The camera's path.

    world_from_camera  [T, 4, 4] mm; the world is the camera of the first frame that is fitted
    sigma_mm, sigma_deg  expected error (standard deviation) after one rigid motion aligns the path with the true one
    alone_mm, alone_deg  root mean square of the path without the part that follows the tissue's time courses
    extent_mm, extent_deg  largest distance and angle between two cameras; path_mm: length of the path
    spread_mm, spread_deg  root mean square about the mean
    rigid_fit_mm  median distance between the fit's prediction and the tissue, where tissue moves as fitted
    tissue_mm   root mean square of the rigid motion that was assigned to the tissue
    period_frames  period of the tissue's motion; None: no period was found
    unsure      frames whose pose is unreliable
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

    @property
    def confused(self) -> bool:
        """Whether the tissue's motion may have been taken for the camera's, or the camera's for the tissue's."""
        return self.sigma_mm > UNSURE_MM or self.sigma_deg > UNSURE_DEG

    @property
    def moves(self) -> bool:
        """Whether the camera certainly moved."""
        large = self.extent_mm > LARGE_MM or self.extent_deg > LARGE_DEG
        return self.seems_to_move and (self.period_frames is not None or large or not self.confused)

    @property
    def seems_to_move(self) -> bool:
        """Whether camera or tissue moved as a whole."""
        sure = self.spread_mm > max(MOVED_MM, 2 * self.sigma_mm), self.spread_deg > max(MOVED_DEG, 2 * self.sigma_deg)
        return any(sure) or self.alone_mm > MOVED_MM or self.alone_deg > MOVED_DEG


def find_path(clip: DepthClip, train: Sequence[int], on_progress: Callable[[float], None] = ignore) -> FoundPath:
    """The path of the clip's camera.

    Args:
        train: the frames, rising, that determine the path. All others are aligned with them.
        on_progress: gets the share done.
    """
    with one_opencv_thread(), thread_a_core("poses") as pool:
        return _found(clip, train, pool, on_progress)


def _found(
    clip: DepthClip, train: Sequence[int], pool: ThreadPoolExecutor, on_progress: Callable[[float], None]
) -> FoundPath:
    frames = Frames(clip)
    followed = spread(train, MAX_FITTED)
    list(pool.map(frames.frame, followed))
    chain = chained(frames, followed, pool, lambda share: on_progress(CHAINING * share))
    if not chain.links:
        return _unknown(clip.frame_count)
    used = chain.frames
    fit = fitted(frames.camera, chain, clip.frame_s, pool, lambda share: on_progress(CHAINING + FITTING * share))
    on_progress(CHAINING + FITTING)
    others = sorted(set(range(clip.frame_count)) - set(used) - set(clip.skipped))

    def beside(i: int) -> Beside:
        placed = place_beside(frames, used, fit, i)
        frames.forget(i)
        return placed

    placed = pool.map(beside, others)
    t = np.asarray(used, np.float64)
    k = clip.intrinsics
    half_mm = fit.middle_mm[2] * k.width / k.fx / 2
    gauge = gauged(fit.poses, t, fit.field.courses, fit.field.sizes_mm(float(fit.middle_mm[2])), fit.middle_mm, half_mm)
    path = np.tile(np.eye(4), (clip.frame_count, 1, 1))
    path[list(used)] = gauge.poses
    unsure = _apart(used, fit, chain.links)
    for done, (i, each) in enumerate(zip(others, placed, strict=True)):
        path[i] = gauge.tissue_at(each.course) @ each.pose
        unsure += [i] if each.share < MIN_AGREEING else []
        on_progress(1 - (1 - CHAINING - FITTING) * (1 - done / len(others)))
    known = sorted({*used, *others})
    for i in clip.skipped:
        path[i] = between(known, path[known], i)
    return _found_path(path, used, fit, gauge, half_mm, frames, unsure)


def _unknown(count: int) -> FoundPath:
    """The result where no two frames show the same tissue: a camera at rest, no frame reliable."""
    still = np.tile(np.eye(4), (count, 1, 1))
    nothing = dict.fromkeys((each.name for each in fields(FoundPath) if each.type == "float"), 0.0)
    return FoundPath(still, period_frames=None, unsure=tuple(range(count)), **nothing)


def _apart(used: Sequence[int], fit: Fit, links: Sequence[FrameLink]) -> list[int]:
    """Frames outside the largest connected component. Only links that find enough tissue as the fit expects count."""
    found = [
        link for link, residual_px in zip(links, fit.residual_px, strict=True)
        if link.agreeing(residual_px) >= MIN_AGREEING
    ]  # fmt: skip
    return sorted(set(used) - set(tied(used, found)))


def _found_path(
    path: Reals, used: Sequence[int], fit: Fit, gauge: Gauged, half_mm: float, frames: Frames, unsure: Sequence[int]
) -> FoundPath:
    mine = path[list(used)]
    places = mine[:, :3, 3]
    turns = np.degrees([log(inverse(mine[0]) @ each)[3:] for each in mine])
    residual, weight = np.concatenate(fit.residual_px), np.concatenate(fit.weight)
    px = float(np.median(residual[weight > 0.25])) if (weight > 0.25).any() else float("inf")
    twists = np.stack([log(each) for each in gauge.tissue])
    shifts = twists[:, :3] + np.cross(twists[:, 3:], fit.middle_mm)
    sure = [k for k, index in enumerate(used) if index not in unsure]
    sigma_mm, sigma_deg = _sigma(fit, gauge, half_mm, sure)
    return FoundPath(
        world_from_camera=path,
        sigma_mm=sigma_mm,
        sigma_deg=sigma_deg,
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
    )


def _sigma(fit: Fit, gauge: Gauged, half_mm: float, sure: Sequence[int]) -> tuple[float, float]:
    """Expected error (mm, degrees) of the reliable frames: from the links' noise and from the split of common motion.

    If no time course explains the deformation, the tissue's rigid motion cannot be separated from the camera's. Its
    usual size for such a deformation is then added.
    """
    covariance = by_place_and_turn(fit.grams.covariance(fit.field), fit.poses) + gauge.covariance
    mm, deg = aligned_sigma(covariance, fit.poses, sure)
    if fit.field.period is None:
        common_mm = RIGID_PER_BENT * np.sqrt(3) * fit.grams.bent_mm(fit.field, float(fit.middle_mm[2]))
        mm, deg = np.hypot(mm, common_mm), np.hypot(deg, np.degrees(common_mm / half_mm))
    return float(mm), float(deg)


def _alone(values: Reals, courses: Reals) -> float:
    """Root mean square of values [K, 3] after regression on the tissue's courses [K, S]."""
    known = np.concatenate([np.ones((len(values), 1)), courses], axis=1)
    rest = values - known @ np.linalg.lstsq(known, values, rcond=None)[0]
    return float(np.sqrt(np.square(rest).sum(1).mean()))


def _extent(values: Reals) -> float:
    """The largest distance between two of the values [K, 3]."""
    return float(max(np.linalg.norm(values - each, axis=1).max() for each in values))
