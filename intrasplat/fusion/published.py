"""Motion-aware point fusion as published: Yang et al., Deform3DGS (MICCAI 2024), section "Motion-Aware Point Fusion".

Symbols: H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import unproject
from intrasplat.clip.types import DepthClip
from intrasplat.fusion.points import PointCloud, cells_of, measured_pixels, points_at, same_pose, sample


def motion_mask(clip: DepthClip, train: Sequence[int], percentile: float) -> NDArray[np.bool_]:
    """F = (|C_0 - mean_j C_j| > tau) or not M_0: [H, W] in the first training frame's pixels.

    C is grey, the mean of RGB. The mean runs over whole training frames, instruments included, as published; tau is
    the percentile of the nonzero differences on the first frame's tissue.
    """
    total = np.zeros(clip.rgb.shape[1:], dtype=np.float32)  # exact: sums of bytes stay below 2^24
    for index in train:
        cv2.accumulate(clip.rgb[index], total)
    first = train[0]
    difference = np.abs((clip.rgb[first] - total / len(train)).mean(axis=2))
    tissue = clip.tissue[first]
    on_tissue = difference[tissue & (difference > 0)]
    tau = float(np.percentile(on_tissue, percentile)) if on_tissue.size else np.inf
    mask: NDArray[np.bool_] = (difference > tau) | ~tissue
    return mask


def published_fusion(
    clip: DepthClip, frames: Sequence[int], percentile: float, frame_share: float, random: np.random.Generator
) -> Iterator[PointCloud]:
    """A sample of each later training frame's points whose projection into the first frame falls into F."""
    wanted = motion_mask(clip, frames, percentile)
    for index in frames[1:]:
        pixels = measured_pixels(clip, index)
        pixels = pixels[_lands_in(wanted, clip, index, frames[0], pixels)]
        if pixels.size:
            yield points_at(clip, index, pixels[sample(pixels.size, frame_share, random)])


def _lands_in(
    wanted: NDArray[np.bool_], clip: DepthClip, source: int, target: int, pixels: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Which of the source frame's pixels (flat indices with valid depth) project into `wanted` of the target frame."""
    if same_pose(clip, source, target):
        return wanted.reshape(-1)[pixels]  # the same pose maps every pixel to itself
    depth_mm = clip.depth_mm[source].reshape(-1)[pixels]
    points_mm = unproject(pixels, depth_mm, clip.intrinsics, clip.world_from_camera[source])
    cells, inside = cells_of(points_mm, clip.intrinsics, clip.world_from_camera[target], stride=1)
    landed = np.zeros(pixels.size, dtype=np.bool_)
    landed[inside] = wanted.reshape(-1)[cells]
    return landed
