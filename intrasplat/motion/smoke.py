"""Find the veil of smoke before each eye, along tracks of the tissue.

The same tissue is seen with more and with less smoke: along a track, colour there = a colour in the keyframe + b
airlight. Light that changes is a factor, a alone; smoke is an offset, b, in a part of the picture or of the frames.
Where some frames are clear, tracks are compared with those. Of smoke that all frames have alike, tracks show nothing:
its mean over time is taken as even, and as thick as leaves the darkest tissue dark.

Symbols: T frames, K frames of a keyframe's tracks, h w cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import to_camera, unproject
from intrasplat.clip import DepthClip, Eye, spread
from intrasplat.machine.cores import cores
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.motion.cell_colours import CELLS_ACROSS, MIN_CELLS, OUTLIER, Cells, Seen, Split, smooth, split, usable
from intrasplat.motion.lifted import Floats
from intrasplat.motion.tracks import Tracks
from intrasplat.motion.veil import Veil, whole_depth_mm

NODE_CELLS = 4
"""Cells across a node of the veil's grid, so that a 640 px wide picture has a node every 16 px."""
SMOOTH_CELLS, SEARCH_CELLS = 3.0, 5.0
"""Standard deviation of the windows in which a and b are fitted; of those that decide whether there is a veil."""
SPREAD_CELLS, FAR_CELLS = 1.5, 12.0
"""Standard deviation of the mean in a frame's own cells, and of the one that fills in where no track ends."""
LITTLE = np.float32(0.02)
"""Weight of what fills in; full trust has 1."""
MAX_RESIDUAL, MIN_SHARE, MIN_FACTOR = 0.65, 0.18, 0.15
"""Of a window with smoke: most error of a and b as a share of that of a alone with a tint for each frame; least share
of the light that smoke takes; least a, for where no tissue shines through, another thing hides it."""
MIN_AREA, MIN_FRAMES, MIN_FRAME_SHARE = 0.04, 2, 0.125
"""Least share of a frame's windows with smoke, and least such frames of those that are compared."""
GREY = np.full(3, 0.8, np.float32)
"""The airlight before it is measured."""
LOST, MAX_LOST = 0.01, 0.4
"""Most that a cell's squared residual counts, and most of their mean, as a share of it: where tracks find other tissue,
an offset explains colours better than light, too. Clips have 0.1 to 0.25."""
MIN_COVER = 0.2
"""Least trust of a window that is compared."""
MIN_AIRLIGHT, MAX_AIRLIGHT = 0.5, 1.0
"""Of the mean of R G B; smoke is lit by the endoscope itself, so it is bright."""
MAX_THICKNESS, HALVINGS = 2.0, 7
"""Most of the mean over time, and how often its range is halved to find it."""
EVERY = 7
"""Every how many cells' colours decide it."""
LOW_PERCENTILE, DARK_LEVEL = 1.0, 0.1
"""Of the weakest colour of clear tissue, and its least level in [0, 1]: recordings have 0.08 to 0.09."""
FLOOR_FRAMES, THINNED = 32, 3
"""Most frames of a keyframe among which clear ones are looked for; every how many cells along a side are compared."""
CLEAR_SHARE, CLEAR_AREA, CLEAR_RANK = 0.06, 0.9, 0.1
"""Clear frames have less than CLEAR_SHARE of smoke above the least in CLEAR_AREA of their cells. A cell's least has
this rank among the frames, as a share of them."""
MAX_DARK = 0.25
"""Most of LOW_PERCENTILE of the weakest colour in a clear frame. Phantoms have 0.16 to 0.2."""
MAX_TAKEN = 0.95
"""Most of the light that a veil takes before it is no longer measured."""


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
        keys = [Cells(recorded, clip, train, each) for each in tracks]
        if not _is_veiled(keys):
            return ()
        airlight = _airlight(keys)
        if airlight.mean() <= np.mean([key.rgb.mean() for key in keys]):  # smoke is brighter than tissue
            return ()
        left = _veil(recorded, keys, airlight).rounded()
        return (left,) if recorded.right is None else (left, _right_veil(recorded, train, left).rounded())


def _is_veiled(keys: Sequence[Cells]) -> bool:
    """Whether offsets explain colours better than light does, in a part of the picture and in several frames."""

    def compare(sampled: tuple[Cells, int]) -> tuple[bool, float, float] | None:
        """Whether the frame or its keyframe shows a veil, squares with one, and trust; None: too few cells."""
        key, row = sampled
        seen = key.seen(row)
        fit = split(key.rgb, seen.rgb, seen.trust, GREY, SEARCH_CELLS)
        covered = int((fit.cover > MIN_COVER).sum())
        if seen.trust.sum() <= MIN_CELLS or not covered:
            return None
        windows = int(_veiled_windows(key.rgb, seen.rgb, seen.trust, fit).sum())
        if fit.offset.min() < -MIN_SHARE:  # the keyframe may have more smoke
            back = split(seen.rgb, key.rgb, seen.trust, GREY, SEARCH_CELLS)
            windows += int(_veiled_windows(seen.rgb, key.rgb, seen.trust, back).sum())
        squares = np.minimum(fit.squares, LOST)
        return windows > MIN_AREA * covered, float((seen.trust * squares).sum()), float(seen.trust.sum())

    with ThreadPoolExecutor(cores()) as pool:
        found = [each for each in pool.map(compare, ((key, row) for key in keys for row in key.sampled)) if each]
    if not found:
        return False
    veiled, squares, trusted = map(sum, zip(*found, strict=True))
    return bool(squares <= MAX_LOST * LOST * trusted and veiled >= max(MIN_FRAMES, MIN_FRAME_SHARE * len(found)))


def _veiled_windows(start: Floats, there: Floats, trust: Floats, fit: Split) -> NDArray[np.bool_]:
    """[h, w] windows in which smoke takes some of the light, and explains colours better than light does.

    fit: of the colours there, in windows of SEARCH_CELLS.
    """
    veil, light = (np.minimum(each, LOST) for each in (fit.squares, _light_squares(start, there, trust)))
    better = smooth(trust * veil, SEARCH_CELLS) < MAX_RESIDUAL**2 * smooth(trust * light, SEARCH_CELLS)
    smoky = (fit.offset > MIN_SHARE * (fit.factor + fit.offset)) & (fit.factor > MIN_FACTOR)
    return np.asarray(better & smoky & (fit.cover > MIN_COVER))


def _light_squares(start: Floats, there: Floats, trust: Floats) -> Floats:
    """[h, w] squares of the residuals of a model without a veil: a tint of the frame and a factor of each window."""
    trusted = trust > 0
    tint = np.median(there[trusted] / start[trusted], axis=0)
    start = start * (tint / tint.mean()).astype(np.float32)
    products, starts, weight = (there * start).sum(-1), (start * start).sum(-1), trust
    for _ in range(2):
        least = np.float32(1e-6)
        factor = (smooth(weight * products, SEARCH_CELLS) + least) / (smooth(weight * starts, SEARCH_CELLS) + least)
        squares = np.square(there - factor[..., None] * start).sum(-1)
        weight = trust / (1 + squares / np.float32(OUTLIER**2))
    return np.asarray(squares, np.float32)


def _airlight(keys: Sequence[Cells]) -> Floats:
    """[3] the colour of the offsets; its brightness is where offset and 1 - factor vary by as much."""
    airlight = GREY
    for _ in range(3):
        total, factors, offsets, weights = np.zeros(3), list[Floats](), list[Floats](), list[Floats]()
        for key in keys:
            for seen in key.all_seen(key.sampled):
                fit = split(key.rgb, seen.rgb, seen.trust, airlight, SEARCH_CELLS)
                residual = seen.rgb - fit.factor[..., None] * key.rgb
                total += ((fit.trust * fit.offset)[..., None] * residual).sum((0, 1))
                factors.append(fit.factor.ravel())
                offsets.append(fit.offset.ravel())
                weights.append(fit.trust.ravel())
        factor, offset, weight = (np.concatenate(each) for each in (factors, offsets, weights))
        fall = _slope(offset, factor, weight)
        brightness = float(airlight.mean()) / max(-fall, 1e-6)
        colour = np.maximum(total, 0) / max(float(np.maximum(total, 0).mean()), 1e-9)
        airlight = np.clip(colour * np.clip(brightness, MIN_AIRLIGHT, MAX_AIRLIGHT), 0, 1).astype(np.float32)
    return airlight


def _slope(x: Floats, y: Floats, weight: Floats) -> float:
    """By how much y changes as x does, in least squares."""
    x, y = x - np.average(x, weights=weight), y - np.average(y, weights=weight)
    return float((weight * x * y).sum() / max(float((weight * x * x).sum()), 1e-9))


def _veil(clip: DepthClip, keys: Sequence[Cells], airlight: Floats) -> Veil:
    """The veil before the left eye, from the splits of all tracked frames."""
    reference_mm = float(np.median(np.concatenate([key.depth_mm.ravel() for key in keys])))
    clear = [_clear_rows(key, airlight) for key in keys]
    rows = [some or range(len(key.frames)) for key, some in zip(keys, clear, strict=True)]
    evens = [_even(key, some, airlight, reference_mm) for key, some in zip(keys, rows, strict=True)]
    never = [place for place, some in enumerate(clear) if not some]
    mean = _mean_thickness([keys[place] for place in never], [evens[place] for place in never], airlight)
    planes: dict[int, Floats] = {}
    for key, even, some in zip(keys, evens, clear, strict=True):
        for seen, fit in _splits(key, range(len(key.frames)), airlight):
            taken = _offset(fit.offset, fit.factor, even, 0.0 if some else mean)
            thickness = -np.log(1 - taken) * np.float32(reference_mm) / seen.depth_mm
            planes[seen.frame] = _spread(thickness, seen) + planes.get(seen.frame, np.float32(0))
    return Veil(_at_all_times(clip, planes), airlight, reference_mm)


def _splits(key: Cells, rows: Iterable[int], airlight: Floats) -> Iterator[tuple[Seen, Split]]:
    """The keyframe's cells in each of these rows that shows enough of them, and their split."""

    def look(row: int) -> tuple[Seen, Split] | None:
        seen = key.seen(row)
        if seen.trust.sum() <= MIN_CELLS:
            return None
        return seen, split(key.rgb, seen.rgb, seen.trust, airlight, SMOOTH_CELLS)

    with ThreadPoolExecutor(cores()) as pool:
        yield from (each for each in pool.map(look, rows) if each is not None)


def _clear_rows(key: Cells, airlight: Floats) -> list[int]:
    """Rows of frames without smoke; empty: there are too few. Smoke moves, so frames that have the least of it in the
    whole picture are clear if they are several. That the darkest tissue is pale in them shows that they are not."""
    rows, compared, darkest = list[int](), list[Floats](), list[float]()
    row_of = {frame: row for row, frame in enumerate(key.frames)}
    for seen, fit in _splits(key, spread(range(len(key.frames)), FLOOR_FRAMES), airlight):
        rows.append(row_of[seen.frame])
        covered = np.where(fit.cover > MIN_COVER, np.float32(1), np.float32(np.nan))
        compared.append((covered * np.stack([fit.offset, np.maximum(fit.factor, MIN_FACTOR)]))[:, ::THINNED, ::THINNED])
        darkest.append(float(np.percentile(seen.rgb[seen.trust > 0].min(-1), LOW_PERCENTILE)))
    if not rows:
        return []
    offset, factor = np.stack(compared, axis=1)
    known = np.isfinite(offset)
    implied = np.sort(np.where(known, offset / factor, np.inf), axis=0)  # less the keyframe's share if there is none
    least = np.take_along_axis(implied, (CLEAR_RANK * known.sum(0, keepdims=True)).astype(np.intp), 0)
    alike = known & (offset - factor * least < CLEAR_SHARE)
    clear = alike.sum((1, 2)) > CLEAR_AREA * known.sum((1, 2))
    if clear.sum() < max(MIN_FRAMES, MIN_FRAME_SHARE * len(rows)) or np.median(np.array(darkest)[clear]) > MAX_DARK:
        return []
    return [row for row, is_clear in zip(rows, clear, strict=True) if is_clear]


def _even(key: Cells, rows: Iterable[int], airlight: Floats, reference_mm: float) -> Floats:
    """[3, h, w] means over these rows of offset, factor, and depth as a share of the reference depth."""
    total, weight = np.zeros((3, *key.depth_mm.shape), np.float32), np.zeros(key.depth_mm.shape, np.float32)
    for seen, fit in _splits(key, rows, airlight):
        cover = fit.cover + np.float32(1e-3)
        total += cover * np.stack([fit.offset, fit.factor, seen.depth_mm / np.float32(reference_mm)])
        weight += cover
    offset, factor, depth = total / np.maximum(weight, np.float32(1e-6))
    return np.stack([offset, np.maximum(factor, np.float32(0.1)), depth])


def _offset(offset: Floats, factor: Floats, even: Floats, mean: float) -> Floats:
    """Share of the airlight in cells whose mean over time has this thickness; less than 0 by measuring errors."""
    key = (1 - np.exp(-np.float32(mean) * even[2]) - even[0]) / even[1]
    return np.asarray(np.clip(offset + factor * key, -1, MAX_TAKEN), np.float32)


def _mean_thickness(keys: Sequence[Cells], evens: Sequence[Floats], airlight: Floats) -> float:
    """Thickness of the mean over time: the most with which the darkest tissue is dark and not darker, or the least
    with which no view has less than no smoke; 0 where no frame shows enough of a keyframe."""
    rgb, offset, factor, even = list[Floats](), list[Floats](), list[Floats](), list[Floats]()
    for key, means in zip(keys, evens, strict=True):
        for seen in key.all_seen(key.sampled):
            fit = split(key.rgb, seen.rgb, seen.trust, airlight, SMOOTH_CELLS)
            trusted = np.flatnonzero(seen.trust)[::EVERY]
            rgb.append(seen.rgb.reshape(-1, 3)[trusted])
            offset.append(fit.offset.ravel()[trusted])
            factor.append(fit.factor.ravel()[trusted])
            even.append(means.reshape(3, -1)[:, trusted])
    if not rgb:
        return 0.0
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


def _spread(thickness: Floats, seen: Seen) -> Floats:
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
    means = (smooth(each, over) for over in (SPREAD_CELLS, FAR_CELLS) for each in (total, weight))
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
    inside = known & (u > 0) & (v > 0) & (u < width) & (v < height) & usable(start) & usable(there)
    clip.let_go(index)
    right.let_go(index)
    if inside.sum() < MIN_CELLS:
        return None
    trust = inside.astype(np.float32)
    fit = split(start, np.asarray(there, np.float32), trust, left.airlight, SMOOTH_CELLS)
    taken = np.clip(fit.offset, 0, MAX_TAKEN)
    thickness = -np.log(1 - taken) * np.float32(left.depth_mm) / np.maximum(depth_mm, np.float32(1e-3))
    return _near_and_far(thickness * trust, trust)
