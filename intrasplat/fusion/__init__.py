"""Depth clip and the motion of its tissue in; the coloured points from which training starts out. Verb: fuse.

Symbols: T frames, H W pixels (row i, column j), N points, k stride in pixels. Lengths in mm, points in the world frame.
Source of modes "paper" and "reference_only": Yang et al., Deform3DGS (MICCAI 2024), section "Motion-Aware Point Fusion"
and its ablation "w/o MAPF". Mode "fill" is ours. No mode reads a frame that is not in the training list.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from intrasplat.clip.types import DepthClip, Eye
from intrasplat.errors import InputError
from intrasplat.fusion.fill import fill
from intrasplat.fusion.points import (
    CLEAR_CONFIDENCE,
    COMPLETED_CONFIDENCE,
    PointCloud,
    concatenated,
    is_measured,
    measured_pixels,
    nearest_pixels,
    points_at,
    sample,
    taken,
)
from intrasplat.fusion.published import motion_mask, published_fusion
from intrasplat.motion.tracks import Moved

__all__ = [
    "CLEAR_CONFIDENCE",
    "COMPLETED_CONFIDENCE",
    "FusionSettings",
    "PointCloud",
    "fuse",
    "motion_mask",
    "nearest_pixels",
]


NO_TRACKS: Mapping[int, Moved] = MappingProxyType({})


@dataclass(frozen=True)
class FusionSettings:
    """How points are chosen.

    mode               "paper": MAPF as published; "reference_only": the first training frame alone ("w/o MAPF");
                       "fill": a grid on the first training frame and on tissue that only later keyframes show; tissue
                       hidden there is read in later frames, at the positions that tracks give
    stride             "fill": pixels between neighbouring points
    motion_percentile  "paper": the threshold tau is this percentile of the nonzero differences on tissue
    frame_share        "paper": share kept of each later frame's points
    total_share        "paper", "reference_only": share kept of all points in the end
    """

    mode: Literal["paper", "reference_only", "fill"] = "fill"
    stride: int = 3
    motion_percentile: float = 95.0
    frame_share: float = 0.1
    total_share: float = 0.1

    def __post_init__(self) -> None:
        if self.mode not in ("paper", "reference_only", "fill"):
            raise ValueError(f"mode must be 'paper', 'reference_only' or 'fill', not {self.mode!r}")
        if self.stride < 1:
            raise ValueError(f"stride must be at least 1 pixel, not {self.stride}")
        if not (0 < self.frame_share <= 1 and 0 < self.total_share <= 1):
            raise ValueError(f"shares must lie in (0, 1], not {self.frame_share} and {self.total_share}")


def fuse(
    clip: DepthClip,
    train: Sequence[int],
    settings: FusionSettings,
    *,
    seed: int,
    moved: Mapping[int, Moved] = NO_TRACKS,
    right: Eye | None = None,
) -> PointCloud:
    """The initial point cloud from the training frames `train` (clip indices). Same arguments, same bits.

    Args:
        train: in order of preference: rising, or the sharp ones first.
        moved: for "fill", the tissue's displacement since each keyframe, by keyframe; empty: the tissue rests.
        right: for "fill", the right eye, if training uses it.

    Raises:
        InputError: no training frame has valid depth on tissue.
    """
    with_depth = (index for index in train if is_measured(clip, index).any())
    first = next(with_depth, None)
    if first is None:
        raise InputError(
            "clip", f"has no valid depth on tissue in its {len(train)} training frames.", "Check depth and masks."
        )
    # If the first frame has no depth, the first frame with depth takes its place.
    frames = [first, *(index for index in train if index != first)]
    if settings.mode == "fill":
        return fill(clip, frames, settings.stride, moved, right)
    random = np.random.default_rng(seed)
    parts = [points_at(clip, first, measured_pixels(clip, first))]
    if settings.mode == "paper":
        parts += published_fusion(clip, frames, settings.motion_percentile, settings.frame_share, random)
    cloud = concatenated(parts)
    return taken(cloud, sample(len(cloud), settings.total_share, random))
