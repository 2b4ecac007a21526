"""Finds instruments in one picture: less red than tissue, in front of it, and entering from the border.

Symbols: H W pixels; h w pixels of the coarse picture; nearness: proportional to 1 / depth.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Rgb = NDArray[np.uint8]  # [H, W, 3]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Bits = NDArray[np.uint8]

COARSE_WIDTH, FINE_WIDTH = 160, 320
"""Widths, px, of the reduced pictures in which instruments, then their outlines, are searched."""
SMOOTHNESS, COLOUR_SIGMA = 5.0, 10.0
MIN_WEIGHT = 1e-9
BEHIND_SHARE = 0.26
"""Window, as a share of the width: the tissue behind an instrument has the least nearness in it."""
DARK_LEVELS = 20.0
"""Added to the denominator of redness, so that black has no colour."""
MIN_REDNESS = 0.05
"""Minimum median redness of tissue; with less, the picture has no colours."""
GREY, SLIGHTLY_FRONT, FRONT = 0.45, 0.02, 0.10
"""Maximum redness of an instrument, relative to the tissue's; minimum relative nearness in front of the background, for
a candidate and for a clear sign."""
MIN_AREA = 0.001
OUTLINE_PX, GAP_PX = 9, 2
"""Window in which both sides of an outline are compared; width of the outline that is ignored."""
STEP, REDNESS_STEP = 0.04, 0.3
"""Steps across an outline that count: relative fall of nearness; rise of redness, relative to the tissue's."""
FRONT_BETWEEN, STEPS_BETWEEN, STEP_BETWEEN, COLOURED_BETWEEN = (0.2, 0.6), (0.4, 0.8), (0.02, 0.10), (0.3, 0.9)
"""Values for certain tissue and certain instrument: share of a candidate that is in front; share of its outline with a
step in depth; median step in depth; share of its outline with a step in redness."""
ZONE_SHARE, TIP_SHARE, TIP_QUANTILE, LOCAL_SHARE = 0.0125, 0.05, 0.85, 0.2
"""Shares of the width, and a quantile: distance of the fine outline from the coarse one; the same at the tip; distance
from the entry (quantile) where the tip starts; window of the surrounding tissue's redness."""
MAX_LOCAL_REDNESS, TIP_FRONT = 1.2, 0.05
"""Upper limit of the surrounding tissue's redness; minimum relative nearness of pixels added at a tip."""
BORDER_PX = 2
"""Width of the coarse picture's border."""
CLOSED_PX, GROWN_PX = 3, 3
DARK_EDGE, COLOURED_EDGE = 0.6, 0.15
"""Signs of an instrument's edge: maximum brightness relative to the surrounding tissue's; minimum difference of
(green - blue) / (green + blue) from it."""
ENTRY_SHARE = 0.05
"""Share of the width. Beside the field's left edge, which the right eye hardly sees, masks extend so far without
depth."""
COLOURLESS, MAX_LIGHT, MIN_COLOURED = 0.18, 1.25, 0.9
"""Signs of an instrument that lies on tissue: maximum relative redness; maximum brightness relative to the picture's,
because highlights have no colour either; minimum share of its outline with a step in redness."""
REDDISH, REDDISH_STEP, MIN_REDDISH_OUTLINE, MIN_IN_FRONT = 0.7, 0.15, 0.6, 0.7
"""Signs of an instrument that reflects tissue: maximum relative redness; step in redness, and minimum share of its
outline with it; minimum score of its depth."""
UNSURE = 0.5
"""Minimum score of a masked candidate; the score of instruments that reflect tissue."""


class Colour(NamedTuple):
    """Images [h, w] of a picture, or of the tissue around its pixels.

    redness     (red - green) / (red + green), relative to the tissue's
    brightness  of the brightest channel, 0 to 255
    hue         (green - blue) / (green + blue)
    """

    redness: Image
    brightness: Image
    hue: Image


@dataclass(frozen=True, eq=False)
class Looked:
    """A picture of H W pixels, reduced to FINE_WIDTH and to COARSE_WIDTH.

    field  [h, w] of the coarse picture: its field of view
    """

    size: tuple[int, int]
    fine: Rgb
    coarse: Rgb
    field: Mask

    @classmethod
    def at(cls, rgb: Rgb, field: Mask | None = None) -> Looked:
        """The reduced forms of a picture [H, W, 3]. field: [H, W]; None: the whole picture."""
        height, width = rgb.shape[:2]
        fine = cv2.resize(rgb, (FINE_WIDTH, round(height * FINE_WIDTH / width)), interpolation=cv2.INTER_AREA)
        coarse_size = (COARSE_WIDTH, round(height * COARSE_WIDTH / width))
        inside = np.ones(coarse_size[::-1], np.bool_)
        if field is not None:
            inside = (
                cv2.resize(field.astype(np.uint8) * np.uint8(255), coarse_size, interpolation=cv2.INTER_AREA) == 255
            )
        return cls((height, width), fine, cv2.resize(fine, coarse_size, interpolation=cv2.INTER_AREA), inside)

    @property
    def border(self) -> Mask:
        """The pixels [h, w] of the coarse picture at its border, or at that of its field of view."""
        frame = cv2.copyMakeBorder(self.field.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
        return np.asarray(cv2.erode(frame, _box(2 * BORDER_PX + 1))[1:-1, 1:-1] == 0)


@dataclass(frozen=True)
class TissueLook:
    """The colour of a clip's tissue: the median of (red - green) / (red + green)."""

    redness: float

    @classmethod
    def of(cls, pictures: Iterable[Rgb], field: Mask | None = None) -> TissueLook:
        """The tissue's colour in pictures [H, W, 3] whose field of view [H, W] mostly shows tissue."""
        looked = (Looked.at(each, field) for each in pictures)
        return cls(float(np.median([np.median(_redness(each.coarse)[each.field]) for each in looked])))


@dataclass(frozen=True, eq=False)
class FoundMask:
    """Instruments in a picture.

    tool    [H, W] True on instruments
    seen    share of the picture that might be instruments
    clear   the part of it that was classified clearly: from 0 to `seen`
    missed  share of the picture that has an instrument's colour and is not masked
    """

    tool: Mask
    seen: float
    clear: float
    missed: float = 0.0


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Pixels [h, w] without tissue's colour, and their score `likely`: 0 for tissue, 1 for an instrument."""

    pixels: Mask
    likely: float


def smooth_nearness(rgb: Rgb, nearness: Image, trust: Image) -> Image:
    """Nearness [h, w], filled and smoothed up to colour edges of the picture [h, w, 3]; trust [h, w] is in [0, 1]."""
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(rgb, SMOOTHNESS, COLOUR_SIGMA)
    weighted, weight = smoother.filter(nearness * trust), smoother.filter(trust)
    smooth: Image = weighted / np.maximum(weight, np.float32(MIN_WEIGHT))
    return smooth


def find_instruments(picture: Looked, nearness: Image, look: TissueLook) -> FoundMask:
    """The instruments in a picture.

    Args:
        nearness: [h, w] at coarse size, as smooth_nearness gives it.
    """
    if look.redness < MIN_REDNESS:
        return FoundMask(np.zeros(picture.size, np.bool_), 1.0, 0.0)
    candidates = _candidates(picture, nearness, look)
    found = [each for each in candidates if each.likely >= UNSURE]
    areas = [float(each.pixels.mean()) for each in candidates]
    clear = sum(area * abs(2 * each.likely - 1) for area, each in zip(areas, candidates, strict=True))
    in_front = _in_front(nearness) > TIP_FRONT
    tool = _outlined(picture, found, in_front, look) if found else np.zeros(picture.size, np.bool_)
    return FoundMask(tool, sum(areas), clear, _missed(picture, look, tool))


def _candidates(picture: Looked, nearness: Image, look: TissueLook) -> list[_Candidate]:
    """Areas at the border without tissue's colour and not behind their surroundings; then areas that reflect tissue."""
    redness = cv2.GaussianBlur(_redness(picture.coarse), (3, 3), 0)
    grey = cv2.morphologyEx((redness < GREY * look.redness).astype(np.uint8), cv2.MORPH_OPEN, _box(2))
    front = _in_front(nearness)
    part = _closed(grey, 5) & (front > SLIGHTLY_FRONT) & picture.field
    part = cv2.morphologyEx(part.astype(np.uint8), cv2.MORPH_OPEN, _box(3))
    redness /= np.float32(look.redness)
    found = [_Candidate(each, _likely(each, front, nearness, redness)) for each in _areas(part, picture.border)]
    taken = np.zeros(part.shape, np.uint8)
    for each in found:
        taken |= each.pixels & (each.likely >= UNSURE)
    free = cv2.dilate(taken, _box(2 * GAP_PX + 1)) == 0
    part = _closed((redness < REDDISH).astype(np.uint8), 5) & (front > SLIGHTLY_FRONT) & free & picture.field
    part = cv2.morphologyEx(part.astype(np.uint8), cv2.MORPH_OPEN, _box(3))
    reddish = (each for each in _areas(part, picture.border) if _mirrors(each, front, nearness, redness))
    return found + [_Candidate(each, UNSURE) for each in reddish]


def _mirrors(pixels: Mask, front: Image, nearness: Image, redness: Image) -> bool:
    """Whether an area looks like an instrument that reflects tissue: by depth and a slight step in redness."""
    (near, beyond), (own, around) = _across_outline(pixels, nearness, redness)
    if not near.size or float((around - own > REDDISH_STEP).mean()) < MIN_REDDISH_OUTLINE:
        return False
    return _by_depth(front[pixels], near, beyond) >= MIN_IN_FRONT


def _areas(part: Bits, border: Mask | None = None) -> Iterator[Mask]:
    """The connected areas [h, w] of at least MIN_AREA that touch the border [h, w]; None: wherever they are."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(np.asarray(part, np.uint8), connectivity=4)
    for j in range(1, count):
        pixels = label == j
        if stats[j, cv2.CC_STAT_AREA] >= MIN_AREA * part.size and (border is None or (border & pixels).any()):
            yield pixels


def _missed(picture: Looked, look: TissueLook, tool: Mask) -> float:
    """Share of the picture that is unmasked and colourless: instruments are, and hardly any tissue is."""
    height, width = picture.coarse.shape[:2]
    masked = cv2.resize(tool.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0
    free = cv2.dilate(masked.astype(np.uint8), _box(OUTLINE_PX // 2 + 1)) == 0
    redness = cv2.GaussianBlur(_redness(picture.coarse), (3, 3), 0) / np.float32(look.redness)
    light = cv2.GaussianBlur(picture.coarse.max(axis=2).astype(np.float32), (3, 3), 0)
    colourless = cv2.morphologyEx((redness < COLOURLESS).astype(np.uint8), cv2.MORPH_OPEN, _box(3))
    share = 0.0
    for pixels in _areas(colourless & free & picture.field):
        ((own, around),) = _across_outline(pixels, redness)
        if own.size and float((around - own > REDNESS_STEP).mean()) > MIN_COLOURED:
            share += float(pixels.mean()) * float(np.median(light[pixels]) < MAX_LIGHT * np.median(light))
    return share


def _in_front(nearness: Image) -> Image:
    """Relative nearness [h, w] of each pixel in front of the surrounding tissue: (own - behind) / behind."""
    behind = cv2.morphologyEx(nearness, cv2.MORPH_OPEN, _box(round(BEHIND_SHARE * nearness.shape[1]) | 1))
    front: Image = (nearness - behind) / np.maximum(behind, np.float32(1e-6))
    return front


def _likely(pixels: Mask, front: Image, nearness: Image, redness: Image) -> float:
    """The score of a candidate in [0, 1]: the lower one of depth and colour."""
    (near, beyond), (own, around) = _across_outline(pixels, nearness, redness)
    if not near.size:
        return 0.0
    by_colour = _ramp(float((around - own > REDNESS_STEP).mean()), COLOURED_BETWEEN)
    return min(_by_depth(front[pixels], near, beyond), by_colour)


def _by_depth(front: Image, near: Image, beyond: Image) -> float:
    """Score in [0, 1] of an area's depth: front [n] of its pixels; nearness inside and outside its outline."""
    steps = (near - beyond) / np.maximum(beyond, np.float32(1e-6))
    signs = (
        _ramp(float((front > FRONT).mean()), FRONT_BETWEEN),
        _ramp(float((steps > STEP).mean()), STEPS_BETWEEN),
        _ramp(float(np.median(steps)), STEP_BETWEEN),
    )
    return sum(signs) / len(signs)


def _across_outline(pixels: Mask, *images: Image) -> list[tuple[Image, Image]]:
    """For each image [h, w], its local means inside and outside the outline, one value per pixel of the outline.

    The outline at the picture's border does not count.
    """
    whole = pixels.astype(np.uint8)
    core = cv2.erode(whole, _box(3), borderValue=1)
    inside = core.astype(np.float32)
    outside = (cv2.dilate(whole, _box(2 * GAP_PX + 1)) == 0).astype(np.float32)
    many_in, many_out = _mean(inside, OUTLINE_PX), _mean(outside, OUTLINE_PX)
    outline = (whole > core) & (many_in > 0.02) & (many_out > 0.02)
    return [
        (
            _mean(inside * each, OUTLINE_PX)[outline] / many_in[outline],
            _mean(outside * each, OUTLINE_PX)[outline] / many_out[outline],
        )
        for each in images
    ]


def _ramp(value: float, between: tuple[float, float]) -> float:
    """0 below the interval, 1 above it, linear inside."""
    low, high = between
    return min(max((value - low) / (high - low), 0.0), 1.0)


def _outlined(picture: Looked, candidates: Sequence[_Candidate], in_front: Mask, look: TissueLook) -> Mask:
    """Mask [H, W] of the candidates, up to where redness is half-way between their own and the surrounding tissue's.

    Edges of another kind follow (_edge). The mask grows by a rim, because matching and blur extend over the outline.
    """
    size = picture.fine.shape[1::-1]
    enlarged = [_resized(each.pixels, size) for each in candidates]
    colour, tissue = _colour(picture.fine, look), _around(picture, candidates, look)
    redness, around = colour.redness, np.minimum(tissue.redness, MAX_LOCAL_REDNESS)
    entry_px = round(ENTRY_SHARE * COARSE_WIDTH)
    strip = picture.field & (np.cumsum(picture.field, axis=1) <= entry_px)
    found = np.zeros(size[::-1], np.uint8)
    for each, whole in zip(candidates, enlarged, strict=True):
        core = cv2.erode(whole, _box(3), borderValue=1)
        own = float(np.median(redness[core > 0])) if core.any() else 0.2
        beyond = (_around_tip(each.pixels, picture.border) & in_front) | (
            strip & (cv2.dilate(each.pixels.view(np.uint8), _box(2 * entry_px + 1)) > 0)
        )
        zone = cv2.dilate(whole, _zone(size[0])) | _resized(beyond, size)
        like = ((redness < (own + around) / 2) & (zone > 0)).astype(np.uint8) | core
        found |= _closed(_connected(like, core), CLOSED_PX)
    found = cv2.dilate(found | _edge(found, colour, tissue), _box(GROWN_PX))
    tool: Mask = cv2.resize(found * np.uint8(255), picture.size[::-1], interpolation=cv2.INTER_LINEAR) > 127
    return tool


def _edge(found: Bits, colour: Colour, tissue: Colour) -> Bits:
    """An instrument [h, w] with the pixels beside it that are darker than the surrounding tissue or of another hue: its
    shaded side, its shadow, and coloured parts that reflect tissue."""
    beside = cv2.dilate(found, _zone(found.shape[1]))
    is_dark = colour.brightness < np.float32(DARK_EDGE) * tissue.brightness
    other = is_dark | (cv2.absdiff(colour.hue, tissue.hue) > COLOURED_EDGE)
    return _closed(_connected(found | (other & beside), found), CLOSED_PX)


def _colour(rgb: Rgb, look: TissueLook) -> Colour:
    """The colour of a picture, smoothed."""
    smooth = cv2.GaussianBlur(rgb, (3, 3), 0)
    red, green, blue = (each.astype(np.float32) for each in cv2.split(smooth))
    hue = (green - blue) / (green + blue + np.float32(DARK_LEVELS))
    return Colour(_redness(smooth) / np.float32(look.redness), cv2.max(cv2.max(red, green), blue), hue)


def _around(picture: Looked, candidates: Sequence[_Candidate], look: TissueLook) -> Colour:
    """The mean colour of the tissue around each pixel of the fine picture.

    Where none is near it is that of all tissue; NaN without any.
    """
    width, size = picture.coarse.shape[1], picture.fine.shape[1::-1]
    taken = np.logical_or.reduce([each.pixels for each in candidates]).view(np.uint8)
    is_tissue = picture.field & (cv2.dilate(taken, _zone(width)) == 0)
    weight, window, little = is_tissue.astype(np.float32), round(LOCAL_SHARE * width) | 1, np.float32(1e-3)
    count, means = _mean(weight, window) + little, []
    for each in _colour(picture.coarse, look):
        overall = np.float32(each[is_tissue].mean() if is_tissue.any() else np.nan)
        mean = (_mean(each * weight, window) + little * overall) / count
        means.append(cv2.resize(mean, size, interpolation=cv2.INTER_LINEAR))
    return Colour(*means)


def _zone(width: int) -> Bits:
    """The square around a pixel of a picture of that width in which the outline is searched."""
    return _box(2 * round(ZONE_SHARE * width) + 1)


def _connected(like: Bits, core: Bits) -> Bits:
    """The areas [h, w] of `like` that contain a pixel of `core`."""
    count, label = cv2.connectedComponents(like, connectivity=8)
    chosen = np.zeros(count, np.uint8)
    chosen[label[core > 0]] = 1
    chosen[0] = 0
    connected: Bits = chosen[label]
    return connected


def _around_tip(pixels: Mask, border: Mask) -> Mask:
    """Pixels [h, w] near an instrument's tip, the part farthest from where it enters the picture."""
    row, column = np.nonzero(pixels)
    enters = border[row, column]
    away = np.hypot(row - row[enters].mean(), column - column[enters].mean())
    far = away >= np.quantile(away, TIP_QUANTILE)
    other = np.ones(pixels.shape, np.uint8)
    other[row[far], column[far]] = 0
    near: Mask = cv2.distanceTransform(other, cv2.DIST_L2, 3) <= TIP_SHARE * pixels.shape[1]
    return near


def _redness(rgb: Rgb) -> Image:
    red, green = rgb[..., 0].astype(np.float32), rgb[..., 1].astype(np.float32)
    redness: Image = (red - green) / (red + green + np.float32(DARK_LEVELS))
    return redness


def _resized(pixels: Mask, size: tuple[int, int]) -> Bits:
    resized: Bits = cv2.resize(pixels.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return resized


def _closed(bits: Bits, side_px: int) -> Bits:
    """The mask with gaps of less than side_px closed, also at the picture's border."""
    wide = cv2.copyMakeBorder(bits, side_px, side_px, side_px, side_px, cv2.BORDER_REPLICATE)
    closed: Bits = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, _box(side_px))[side_px:-side_px, side_px:-side_px]
    return closed


def _mean(image: Image, side_px: int) -> Image:
    mean: Image = cv2.boxFilter(image, -1, (side_px, side_px))
    return mean


def _box(side_px: int) -> Bits:
    return np.ones((side_px, side_px), np.uint8)
