"""Points for all tissue that the clip shows: the first frame's, then tissue that only later frames show.

Tissue that is hidden in the first frame is read in a later frame, at the position to which the tracks say it has moved.
Its point keeps its position among its neighbours in the first frame, so that neighbours there move alike. If the camera
moves on, later keyframes add points for tissue that has none yet.

Symbols: H W pixels (row i, column j), M cells, N points, k stride in pixels. Lengths in mm, points in the world frame.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics, to_camera, unproject_at
from intrasplat.clip.split import spread
from intrasplat.clip.types import DepthClip, Eye
from intrasplat.fusion.points import (
    CLEAR_CONFIDENCE,
    COMPLETED_CONFIDENCE,
    PointCloud,
    cells_of,
    concatenated,
    is_measured,
    nearest_pixels,
    off_middle,
    points_at,
    same_pose,
)
from intrasplat.machine.cores import cores
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.motion.complete import complete_colour, complete_depth
from intrasplat.motion.tracks import Moved

EDGE_PX = 5
"""Masks and stereo are unreliable this near to an instrument. Views with the instrument farther away are preferred."""
MARGIN = 1 / 16
"""Margin around the first frame, as a share of its sides. Its tissue gets points, too, if it comes into view."""
MAX_VIEWS = 32
"""Number of later frames, evenly spread, that are searched for hidden cells along the tracks."""
IN_VIEW = 0.5
"""A point is in view up to this distance from the middle (points.off_middle)."""
MAX_FARTHER = 1.15
"""A keyframe counts as showing tissue equally finely up to this multiple of the smallest distance."""
RIM_SHARE = 0.01
"""Share of the width by which masks that were found may extend over the instrument's outline."""
HIDDEN, COMPLETED, MEASURED, CLEAR = range(4)
"""How well a frame shows a cell, rising: not; depth completed; depth measured; depth confident and far from masks."""


def fill(
    clip: DepthClip, frames: Sequence[int], stride: int, moved: Mapping[int, Moved], right: Eye | None = None
) -> PointCloud:
    """A grid of points on the first frame's tissue, and a point for each other cell from the frame that shows it best.

    Among frames that show a cell equally well, the earliest is used. A cell is k x k pixels. Its point comes from the
    middle pixel, or from the pixel to which the tissue in the middle has moved. Tissue that only the right eye sees
    comes from its frames. If the camera moves, each keyframe gives the tissue that it shows best.

    moved: the displacement since each keyframe, by keyframe.
    """
    first, later = frames[0], frames[1:]
    elsewhere = [index for index in later if not same_pose(clip, index, first)]
    coverage = _Coverage(clip, stride, moved if elsewhere else {})
    if elsewhere and moved and list(moved) != [first]:
        parts = _from_keyframes(clip, frames, stride, moved, coverage)
    else:
        parts = [coverage.add(clip, first, coverage.pixels[clip.tissue[first].reshape(-1)[coverage.pixels]])]
        for since in moved.values():
            parts += _along_tracks(clip, first, later, _hidden_cells(clip, first, stride), since)
            coverage.add_points(parts[1:])
    views: list[tuple[Eye, int]] = [(clip, index) for index in (elsewhere if moved else later)]
    if right is not None:
        views += [(right, index) for index in frames]
    if elsewhere and moved:
        views = [views[place] for place in spread(range(len(views)), MAX_VIEWS)]
    for least in (CLEAR, MEASURED, COMPLETED):
        for eye, index in views:
            pixels = coverage.open_pixels(eye, index)
            if pixels.size:
                pixels = pixels[_shown(eye, index, pixels) >= least]
            if pixels.size:
                parts.append(coverage.add(eye, index, pixels))
            eye.let_go(index)
    return concatenated(parts)


def _from_keyframes(
    clip: DepthClip, frames: Sequence[int], stride: int, moved: Mapping[int, Moved], coverage: _Coverage
) -> list[PointCloud]:
    """Points from keyframes: the tissue that each shows best, then the rest, then tissue that instruments hide."""
    parts = []
    for best in (True, False):
        for key, index in enumerate(moved):
            pixels = coverage.open_pixels(clip, index)
            pixels = pixels[_shown(clip, index, pixels) >= MEASURED]
            if best:
                pixels = pixels[_best_key(points_at(clip, index, pixels).points_mm, clip, list(moved)) == key]
            parts.append(coverage.add(clip, index, pixels, key))
    for key, (index, since) in enumerate(moved.items()):
        cells = _hidden_cells(clip, index, stride)
        cells = cells.select(cells.in_view & np.isin(cells.pixels, coverage.open_pixels(clip, index)))
        for found in _along_tracks(clip, index, [other for other in frames if other != index], cells, since):
            parts.append(dataclasses.replace(found, key=np.full(len(found), key, np.int32)))
            coverage.add_points(parts[-1:])
    return parts


def _best_key(points_mm: NDArray[np.float32], clip: DepthClip, keys: Sequence[int]) -> NDArray[np.intp]:
    """For each point [N] the keyframe, among those near it (MAX_FARTHER), that shows it nearest to the middle."""
    off = np.stack([off_middle(points_mm, clip, index) for index in keys])
    depth_mm = np.stack([to_camera(points_mm, clip.world_from_camera[index])[:, 2] for index in keys])
    depth_mm[off > IN_VIEW] = np.inf
    off[depth_mm > MAX_FARTHER * depth_mm.min(axis=0)] += 1
    return np.asarray(np.argmin(off, axis=0), np.intp)


def _shown(clip: Eye, index: int, pixels: NDArray[np.intp]) -> NDArray[np.uint8]:
    """How well a frame shows its pixels (flat, [M]): [M], HIDDEN to CLEAR; HIDDEN in a frame without any depth."""
    depth_mm, tissue = clip.depth_mm[index], clip.tissue[index]
    on_tissue = tissue.reshape(-1)[pixels]
    measured = on_tissue & (depth_mm.reshape(-1)[pixels] > 0)
    if not (measured.any() or is_measured(clip, index).any()):
        return np.full(len(pixels), HIDDEN, np.uint8)
    box = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    inside = cv2.erode(tissue.view(np.uint8), box).view(np.bool_).reshape(-1)[pixels]
    clear = inside & measured & (clip.depth_confidence[index].reshape(-1)[pixels] >= CLEAR_CONFIDENCE)
    return np.asarray(on_tissue.astype(np.uint8) + measured + clear, np.uint8)


def _along_tracks(
    clip: DepthClip, first: int, later: Sequence[int], cells: _Cells, moved: Moved
) -> Iterator[PointCloud]:
    """Points for cells that the frame `first` does not show, read along the tracks in the frames that show them.

    So neighbouring cells get neighbouring tissue, whenever each is seen. The estimated motion may bring a cell into
    view in no frame. Such a cell gets the colour that a later frame shows at its position, and a completed depth. Cells
    that no frame shows stay empty, except the rim of masks that were found. They may be too wide: if neither camera nor
    instrument moves, the rim would be a hole. It gets the colour of adjacent tissue.
    """
    unseen = cells.in_view.copy()

    def points_of(view: tuple[int, NDArray[np.intp], NDArray[np.intp]]) -> PointCloud:
        index, chosen, pixels = view
        points = points_at(clip, index, pixels)
        clip.let_go(index)
        return dataclasses.replace(points, reference_mm=cells.world_mm[chosen])

    views = _best_views(clip, spread(later, MAX_VIEWS), cells, moved)
    with one_opencv_thread(), ThreadPoolExecutor(cores()) as pool:
        yield from pool.map(points_of, views)
    for _, chosen, _ in views:
        unseen[chosen] = False
    cells = cells.select(unseen)
    from_there = [index for index in later if same_pose(clip, index, first)]
    unseen = cells.in_view.copy()
    for index, chosen, pixels in _best_views(clip, from_there, cells, _at_rest):
        unseen[chosen] = False
        yield _guessed(cells.world_mm[chosen], clip.rgb[index].reshape(-1, 3)[pixels] / np.float32(255), first)
    masks_are_found = clip.masks is not None and clip.masks.are_found
    if masks_are_found and len(from_there) == len(later):  # the camera rests
        cells = cells.select(unseen)
        shown = np.any([clip.tissue[index] for index in (first, *from_there)], axis=0)
        away_px = cv2.distanceTransform((~shown).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5).reshape(-1)
        rim = cells.select(away_px[cells.pixels] <= RIM_SHARE * clip.intrinsics.width)
        rgb = complete_colour(clip.rgb[first], clip.tissue[first]).reshape(-1, 3)[rim.pixels]
        yield _guessed(rim.world_mm, rgb, first)


def _guessed(place_mm: NDArray[np.float32], rgb: NDArray[np.float32], frame: int) -> PointCloud:
    """A point cloud of positions and colours [M, 3] that no frame shows, with COMPLETED_CONFIDENCE."""
    return PointCloud(
        points_mm=place_mm,
        rgb=rgb,
        confidence=np.full(len(place_mm), COMPLETED_CONFIDENCE, np.float32),
        frame=np.full(len(place_mm), frame, np.int32),
        reference_mm=place_mm,
        key=np.zeros(len(place_mm), np.int32),
    )


def _best_views(
    clip: DepthClip, later: Sequence[int], cells: _Cells, moved: Moved
) -> list[tuple[int, NDArray[np.intp], NDArray[np.intp]]]:
    """The best view of each visible cell: frames in order, each with its cells [M'] and their pixels [M']."""
    best = np.full(len(cells.pixels), HIDDEN, np.uint8)
    frame, seen_at = np.full((2, len(best)), -1, np.intp)
    for index in later:
        some = np.flatnonzero(best < CLEAR)
        if not some.size:
            break
        there_mm = cells.world_mm[some] + moved(index, cells.pixels[some])
        pixels, found = cells_of(there_mm, clip.intrinsics, clip.world_from_camera[index], stride=1)
        shown = _shown(clip, index, pixels)
        better = shown > best[some[found]]
        chosen = some[found[better]]
        best[chosen], frame[chosen], seen_at[chosen] = shown[better], index, pixels[better]
        clip.let_go(index)
    found_in = ((int(index), np.flatnonzero(frame == index)) for index in np.unique(frame[frame >= 0]))
    return [(index, chosen, seen_at[chosen]) for index, chosen in found_in]


def _at_rest(index: int, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
    del index
    return np.zeros((len(pixels), 3), np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class _Cells:
    """Cells in the first frame or in the margin around it.

    world_mm  [M, 3]  tissue in the middle of the cell, at completed depth
    pixels    [M]     flat index of the middle pixel, or of the nearest pixel in the image
    in_view   [M]     whether the cell lies in the image, in its field of view
    """

    world_mm: NDArray[np.float32]
    pixels: NDArray[np.intp]
    in_view: NDArray[np.bool_]

    def select(self, rows: NDArray[np.bool_]) -> _Cells:
        """The cells that `rows` [M] selects."""
        return _Cells(self.world_mm[rows], self.pixels[rows], self.in_view[rows])


def _hidden_cells(clip: DepthClip, first: int, stride: int) -> _Cells:
    """The cells without tissue in the first frame, and those of the MARGIN around it or around its field of view."""
    k, measured = clip.intrinsics, is_measured(clip, first)
    sides = (k.height, k.width)
    beyond = [-(-int(side * MARGIN) // stride) * stride for side in sides]
    border = [(extra, extra) for extra in beyond]
    seen = np.pad(measured, border)
    depth_mm = complete_depth(np.pad(clip.depth_mm[first], border), seen, np.ones_like(seen))
    middles = [_middles(side, extra, stride) for side, extra in zip(sides, beyond, strict=True)]
    row, column = (each.reshape(-1) for each in np.meshgrid(*middles, indexing="ij"))
    nearest_row, nearest_column = np.clip(row, 0, k.height - 1), np.clip(column, 0, k.width - 1)
    in_view = (nearest_row == row) & (nearest_column == column)
    hidden = ~(in_view & clip.tissue[first][nearest_row, nearest_column])
    if clip.field_of_view is not None:
        in_view &= clip.field_of_view[nearest_row, nearest_column]
        margin = np.ones([2 * extra + 1 for extra in beyond], np.uint8)
        around = cv2.dilate(clip.field_of_view.astype(np.uint8), margin) > 0
        hidden &= around[nearest_row, nearest_column]
    row, column = row[hidden], column[hidden]
    at_mm = depth_mm[row + beyond[0], column + beyond[1]]
    world_mm = unproject_at(column + 0.5, row + 0.5, at_mm, k, clip.world_from_camera[first])
    pixels = (nearest_row * k.width + nearest_column)[hidden]
    return _Cells(world_mm.astype(np.float32), pixels, in_view[hidden])


def _middles(side: int, beyond: int, stride: int) -> NDArray[np.intp]:
    """Positions of the cells' middles along one side of the image and `beyond` pixels past both ends."""
    inside = np.minimum(np.arange(0, side, stride) + stride // 2, side - 1)  # the last cell may be smaller
    before, behind = (np.arange(start, start + beyond, stride) + stride // 2 for start in (-beyond, side))
    return np.concatenate([before, inside, behind])


class _Coverage:
    """Which cells of a view the points chosen so far cover."""

    def __init__(self, clip: DepthClip, stride: int, moved: Mapping[int, Moved]) -> None:
        """moved: as for fill, if the camera moves; empty: points count at their position in the first frame."""
        self._clip, self._moved = clip, moved
        intrinsics = clip.intrinsics  # all eyes have one size
        self._width, self._stride = intrinsics.width, stride
        middle_row, middle_column = (_middles(size, 0, stride) for size in (intrinsics.height, intrinsics.width))
        self._shape = (middle_row.size, middle_column.size)
        self.pixels: NDArray[np.intp] = (middle_row[:, None] * intrinsics.width + middle_column).reshape(-1)
        """Flat index of each cell's middle pixel."""
        self._covered = np.zeros(self.pixels.size, dtype=np.bool_)
        self._view: tuple[Intrinsics, NDArray[np.float64]] | None = None
        self._points: list[_Covering] = []
        self._projected: dict[tuple[bool, int], tuple[NDArray[np.uint8], int]] = {}
        """For each view (whether the left eye, frame): the cells that points project into, and how many of _points."""

    def open_pixels(self, eye: Eye, index: int) -> NDArray[np.intp]:
        """Middle pixels of the cells that no point covers as seen by this eye in this frame."""
        self._look_from(eye, index)
        return self.pixels[~self._covered]

    def add(self, eye: Eye, index: int, pixels: NDArray[np.intp], key: int | None = None) -> PointCloud:
        """The points of these middle pixels of one frame, which cover their cells from then on.

        key: the keyframe whose tracks they follow; None: the one that shows each best.
        """
        self._look_from(eye, index)
        cloud = points_at(eye, index, pixels)
        if self._moved:
            best = _best_key(cloud.points_mm, self._clip, list(self._moved)) if key is None else key
            cloud = dataclasses.replace(cloud, key=np.full(len(cloud), best, np.int32))
        rows, columns = np.divmod(pixels, self._width)
        self._covered[rows // self._stride * self._shape[1] + columns // self._stride] = True
        self.add_points([cloud])
        return cloud

    def add_points(self, clouds: Iterable[PointCloud]) -> None:
        """Mark the cells that these points project into as covered, from any pose."""
        self._points += [_Covering.of(cloud, self._clip, self._moved) for cloud in clouds]

    def _look_from(self, eye: Eye, index: int) -> None:
        view = eye.intrinsics, eye.world_from_camera[index]
        if self._view is not None and self._view[0] == view[0] and np.array_equal(self._view[1], view[1]):
            return
        self._view = view
        if not self._points:
            return
        key = eye is self._clip, index
        covered, done = self._projected.get(key, (np.zeros(self._shape, np.uint8), 0))
        if added := self._points[done:]:
            cells, _ = cells_of(np.concatenate([each.at(index) for each in added]), *view, self._stride)
            covered.reshape(-1)[cells] = 1
            self._projected[key] = covered, len(self._points)
        # From another pose the grid is uneven: a gap of one cell between points is not a hole.
        closed = cv2.morphologyEx(covered, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        self._covered = np.asarray(closed, dtype=np.bool_).reshape(-1)


@dataclasses.dataclass(frozen=True, eq=False)
class _Covering:
    """Points, and their positions at any time.

    start_mm [N, 3]  their positions in their keyframes
    motions          per keyframe: its displacement, the indices [M] of the points that follow it, their pixels there
    """

    start_mm: NDArray[np.float32]
    motions: Sequence[tuple[Moved, NDArray[np.intp], NDArray[np.intp]]]

    @classmethod
    def of(cls, cloud: PointCloud, clip: DepthClip, moved: Mapping[int, Moved]) -> _Covering:
        """moved: empty if the points rest at their positions in the keyframes."""
        if not moved:
            return cls(cloud.reference_mm, ())
        start_mm, motions = cloud.points_mm.copy(), []
        for key, (index, since) in enumerate(moved.items()):
            rows = np.flatnonzero(cloud.key == key)
            pixels = nearest_pixels(cloud.reference_mm[rows], clip, index)
            for frame in np.unique(cloud.frame[rows]):
                there = cloud.frame[rows] == frame
                start_mm[rows[there]] -= since(int(frame), pixels[there])
            motions.append((since, rows, pixels))
        return cls(start_mm, motions)

    def at(self, index: int) -> NDArray[np.float32]:
        """The points' positions [N, 3] at a frame."""
        points_mm = self.start_mm.copy() if self.motions else self.start_mm
        for since, rows, pixels in self.motions:
            if rows.size:
                points_mm[rows] += since(index, pixels)
        return points_mm
