"""Points of a frame, and the cells of other frames into which they project.

Symbols: H W pixels (row i, column j), M and N points, k stride in pixels. Lengths in mm, points in the world frame.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics, to_camera, unproject
from intrasplat.clip.types import Eye
from intrasplat.motion.complete import complete_depth

COMPLETED_CONFIDENCE = 0.1
"""Confidence of a point with completed depth: above 0, because its position in the image is known."""
CLEAR_CONFIDENCE = 128
"""Minimum stereo confidence, of 255, of a pixel that is nearly left-right consistent."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """N points seen by training frames.

    points_mm    [N, 3] float32  world
    rgb          [N, 3] float32  in [0, 1]
    confidence   [N]    float32  of the depth, in [0, 1]; COMPLETED_CONFIDENCE where the depth was completed
    frame        [N]    int32    clip index of the frame in which each point lay at points_mm
    reference_mm [N, 3] float32  world: its position in its keyframe if tracks give it, else points_mm
    key          [N]    int32    number of that keyframe (intrasplat/motion/keyframes.py)
    """

    points_mm: NDArray[np.float32]
    rgb: NDArray[np.float32]
    confidence: NDArray[np.float32]
    frame: NDArray[np.int32]
    reference_mm: NDArray[np.float32]
    key: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.points_mm)


def is_measured(clip: Eye, index: int) -> NDArray[np.bool_]:
    """Mask [H, W] of tissue with valid depth."""
    return np.asarray(clip.tissue[index] & (clip.depth_mm[index] > 0))


def same_pose(clip: Eye, index: int, other: int) -> bool:
    """Whether both frames have the same camera pose."""
    return np.array_equal(clip.world_from_camera[index], clip.world_from_camera[other])


def cells_of(
    points_mm: NDArray[np.floating], intrinsics: Intrinsics, world_from_camera: NDArray[np.float64], stride: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Flat index of the k x k cell each point projects into, and which points they are (those in the image)."""
    camera_mm = to_camera(points_mm, world_from_camera)
    in_front = np.flatnonzero(camera_mm[:, 2] > 0)
    x, y, z = camera_mm[in_front].T
    column = np.floor(intrinsics.fx * x / z + intrinsics.cx)
    row = np.floor(intrinsics.fy * y / z + intrinsics.cy)
    visible = (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
    cells_across = -(-intrinsics.width // stride)
    cells = row[visible].astype(np.intp) // stride * cells_across + column[visible].astype(np.intp) // stride
    return cells, in_front[visible]


def nearest_pixels(points_mm: NDArray[np.floating], clip: Eye, index: int) -> NDArray[np.intp]:
    """Flat index [N] of the pixel of a frame into which points (world) project, or of the nearest pixel if outside."""
    k, (column, row) = clip.intrinsics, _places(points_mm, clip, index)
    column, row = np.clip(np.floor(column), 0, k.width - 1), np.clip(np.floor(row), 0, k.height - 1)
    return np.asarray(row * k.width + column, np.intp)


def off_middle(points_mm: NDArray[np.floating], clip: Eye, index: int) -> NDArray[np.floating]:
    """Distance [N] of projected points (world) from a frame's middle, as a share of its sides: at most 0.5 in view."""
    k, (column, row) = clip.intrinsics, _places(points_mm, clip, index)
    return np.asarray(np.maximum(np.abs(column / k.width - 0.5), np.abs(row / k.height - 0.5)))


def _places(points_mm: NDArray[np.floating], clip: Eye, index: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Column and row [N] of points (world) in a frame, px."""
    k, (x, y, z) = clip.intrinsics, to_camera(points_mm, clip.world_from_camera[index]).T
    z = np.maximum(z, 1e-6)
    return k.fx * x / z + k.cx, k.fy * y / z + k.cy


def measured_pixels(clip: Eye, index: int) -> NDArray[np.intp]:
    """Flat indices of the frame's tissue pixels with valid depth."""
    return np.flatnonzero(is_measured(clip, index))


def points_at(clip: Eye, index: int, pixels: NDArray[np.intp]) -> PointCloud:
    """The points of one frame's tissue pixels (flat indices), with key 0. Missing depth is completed."""
    depth_mm = clip.depth_mm[index].reshape(-1)[pixels]
    measured = depth_mm > 0
    if not measured.all():
        completed = complete_depth(clip.depth_mm[index], clip.depth_mm[index] > 0, clip.tissue[index])
        depth_mm = completed.reshape(-1)[pixels]
    confidence = clip.depth_confidence[index].reshape(-1)[pixels] / np.float32(255)
    points_mm = unproject(pixels, depth_mm, clip.intrinsics, clip.world_from_camera[index]).astype(np.float32)
    return PointCloud(
        points_mm=points_mm,
        rgb=clip.rgb[index].reshape(-1, 3)[pixels] / np.float32(255),
        confidence=np.where(measured, confidence, np.float32(COMPLETED_CONFIDENCE)),
        frame=np.full(pixels.size, index, dtype=np.int32),
        reference_mm=points_mm,
        key=np.zeros(pixels.size, dtype=np.int32),
    )


def sample(count: int, share: float, random: np.random.Generator) -> NDArray[np.intp]:
    """A random share of range(count) in rising order, without repeats; at least one unless count is 0."""
    kept = min(count, max(1, round(share * count)))
    return np.sort(random.choice(count, kept, replace=False, shuffle=False))


def taken(cloud: PointCloud, rows: NDArray[np.intp]) -> PointCloud:
    return PointCloud(*(getattr(cloud, each.name)[rows] for each in dataclasses.fields(PointCloud)))


def concatenated(parts: Sequence[PointCloud]) -> PointCloud:
    names = [each.name for each in dataclasses.fields(PointCloud)]
    return PointCloud(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
