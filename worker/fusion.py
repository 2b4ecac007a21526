"""Motion-aware point fusion (MAPF): the coloured point cloud in which training starts.

Symbols: T frames, H W pixels (row i, column j), N points, k stride in pixels. Lengths in mm, points in the world frame.
Source of modes "paper" and "reference_only": Yang et al., Deform3DGS (MICCAI 2024), section "Motion-Aware Point Fusion"
and its ablation "w/o MAPF". Mode "fill" is ours. No mode reads a frame that is not in the training list.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.camera import Intrinsics
from contract.errors import InputError
from worker.clip.types import DepthClip

COMPLETED_CONFIDENCE = 0.1
"""Confidence of a point whose depth no stereo measured: above 0, since its place in the image is known."""
EDGE_PX = 5
"""Masks and stereo are unsure this near to an instrument: hidden regions are filled from farther away if possible."""
CLEAR_CONFIDENCE = 128
"""Of 255: left-right consistent, or nearly so."""
RELAXATIONS = 12
"""Jacobi sweeps a pyramid level when depth is completed: the coarser level has already settled the long waves."""


@dataclass(frozen=True)
class FusionSettings:
    """How points are chosen.

    mode               "paper": MAPF as published; "reference_only": the first training frame alone ("w/o MAPF");
                       "fill": a grid on the first training frame, then what it does not show from later ones
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


@dataclass(frozen=True, eq=False)
class PointCloud:
    """N points seen by training frames.

    points_mm  [N, 3] float32  world
    rgb        [N, 3] float32  in [0, 1]
    confidence [N]    float32  in [0, 1], of the depth; COMPLETED_CONFIDENCE where no stereo measured it
    frame      [N]    int32    clip index of the frame each point was taken from
    """

    points_mm: NDArray[np.float32]
    rgb: NDArray[np.float32]
    confidence: NDArray[np.float32]
    frame: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.points_mm)


def fuse(clip: DepthClip, train: Sequence[int], settings: FusionSettings, *, seed: int) -> PointCloud:
    """The starting cloud of the training frames `train` (clip indices, rising). Same arguments, same bits.

    Raises:
        InputError: no training frame has valid depth on tissue.
    """
    with_depth = (index for index in train if _is_measured(clip, index).any())
    first = next(with_depth, None)
    if first is None:
        raise InputError(
            "clip", f"has no valid depth on tissue in its {len(train)} training frames.", "Check depth and masks."
        )
    # Where the very first frame has no depth, the first one that has some takes its part.
    frames = [first, *(index for index in train if index != first)]
    if settings.mode == "fill":
        return _fill(clip, frames, settings)
    random = np.random.default_rng(seed)
    parts = [_points_at(clip, first, _measured_pixels(clip, first))]
    if settings.mode == "paper":
        parts += _published_fusion(clip, frames, settings, random)
    cloud = _concatenated(parts)
    return _taken(cloud, _sample(len(cloud), settings.total_share, random))


# "paper" ------------------------------------------------------------------------------------------------------------


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


def _published_fusion(
    clip: DepthClip, frames: Sequence[int], settings: FusionSettings, random: np.random.Generator
) -> Iterator[PointCloud]:
    """A sample of the points of every later training frame whose projection into the first one falls into F."""
    wanted = motion_mask(clip, frames, settings.motion_percentile)
    for index in frames[1:]:
        pixels = _measured_pixels(clip, index)
        pixels = pixels[_lands_in(wanted, clip, index, frames[0], pixels)]
        if pixels.size:
            yield _points_at(clip, index, pixels[_sample(pixels.size, settings.frame_share, random)])


def _lands_in(
    wanted: NDArray[np.bool_], clip: DepthClip, source: int, target: int, pixels: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Which of the source frame's pixels (flat indices with valid depth) project into `wanted` of the target frame."""
    if np.array_equal(clip.world_from_camera[source], clip.world_from_camera[target]):
        return wanted.reshape(-1)[pixels]  # the same pose maps every pixel to itself
    depth_mm = clip.depth_mm[source].reshape(-1)[pixels]
    points_mm = unproject(pixels, depth_mm, clip.intrinsics, clip.world_from_camera[source])
    cells, inside = _cells_of(points_mm, clip.intrinsics, clip.world_from_camera[target], stride=1)
    landed = np.zeros(pixels.size, dtype=np.bool_)
    landed[inside] = wanted.reshape(-1)[cells]
    return landed


# "fill" -------------------------------------------------------------------------------------------------------------


def _fill(clip: DepthClip, frames: Sequence[int], settings: FusionSettings) -> PointCloud:
    """The grid of the first frame's tissue, then each cell that it does not show, from the best frame that does.

    A cell is k x k pixels, its candidate the pixel in the middle. Better is, in this order: depth measured with
    confidence and away from instruments; depth measured; depth completed. Among equals the earliest frame wins.
    """
    first, later = frames[0], frames[1:]
    coverage = _Coverage(clip.intrinsics, settings.stride)
    parts = [coverage.add(clip, first, coverage.pixels[clip.tissue[first].reshape(-1)[coverage.pixels]])]
    for usable in (_is_clear, _is_measured, _is_tissue):
        for index in later:
            pixels = coverage.open_pixels(clip.world_from_camera[index])
            if pixels.size:
                pixels = pixels[usable(clip, index).reshape(-1)[pixels]]
            if pixels.size:
                parts.append(coverage.add(clip, index, pixels))
    return _concatenated(parts)


def _is_clear(clip: DepthClip, index: int) -> NDArray[np.bool_]:
    """Depth measured with confidence, well inside tissue."""
    box = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    inside = cv2.erode(clip.tissue[index].view(np.uint8), box).view(np.bool_)
    return np.asarray(inside & (clip.depth_mm[index] > 0) & (clip.depth_confidence[index] >= CLEAR_CONFIDENCE))


def _is_measured(clip: DepthClip, index: int) -> NDArray[np.bool_]:
    return np.asarray(clip.tissue[index] & (clip.depth_mm[index] > 0))


def _is_tissue(clip: DepthClip, index: int) -> NDArray[np.bool_]:
    """Tissue whose depth can be completed, for which the frame must have some."""
    return np.asarray(clip.tissue[index] & _is_measured(clip, index).any())


class _Coverage:
    """Which cells of a view the points taken so far already cover."""

    def __init__(self, intrinsics: Intrinsics, stride: int) -> None:
        self._intrinsics, self._stride = intrinsics, stride
        rows, columns = (np.arange(-(-size // stride)) for size in (intrinsics.height, intrinsics.width))
        self._shape = (rows.size, columns.size)
        middle_row = np.minimum(rows * stride + stride // 2, intrinsics.height - 1)
        middle_column = np.minimum(columns * stride + stride // 2, intrinsics.width - 1)
        self.pixels: NDArray[np.intp] = (middle_row[:, None] * intrinsics.width + middle_column).reshape(-1)
        """Flat index of each cell's middle pixel."""
        self._covered = np.zeros(self.pixels.size, dtype=np.bool_)
        self._pose: NDArray[np.float64] | None = None
        self._points_mm: list[NDArray[np.float32]] = []

    def open_pixels(self, world_from_camera: NDArray[np.float64]) -> NDArray[np.intp]:
        """Middle pixels of the cells that no point covers as seen from this pose."""
        self._look_from(world_from_camera)
        return self.pixels[~self._covered]

    def add(self, clip: DepthClip, index: int, pixels: NDArray[np.intp]) -> PointCloud:
        """The points of these middle pixels of one frame, which cover their cells from now on."""
        self._look_from(clip.world_from_camera[index])
        cloud = _points_at(clip, index, pixels)
        rows, columns = np.divmod(pixels, self._intrinsics.width)
        self._covered[rows // self._stride * self._shape[1] + columns // self._stride] = True
        self._points_mm.append(cloud.points_mm)
        return cloud

    def _look_from(self, world_from_camera: NDArray[np.float64]) -> None:
        if self._pose is not None and np.array_equal(self._pose, world_from_camera):
            return
        self._pose = world_from_camera
        if not self._points_mm:
            return
        points_mm = np.concatenate(self._points_mm)
        cells, _ = _cells_of(points_mm, self._intrinsics, world_from_camera, self._stride)
        covered = np.zeros(self._shape, dtype=np.uint8)
        covered.reshape(-1)[cells] = 1
        # From another pose the grid spreads unevenly: a gap of one cell between points is no hole.
        closed = cv2.morphologyEx(covered, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        self._covered = np.asarray(closed, dtype=np.bool_).reshape(-1)


def complete_depth(
    depth_mm: NDArray[np.float32], valid: NDArray[np.bool_], tissue: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Depth [H, W] on all tissue: measured where valid, elsewhere a membrane between its surroundings; 0 off tissue.

    The membrane is the harmonic function (zero Laplacian) of inverse depth, which is linear over the image for a plane.
    Nothing valid on tissue gives zeros.
    """
    known = valid & tissue & (depth_mm > 0)
    if not known.any():
        return np.zeros_like(depth_mm)
    inverse = np.divide(1.0, depth_mm, out=np.zeros_like(depth_mm), where=known)
    completed = 1.0 / _membrane(inverse, known)
    return np.where(known, depth_mm, np.where(tissue, completed, 0)).astype(np.float32)


def _membrane(value: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Harmonic function through the known values, from coarse to fine (cascadic multigrid)."""
    height, width = value.shape
    if known.all():
        return value
    if min(height, width) < 4:
        return np.where(known, value, value[known].mean()).astype(np.float32)
    half = ((width + 1) // 2, (height + 1) // 2)
    weight = cv2.resize(known.astype(np.float32), half, interpolation=cv2.INTER_AREA)
    summed = cv2.resize(np.where(known, value, np.float32(0)), half, interpolation=cv2.INTER_AREA)
    coarse = _membrane(np.divide(summed, weight, out=np.zeros_like(summed), where=weight > 0), weight > 0)
    guess = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32) / 4
    for _ in range(RELAXATIONS):
        np.copyto(guess, value, where=known)
        guess = np.asarray(cv2.filter2D(guess, -1, cross, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)
    np.copyto(guess, value, where=known)
    return guess


# shared -------------------------------------------------------------------------------------------------------------


def unproject(
    pixels: NDArray[np.intp],
    depth_mm: NDArray[np.float32],
    intrinsics: Intrinsics,
    world_from_camera: NDArray[np.float64],
) -> NDArray[np.float64]:
    """World points [M, 3] in mm of flat pixel indices [M] with their depths [M], through the pixels' centres."""
    rows, columns = np.divmod(pixels, intrinsics.width)
    x = (columns + 0.5 - intrinsics.cx) / intrinsics.fx
    y = (rows + 0.5 - intrinsics.cy) / intrinsics.fy
    camera_mm = np.stack([x, y, np.ones_like(x)], axis=1) * depth_mm[:, None].astype(np.float64)
    return np.asarray(camera_mm @ world_from_camera[:3, :3].T + world_from_camera[:3, 3])


def _cells_of(
    points_mm: NDArray[np.floating], intrinsics: Intrinsics, world_from_camera: NDArray[np.float64], stride: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Flat index of the k x k cell each point projects into, and which points they are (those in the image)."""
    camera_mm = (points_mm - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    in_front = np.flatnonzero(camera_mm[:, 2] > 0)
    x, y, z = camera_mm[in_front].T
    column = np.floor(intrinsics.fx * x / z + intrinsics.cx)
    row = np.floor(intrinsics.fy * y / z + intrinsics.cy)
    visible = (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
    cells_across = -(-intrinsics.width // stride)
    cells = row[visible].astype(np.intp) // stride * cells_across + column[visible].astype(np.intp) // stride
    return cells, in_front[visible]


def _measured_pixels(clip: DepthClip, index: int) -> NDArray[np.intp]:
    """Flat indices of the frame's tissue pixels with valid depth."""
    return np.flatnonzero(_is_measured(clip, index))


def _points_at(clip: DepthClip, index: int, pixels: NDArray[np.intp]) -> PointCloud:
    """The points of one frame's pixels (flat indices on tissue); depth is completed where it was not measured."""
    depth_mm = clip.depth_mm[index].reshape(-1)[pixels]
    measured = depth_mm > 0
    if not measured.all():
        completed = complete_depth(clip.depth_mm[index], clip.depth_mm[index] > 0, clip.tissue[index])
        depth_mm = completed.reshape(-1)[pixels]
    confidence = clip.depth_confidence[index].reshape(-1)[pixels] / np.float32(255)
    return PointCloud(
        points_mm=unproject(pixels, depth_mm, clip.intrinsics, clip.world_from_camera[index]).astype(np.float32),
        rgb=clip.rgb[index].reshape(-1, 3)[pixels] / np.float32(255),
        confidence=np.where(measured, confidence, np.float32(COMPLETED_CONFIDENCE)),
        frame=np.full(pixels.size, index, dtype=np.int32),
    )


def _sample(count: int, share: float, random: np.random.Generator) -> NDArray[np.intp]:
    """A random share of range(count) without repeats, rising; at least one of any."""
    kept = min(count, max(1, round(share * count)))
    return np.sort(random.choice(count, kept, replace=False, shuffle=False))


def _taken(cloud: PointCloud, rows: NDArray[np.intp]) -> PointCloud:
    return PointCloud(cloud.points_mm[rows], cloud.rgb[rows], cloud.confidence[rows], cloud.frame[rows])


def _concatenated(parts: Sequence[PointCloud]) -> PointCloud:
    return PointCloud(
        points_mm=np.concatenate([part.points_mm for part in parts]),
        rgb=np.concatenate([part.rgb for part in parts]),
        confidence=np.concatenate([part.confidence for part in parts]),
        frame=np.concatenate([part.frame for part in parts]),
    )
