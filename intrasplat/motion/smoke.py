"""Find the veil of smoke before each eye, along tracks of the tissue.

The same tissue is seen with more and with less smoke: along a track, colour there = a colour in the keyframe + b
airlight. Light that changes is a factor, a alone; a veil is an offset, b, that is smooth in the picture. Of smoke that
all frames have alike, this shows nothing: the mean over time is taken as even, and as thick as leaves the darkest
tissue dark.

Symbols: T frames, K frames of a keyframe's tracks, h w cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import to_camera, unproject
from intrasplat.clip import DepthClip, Eye, spread
from intrasplat.machine.cores import cores
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.motion.lifted import CoarseFrame, Floats, PointGrid, cell_means
from intrasplat.motion.tracks import Tracks
from intrasplat.motion.veil import Veil, whole_depth_mm

CELLS_ACROSS = 160
"""Most cells across the picture in which colours are compared, about."""
NODE_CELLS = 4
"""Cells across a node of the veil's grid, so that a 640 px wide picture has a node every 16 px."""
SMOOTH_CELLS, SEARCH_CELLS = 3.0, 5.0
"""Standard deviation of the windows in which a and b are fitted; of those that decide whether there is a veil."""
SPREAD_CELLS, FAR_CELLS = 1.5, 12.0
"""Standard deviation of the mean in a frame's own cells, and of the one that fills in where no track ends."""
LITTLE = np.float32(0.02)
"""Weight of what fills in; full trust has 1."""
SAMPLED = 8
"""Tracked frames of a keyframe that decide whether there is a veil, and of which colour."""
MIN_SPREAD, MAX_RESIDUAL = 0.04, 0.92
"""Least standard deviation of b within a frame, as a median over frames; most error of a and b as a share of that of a
alone with a tint for each frame. Clean clips and drifting exposure or white balance have 0.99 and more, smoke of 0.35
has 0.5 to 0.84."""
LOST, MAX_LOST = 0.01, 0.4
"""Most that a cell's squared residual counts, and most of their mean, as a share of it: where tracks find other tissue,
an offset explains colours better than light, too. Clips have 0.1 to 0.25."""
MIN_CELLS, MIN_COVER = 100.0, 0.2
"""Trusted cells of a frame that is compared, and trust of a window that is."""
MIN_LEVEL, MAX_LEVEL = 0.03, 0.97
"""Colours in [0, 1] that are compared: darker ones are noise, brighter ones clipped."""
OUTLIER = 0.03
"""A residual of this much, in [0, 1], halves a cell's weight: highlights and lost tracks."""
MIN_AIRLIGHT, MAX_AIRLIGHT = 0.5, 1.0
"""Of the mean of R G B; smoke is lit by the endoscope itself, so it is bright."""
MAX_THICKNESS, HALVINGS = 2.0, 7
"""Most of the mean over time, and how often its range is halved to find it."""
EVERY = 7
"""Every how many cells' colours decide it."""
LOW_PERCENTILE, DARK_LEVEL = 1.0, 0.1
"""Of the weakest colour of clear tissue, and its least level in [0, 1]: recordings have 0.08 to 0.09."""
MAX_TAKEN = 0.95
"""Most of the light that a veil takes before it is no longer measured."""


@dataclass(frozen=True, eq=False)
class _Seen:
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


class _Cells:
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

    def seen(self, row: int) -> _Seen:
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
        trust = np.where(inside & _usable(rgb) & _usable(self.rgb), trust, np.float32(0))
        return _Seen(index, np.asarray(rgb, np.float32), trust, x, y, depth_mm.reshape(size))

    def all_seen(self, rows: Iterable[int]) -> Iterator[_Seen]:
        """The cells in these rows, where enough of them are trusted."""
        return (seen for row in rows if (seen := self.seen(row)).trust.sum() > MIN_CELLS)


def find_veils(
    recorded: DepthClip, train: Sequence[int], tracks: Sequence[Tracks], clip: DepthClip
) -> tuple[Veil, ...]:
    """The veils before the left eye and, where the clip has one, the right eye; none where no smoke is found.

    Only training frames are read; the thickness of others is interpolated in time.

    Args:
        recorded: the clip as recorded.
        clip: the same, or with other colours; `tracks` follow its tissue through the training frames.
    """
    with one_opencv_thread():
        keys = [_Cells(recorded, clip, train, each) for each in tracks]
        if not _is_veiled(keys):
            return ()
        airlight = _airlight(keys)
        if airlight.mean() <= np.mean([key.rgb.mean() for key in keys]):  # smoke is brighter than tissue
            return ()
        left = _veil(recorded, keys, airlight).rounded()
        return (left,) if recorded.right is None else (left, _right_veil(recorded, train, left).rounded())


def _is_veiled(keys: Sequence[_Cells]) -> bool:
    """Whether offsets explain changes of colour along the tracks better than light does, and vary in the picture."""
    grey = np.full(3, 0.8, np.float32)

    def compare(sampled: tuple[_Cells, int]) -> tuple[float, float, float, float] | None:
        """Spread of b, squares with a veil and with light, and trust; None: too few cells."""
        key, row = sampled
        seen = key.seen(row)
        fit = _split(key.rgb, seen.rgb, seen.trust, grey, SEARCH_CELLS)
        covered = fit.cover > MIN_COVER
        if seen.trust.sum() <= MIN_CELLS or not covered.any():
            return None
        veil, light = (np.minimum(each, LOST) for each in (fit.squares, _light_squares(key.rgb, seen)))
        spread_of, trust = float(fit.offset[covered].std()), seen.trust
        return spread_of, float((trust * veil).sum()), float((trust * light).sum()), float(trust.sum())

    with ThreadPoolExecutor(cores()) as pool:
        found = [each for each in pool.map(compare, ((key, row) for key in keys for row in key.sampled)) if each]
    if not found:
        return False
    spreads, *sums = zip(*found, strict=True)
    with_veil, with_light, trusted = map(sum, sums)
    if with_veil > MAX_LOST * LOST * trusted:
        return False
    return float(np.median(spreads)) > MIN_SPREAD and with_veil < MAX_RESIDUAL**2 * with_light


@dataclass(frozen=True, eq=False)
class _Split:
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


def _split(start: Floats, there: Floats, trust: Floats, airlight: Floats, over: float) -> _Split:
    by_start, by_air = (there * start).sum(-1), there @ airlight
    starts, mixed, air = (start * start).sum(-1), start @ airlight, np.float32(airlight @ airlight)
    cover = _mean(trust, over)
    weight, least = trust, np.float32(1e-6)  # a window without trust has factor 1 and offset 0
    for _ in range(2):
        ss, sa, st, at = (_mean(weight * each, over) for each in (starts, mixed, by_start, by_air))
        aa = _mean(weight, over) * air + least
        ss, st = ss + least, st + least
        scale = 1 / np.maximum(ss * aa - sa * sa, least * least)
        factor, offset = (st * aa - sa * at) * scale, (ss * at - sa * st) * scale
        residual = there - factor[..., None] * start - offset[..., None] * airlight
        squares = np.square(residual).sum(-1)
        weight = trust / (1 + squares / np.float32(OUTLIER**2))
    return _Split(factor, offset, cover, squares, weight)


def _light_squares(start: Floats, seen: _Seen) -> Floats:
    """[h, w] squares of the residuals of a model without a veil: a tint of the frame and a factor of each window."""
    trusted = seen.trust > 0
    tint = np.median(seen.rgb[trusted] / start[trusted], axis=0)
    start = start * (tint / tint.mean()).astype(np.float32)
    products, starts, weight = (seen.rgb * start).sum(-1), (start * start).sum(-1), seen.trust
    for _ in range(2):
        least = np.float32(1e-6)
        factor = (_mean(weight * products, SEARCH_CELLS) + least) / (_mean(weight * starts, SEARCH_CELLS) + least)
        squares = np.square(seen.rgb - factor[..., None] * start).sum(-1)
        weight = seen.trust / (1 + squares / np.float32(OUTLIER**2))
    return np.asarray(squares, np.float32)


def _airlight(keys: Sequence[_Cells]) -> Floats:
    """[3] the colour of the offsets; its brightness is where offset and 1 - factor vary by as much."""
    airlight = np.full(3, 0.8, np.float32)
    for _ in range(3):
        total, factors, offsets, weights = np.zeros(3), list[Floats](), list[Floats](), list[Floats]()
        for key in keys:
            for seen in key.all_seen(key.sampled):
                fit = _split(key.rgb, seen.rgb, seen.trust, airlight, SEARCH_CELLS)
                residual = seen.rgb - fit.factor[..., None] * key.rgb
                total += ((fit.trust * fit.offset)[..., None] * residual).sum((0, 1))
                factors.append(fit.factor.ravel())
                offsets.append(fit.offset.ravel())
                weights.append(fit.trust.ravel())
        factor, offset, weight = (np.concatenate(each) for each in (factors, offsets, weights))
        brightness = float(airlight.mean()) * _deviation(offset, weight) / max(_deviation(factor, weight), 1e-6)
        colour = np.maximum(total, 0) / max(float(np.maximum(total, 0).mean()), 1e-9)
        airlight = np.clip(colour * np.clip(brightness, MIN_AIRLIGHT, MAX_AIRLIGHT), 0, 1).astype(np.float32)
    return airlight


def _deviation(values: Floats, weight: Floats) -> float:
    mean = np.average(values, weights=weight)
    return float(np.sqrt(np.average(np.square(values - mean), weights=weight)))


def _veil(clip: DepthClip, keys: Sequence[_Cells], airlight: Floats) -> Veil:
    """The veil before the left eye, from the splits of all tracked frames."""
    reference_mm = float(np.median(np.concatenate([key.depth_mm.ravel() for key in keys])))
    evens = [_even(key, airlight, reference_mm) for key in keys]
    mean = _mean_thickness(keys, evens, airlight)
    planes: dict[int, Floats] = {}
    for key, even in zip(keys, evens, strict=True):
        for seen, fit in _splits(key, airlight):
            taken = _offset(fit.offset, fit.factor, even, mean)
            thickness = -np.log(1 - taken) * np.float32(reference_mm) / seen.depth_mm
            planes[seen.frame] = _spread(thickness, seen) + planes.get(seen.frame, np.float32(0))
    return Veil(_at_all_times(clip, planes), airlight, reference_mm)


def _splits(key: _Cells, airlight: Floats) -> Iterator[tuple[_Seen, _Split]]:
    """The keyframe's cells in each tracked frame that shows enough of them, and their split."""

    def split(row: int) -> tuple[_Seen, _Split] | None:
        seen = key.seen(row)
        if seen.trust.sum() <= MIN_CELLS:
            return None
        return seen, _split(key.rgb, seen.rgb, seen.trust, airlight, SMOOTH_CELLS)

    with ThreadPoolExecutor(cores()) as pool:
        yield from (each for each in pool.map(split, range(len(key.frames))) if each is not None)


def _even(key: _Cells, airlight: Floats, reference_mm: float) -> Floats:
    """[3, h, w] means over the keyframe's frames of offset, factor, and depth as a share of the reference depth."""
    total, weight = np.zeros((3, *key.depth_mm.shape), np.float32), np.zeros(key.depth_mm.shape, np.float32)
    for seen, fit in _splits(key, airlight):
        cover = fit.cover + np.float32(1e-3)
        total += cover * np.stack([fit.offset, fit.factor, seen.depth_mm / np.float32(reference_mm)])
        weight += cover
    offset, factor, depth = total / np.maximum(weight, np.float32(1e-6))
    return np.stack([offset, np.maximum(factor, np.float32(0.1)), depth])


def _offset(offset: Floats, factor: Floats, even: Floats, mean: float) -> Floats:
    """Share of the airlight in cells whose mean over time has this thickness; less than 0 by measuring errors."""
    key = (1 - np.exp(-np.float32(mean) * even[2]) - even[0]) / even[1]
    return np.asarray(np.clip(offset + factor * key, -1, MAX_TAKEN), np.float32)


def _mean_thickness(keys: Sequence[_Cells], evens: list[Floats], airlight: Floats) -> float:
    """Thickness of the mean over time: the most with which the darkest tissue is dark and not darker, or the least
    with which no view has less than no smoke."""
    rgb, offset, factor, even = list[Floats](), list[Floats](), list[Floats](), list[Floats]()
    for key, means in zip(keys, evens, strict=True):
        for seen in key.all_seen(key.sampled):
            fit = _split(key.rgb, seen.rgb, seen.trust, airlight, SMOOTH_CELLS)
            trusted = np.flatnonzero(seen.trust)[::EVERY]
            rgb.append(seen.rgb.reshape(-1, 3)[trusted])
            offset.append(fit.offset.ravel()[trusted])
            factor.append(fit.factor.ravel()[trusted])
            even.append(means.reshape(3, -1)[:, trusted])
    colours, offsets, factors = (np.concatenate(each) for each in (rgb, offset, factor))
    mean_values = np.concatenate(even, axis=1)

    def too_thin(mean: float) -> bool:
        found = _offset(offsets, factors, mean_values, mean)
        clear = ((colours - found[:, None] * airlight) / (1 - found[:, None])).min(-1)
        return bool(np.percentile(found, LOW_PERCENTILE) < 0 or np.percentile(clear, LOW_PERCENTILE) > DARK_LEVEL)

    low, high = 0.0, MAX_THICKNESS
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if too_thin(middle) else (low, middle)
    return (low + high) / 2


def _spread(thickness: Floats, seen: _Seen) -> Floats:
    """[4, h, w] Gaussian means in the frame's own cells: sum and weight near by, and those farther away."""
    height, width = thickness.shape
    column, line = np.rint(seen.x).astype(np.intp), np.rint(seen.y).astype(np.intp)
    inside = (column >= 0) & (column < width) & (line >= 0) & (line < height) & (seen.trust > 0)
    cells, weight = (line * width + column)[inside], seen.trust[inside]
    planes = [np.bincount(cells, each, height * width) for each in (thickness[inside] * weight, weight)]
    return _near_and_far(*(plane.reshape(height, width).astype(np.float32) for plane in planes))


def _near_and_far(total: Floats, weight: Floats) -> Floats:
    """[4, h, w] means of a sum and its weight over SPREAD_CELLS, then over FAR_CELLS, on the veil's own grid."""
    size = tuple(-(-side // NODE_CELLS) for side in total.shape[::-1])
    means = (_mean(each, over) for over in (SPREAD_CELLS, FAR_CELLS) for each in (total, weight))
    return np.stack([np.asarray(cv2.resize(each, size, interpolation=cv2.INTER_AREA), np.float32) for each in means])


def _at_all_times(clip: DepthClip, planes: dict[int, Floats]) -> Floats:
    """[T, h, w] the thickness of every frame, linear in time between those whose means are given."""
    measured = sorted(planes)
    known, times_s = np.stack([_thickness(planes[frame]) for frame in measured]), clip.frame_times_s
    place = np.interp(times_s, times_s[measured], np.arange(len(measured)))
    before = np.minimum(place.astype(np.intp), max(len(measured) - 2, 0))
    share = (place - before).astype(np.float32)[:, None, None]
    return np.asarray((1 - share) * known[before] + share * known[np.minimum(before + 1, len(measured) - 1)])


def _thickness(planes: Floats) -> Floats:
    """[h, w] from means near by and farther away."""
    near, near_cover, far, far_cover = planes
    filled = far / np.maximum(far_cover, np.float32(1e-6))
    return np.asarray(np.maximum((near + LITTLE * filled) / (near_cover + LITTLE), 0), np.float32)


def _right_veil(clip: DepthClip, train: Sequence[int], left: Veil) -> Veil:
    """The veil before the right eye: its pixels are compared with the left eye's clear colours of the same tissue."""
    right = clip.right
    assert right is not None
    with ThreadPoolExecutor(cores()) as pool:
        found = list(pool.map(lambda index: _right_planes(clip, right, index, left), train))
    planes = {index: each for index, each in zip(train, found, strict=True) if each is not None}
    return Veil(_at_all_times(clip, planes), left.airlight, left.depth_mm) if planes else left


def _right_planes(clip: DepthClip, right: Eye, index: int, left: Veil) -> Floats | None:
    """[h, w] of a training frame; None where too little tissue is seen by both eyes."""
    height, width = clip.tissue.shape[1:]
    step = max(1, round(width / CELLS_ACROSS))
    line, column = np.mgrid[step // 2 : height - step // 2 : step, step // 2 : width - step // 2 : step]
    depth_mm = right.depth_mm[index][line, column]
    known = (depth_mm > 0) & right.tissue[index][line, column]
    pixels = (line * width + column).ravel()
    points = unproject(pixels, np.maximum(depth_mm, 1e-3).ravel(), right.intrinsics, right.world_from_camera[index])
    x, y, z = to_camera(points, clip.world_from_camera[index]).astype(np.float32).T
    k = clip.intrinsics
    u, v = (np.asarray(each, np.float32).reshape(line.shape) for each in (k.fx * x / z + k.cx, k.fy * y / z + k.cy))
    share = left.transmission(index, whole_depth_mm(clip, index))[..., None]
    clear = (clip.rgb[index] / np.float32(255) - (1 - share) * left.airlight) / share
    smooth = cv2.blur(np.asarray(clear, np.float32), (step, step))
    start = cv2.remap(smooth, u - 0.5, v - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    there = cv2.blur(right.rgb[index], (step, step))[line, column] / np.float32(255)
    inside = known & (u > 0) & (v > 0) & (u < width) & (v < height) & _usable(start) & _usable(there)
    clip.let_go(index)
    right.let_go(index)
    if inside.sum() < MIN_CELLS:
        return None
    trust = inside.astype(np.float32)
    fit = _split(start, np.asarray(there, np.float32), trust, left.airlight, SMOOTH_CELLS)
    taken = np.clip(fit.offset, 0, MAX_TAKEN)
    thickness = -np.log(1 - taken) * np.float32(left.depth_mm) / np.maximum(depth_mm, np.float32(1e-3))
    return _near_and_far(thickness * trust, trust)


def _usable(rgb: Floats) -> NDArray[np.bool_]:
    """[h, w] whether colours are neither noise nor clipped."""
    usable: NDArray[np.bool_] = cv2.inRange(rgb, (MIN_LEVEL,) * 3, (MAX_LEVEL,) * 3) > 0
    return usable


def _mean(values: Floats, over: float) -> Floats:
    """Gaussian mean with this standard deviation in cells."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), over, borderType=cv2.BORDER_REFLECT), np.float32)
