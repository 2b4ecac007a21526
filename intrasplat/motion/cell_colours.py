"""The colours of a keyframe's cells in its tracked frames, and how a veil changes them.

Along a track, colour there = a colour in the keyframe + b airlight. Light that changes is a factor, a alone; a veil is
an offset, b. Both are fitted in windows of the picture.

Symbols: h w cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import to_camera
from intrasplat.clip import DepthClip, spread
from intrasplat.motion.lifted import CoarseFrame, Floats, PointGrid, cell_means
from intrasplat.motion.tracks import Tracks

CELLS_ACROSS = 160
"""Most cells across the picture in which colours are compared, about."""
SAMPLED = 8
"""Tracked frames of a keyframe that decide whether there is a veil, and of which colour."""
MIN_CELLS = 100.0
"""Trusted cells of a frame that is compared."""
MIN_LEVEL, MAX_LEVEL = 0.03, 0.97
"""Colours in [0, 1] that are compared: darker ones are noise, brighter ones clipped."""
OUTLIER = 0.03
"""A residual of this much, in [0, 1], halves a cell's weight: highlights and lost tracks."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A keyframe's cells in a tracked frame, whose index is `frame`.

    rgb       [h, w, 3] their colours there, in [0, 1]
    trust     [h, w] in [0, 1]
    x, y      [h, w] where they are, in cells of that frame
    depth_mm  [h, w] there
    """

    frame: int
    rgb: Floats
    trust: Floats
    x: Floats
    y: Floats
    depth_mm: Floats


class Cells:
    """The cells of a keyframe, in its tracked frames."""

    def __init__(self, recorded: DepthClip, clip: DepthClip, train: Sequence[int], tracks: Tracks) -> None:
        """recorded: as clip, on which the tracks run, with the colours that are compared."""
        self._recorded, self._clip, self._tracks = recorded, clip, tracks
        self._merged = max(1, round(tracks.confidence.shape[2] / CELLS_ACROSS))
        self.step_px = tracks.step_px * self._merged
        key = CoarseFrame(clip, train[tracks.reference], PointGrid(clip, tracks.step_px))
        self._points_mm = cell_means(key.points_mm, self._merged)
        self.rgb = self._colours(train[tracks.reference])
        self.depth_mm = cell_means(key.depth_mm, self._merged)
        self.frames = [train[place] for place in tracks.followed]
        others = [row for row, index in enumerate(self.frames) if index != train[tracks.reference]]
        self.sampled = spread(others, SAMPLED)

    def _colours(self, index: int) -> Floats:
        height, width = self._points_mm.shape[:2]
        found = cell_means(self._recorded.rgb[index], self.step_px)[:height, :width] / np.float32(255)
        self._recorded.let_go(index)
        return np.asarray(found, np.float32)

    def seen(self, row: int) -> Seen:
        """The cells in the frame of this row of the tracks."""
        clip, tracks, index = self._clip, self._tracks, self.frames[row]
        trust = cell_means(tracks.confidence[row], self._merged)
        there_mm = self._points_mm + cell_means(tracks.displacement_mm[row], self._merged)
        tracks.let_go(row)
        size, k = trust.shape, clip.intrinsics
        points = to_camera(there_mm.reshape(-1, 3), clip.world_from_camera[index]).astype(np.float32)
        depth_mm = np.maximum(points[:, 2], np.float32(1e-3))
        column, line = k.fx * points[:, 0] / depth_mm + k.cx, k.fy * points[:, 1] / depth_mm + k.cy
        x, y = (np.asarray(each / self.step_px - 0.5, np.float32).reshape(size) for each in (column, line))
        rgb = cv2.remap(self._colours(index), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = (x >= 0) & (y >= 0) & (x <= size[1] - 1) & (y <= size[0] - 1)
        trust = np.where(inside & usable(rgb) & usable(self.rgb), trust, np.float32(0))
        return Seen(index, np.asarray(rgb, np.float32), trust, x, y, depth_mm.reshape(size))

    def all_seen(self, rows: Iterable[int]) -> Iterator[Seen]:
        """The cells in these rows, where enough of them are trusted."""
        return (seen for row in rows if (seen := self.seen(row)).trust.sum() > MIN_CELLS)


@dataclass(frozen=True, eq=False)
class Split:
    """Colours there = factor colours + offset airlight, fitted in windows [h, w].

    cover    [h, w] mean trust of the window
    squares  [h, w] of each cell's residual
    trust    [h, w] less that of outliers
    """

    factor: Floats
    offset: Floats
    cover: Floats
    squares: Floats
    trust: Floats


def split(start: Floats, there: Floats, trust: Floats, airlight: Floats, over: float) -> Split:
    """Fit factor and offset of colours `there` [h, w, 3] against those at the start of the tracks [h, w, 3].

    Args:
        trust: [h, w] of the cells.
        airlight: [3] the offset's colour.
        over: standard deviation of the windows, cells.
    """
    by_start, by_air = (there * start).sum(-1), there @ airlight
    starts, mixed, air = (start * start).sum(-1), start @ airlight, np.float32(airlight @ airlight)
    cover = smooth(trust, over)
    weight, least = trust, np.float32(1e-6)  # a window without trust has factor 1 and offset 0
    for _ in range(2):
        ss, sa, st, at = (smooth(weight * each, over) for each in (starts, mixed, by_start, by_air))
        aa = smooth(weight, over) * air + least
        ss, st = ss + least, st + least
        scale = 1 / np.maximum(ss * aa - sa * sa, least * least)
        factor, offset = (st * aa - sa * at) * scale, (ss * at - sa * st) * scale
        residual = there - factor[..., None] * start - offset[..., None] * airlight
        squares = np.square(residual).sum(-1)
        weight = trust / (1 + squares / np.float32(OUTLIER**2))
    return Split(factor, offset, cover, squares, weight)


def usable(rgb: Floats) -> NDArray[np.bool_]:
    """[h, w] whether colours are neither noise nor clipped."""
    usable: NDArray[np.bool_] = cv2.inRange(rgb, (MIN_LEVEL,) * 3, (MAX_LEVEL,) * 3) > 0
    return usable


def smooth(values: Floats, over: float) -> Floats:
    """[h, w] Gaussian mean with this standard deviation, cells."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), over, borderType=cv2.BORDER_REFLECT), np.float32)
