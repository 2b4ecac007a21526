"""The darkening of the picture towards its border, measured along tracks, and frames without it.

Tissue darkens as it leaves the middle of the picture, whatever the camera's exposure.

Symbols: H W pixels, M measured cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip
from intrasplat.motion.exposure import MIN_CELLS, Measured, measured_cells
from intrasplat.motion.lifted import PointGrid
from intrasplat.motion.recoloured import EyeOrClip, recoloured
from intrasplat.motion.tracks import Tracks
from intrasplat.notices import Notice, NoticeCode

Reals = NDArray[np.float64]

MIN_DARKENING = 0.5
"""Least range of the log brightness over the tissue (98 % of it) that is corrected. The phantoms' lamp has 0.15 to 0.4,
which colours that move follow as well."""
MIN_EXPLAINED = 0.6
"""Least share of the tracks' changes, those of whole frames apart, that the angle explains."""
MAX_PAIRS = 32
"""About the most pairs of frames that are measured; it takes 7 ms each."""
PARTS, MAX_PART_ERROR = 4, 0.5
"""The clip's pairs of frames are measured in PARTS, too. No part's power may differ by more than this share of it."""
ROUNDS = 8
"""Iterations of the robust fit."""


@dataclass(frozen=True)
class Vignetting:
    """Recorded values are cos(angle to the optical axis)^power / level of those in even light.

    level is that of the tissue's median, which keeps its brightness.
    """

    power: float
    level: float

    def stored(self) -> list[float]:
        """The numbers as JSON."""
        return [self.power, self.level]

    def brightness(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Factor [...] of recorded values at points [..., 3] in the endoscope's axes, of any length."""
        return np.asarray(np.exp(self.power * log_cosine(points) - np.log(self.level)), np.float32)

    def picture(self, intrinsics: Intrinsics) -> NDArray[np.float32]:
        """The factors [H, W] of an eye's pixels."""
        return self.brightness(rays(intrinsics))

    def border_share(self, intrinsics: Intrinsics, tissue: NDArray[np.bool_]) -> float:
        """The least over the largest factor of the pixels that show tissue [H, W]."""
        shown = self.picture(intrinsics)[tissue]
        return float(shown.min() / shown.max())


def notice_of_border(border_share: float) -> Notice:
    """The report's sentence on the darkening."""
    text = f"light: tissue darkens towards the border to {border_share:.0%}; the model is evenly lit"
    return Notice.info(NoticeCode.VIGNETTING, text)


def rays(intrinsics: Intrinsics, rows: slice = slice(None)) -> Reals:
    """[h, W, 3] points at depth 1 that the pixels of some rows show, camera axes."""
    k = intrinsics
    x, y = (np.arange(k.width) + 0.5 - k.cx) / k.fx, (np.arange(k.height)[rows] + 0.5 - k.cy) / k.fy
    return np.stack([*np.meshgrid(x, y), np.ones((y.size, x.size))], axis=-1)


def log_cosine(points: NDArray[np.floating]) -> Reals:
    """Logarithms [...] of the cosines of the angles between points [..., 3] and the z axis, at least -3."""
    cosine = points[..., 2] / np.maximum(np.linalg.norm(points, axis=-1), 1e-9)
    return np.asarray(np.log(np.maximum(cosine, np.exp(-3.0))), np.float64)


def find_vignetting(clip: DepthClip, train: Sequence[int], tracks: Sequence[Tracks]) -> Vignetting | None:
    """How the picture darkens towards its border; None: little, or too few tracks cross the picture to tell.

    Only training frames are measured.
    """
    pairs = list(_pairs(clip, train, tracks))
    if len(pairs) < PARTS:
        return None
    power, explained = _fit(pairs)
    tissue = clip.tissue[train[0]]
    dark = log_cosine(rays(clip.intrinsics))[tissue]
    if not tissue.any() or power * np.ptp(np.percentile(dark, [1, 99])) < MIN_DARKENING or explained < MIN_EXPLAINED:
        return None
    parts = [_fit(pairs[len(pairs) * part // PARTS : len(pairs) * (part + 1) // PARTS])[0] for part in range(PARTS)]
    if np.abs(np.array(parts) - power).max() > MAX_PART_ERROR * power:
        return None
    return Vignetting(power, float(np.exp(power * np.median(dark))))


def _pairs(clip: DepthClip, train: Sequence[int], tracks: Sequence[Tracks]) -> Iterator[tuple[Reals, Reals]]:
    """Of a keyframe and a frame: changes of the log cosine and of the log brightness [M], less their medians."""
    every = -(-sum(len(each.followed) for each in tracks) // MAX_PAIRS)
    for each in (_thinned(each, every) for each in tracks):
        grid, key = PointGrid(clip, each.step_px), train[each.reference]
        depth_mm = clip.depth_mm[key][grid.step // 2 :: grid.step, grid.step // 2 :: grid.step]
        depth_mm = depth_mm[: grid.size[1], : grid.size[0]]
        pose = clip.world_from_camera[key]
        world_mm = (grid.rays * depth_mm[..., None]) @ pose[:3, :3].T + pose[:3, 3]
        world_mm[depth_mm <= 0] = np.nan
        change = partial(_change, clip, train, each, world_mm, log_cosine(grid.rays))
        yield from measured_cells(clip, train, each, change)


def _change(
    clip: DepthClip, train: Sequence[int], tracks: Tracks, world_mm: Reals, start: Reals, cells: Measured
) -> tuple[Reals, Reals] | None:
    """world_mm [h, w, 3], start [h, w]: a keyframe's points, NaN without depth, and their log cosines."""
    there, known = clip.world_from_camera[train[cells.place]], cells.good & np.isfinite(world_mm[cells.some][..., 0])
    if known.sum() < MIN_CELLS:
        return None
    moved_mm = (world_mm + tracks.displacement_mm[cells.row])[cells.some][known] - there[:3, 3]
    angle = log_cosine(moved_mm @ there[:3, :3]) - start[cells.some][known]
    darker = np.log(cells.ratio[known]).mean(axis=-1, dtype=np.float64)
    return angle - np.median(angle), darker - np.median(darker)


def _thinned(tracks: Tracks, every: int) -> Tracks:
    """Tracks to every so many of the frames."""
    some = slice(None, None, every)
    arrays = {name: getattr(tracks, name)[some] for name in ("displacement_mm", "colour", "confidence")}
    return replace(tracks, **arrays, places=tracks.followed[some].tolist())


def _fit(pairs: Sequence[tuple[Reals, Reals]]) -> tuple[float, float]:
    """The power, by least squares that outliers hardly count in, and the share of the squares that it explains."""
    angle, change = (np.concatenate(each) for each in zip(*pairs, strict=True))
    weight, power = np.ones(angle.size), 0.0
    for _ in range(ROUNDS):
        power = float((weight * angle * change).sum() / max((weight * angle**2).sum(), 1e-12))
        left = change - power * angle
        scale = max(1.48 * float(np.median(np.abs(left))), 1e-6)
        weight = 1 / (1 + (left / scale) ** 2)
    return power, 1 - float((weight * left**2).sum() / max((weight * change**2).sum(), 1e-12))


def evenly_lit(clip: DepthClip, vignetting: Vignetting) -> DepthClip:
    """The clip as if its pictures did not darken towards the border."""
    right = None if clip.right is None else _even(clip.right, vignetting)
    return replace(_even(clip, vignetting), right=right)


def _even(eye: EyeOrClip, vignetting: Vignetting) -> EyeOrClip:
    factor = vignetting.picture(eye.intrinsics)[..., None]

    def picture(index: int) -> NDArray[np.uint8]:
        return np.asarray(np.clip(eye.rgb[index] / factor + 0.5, 0, 255).astype(np.uint8))

    return recoloured(eye, picture)
