"""Finds the part of an eye's pictures that shows the scene: round fields, rectification's borders, black bars, labels.

What lies outside shows nothing in all pictures of the clip: it is black, or a bar of one colour. Labels and menus are
what both eyes show at the same pixels.

Symbols: H W pixels of one eye.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.sampling import Mapping
from intrasplat.clip.split import spread
from intrasplat.clip.types import RgbFrame
from intrasplat.intake.fit import check_not_all
from intrasplat.machine.mapped import let_go
from intrasplat.names import Fov
from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import FieldOfView, FieldShape

Mask = NDArray[np.bool_]
Levels = NDArray[np.uint8]  # [H, W]

SAMPLED, OUTLIERS, COMPARED = 24, 2, 8
"""Pictures that are read, spread over the clip; how many of them may be flashes; pairs in which labels are searched."""
BLUR_PX = 5
MAX_BLACK_LEVELS = 32.0
"""No picture's black is brighter: 16 is that of video of limited range that was read as one of full range."""
ABOVE_BLACK_LEVELS, ABOVE_NOISE = 6.0, 6.0
"""A pixel shows something if it is brighter than black by so many levels, and by so many times the noise of black."""
SIGMAS_A_DEVIATION = 1.4826
"""Standard deviations of a normal distribution in its median absolute deviation."""
MIN_OUTSIDE, MIN_FIELD = 0.002, 0.02
"""Shares of the picture: a smaller border is some dark pixels at an edge, a smaller field a light in a dark clip."""
OPENED_SHARE = 0.02
"""Share of the width: narrower bright parts, such as text on black, do not belong to the field."""
RIM_SHARE, MAX_RIM_SHARE, RIM_BRIGHTNESS = 0.005, 0.03, 0.75
"""The rim that is taken off the field, for codecs and lenses blur it: its least width, as a share of the picture's; its
greatest, as a share of the square root of the field's area. It ends at this share of the field's brightness."""
SLIVER_SHARE = 0.03
"""Share of the width: a dark part at the rim that cuts deeper into the field is tissue in shadow."""
SAME_LEVELS = 3.0
"""Largest differences within a bar, and between the eyes' pictures of a label."""
EDGE_LEVELS = 40.0
"""Least gradient (Sobel, 3 x 3) of a label's edges."""
LIKE_SHAPE = 0.93
"""Least share of a rectangle, or of a disc within the picture, that a field of this shape fills."""
LABEL_SHARE, MIN_LABEL = 0.015, 5e-4
"""Share of the width: gaps between a label's edges that are closed. Share of the picture: the smallest label."""
STROKE_LEVELS, STROKE_EDGE_LEVELS, STROKE_SHARE = 16.0, 150.0, 0.3
"""Of text without a background: largest difference between the eyes, for codecs blur it; least gradient of its edges;
least share of its area that these edges fill."""
AGREEING = 0.6
"""Share of the pairs in which an edge must lie at the same pixels in both eyes: the digits of a clock change."""


@dataclass(frozen=True, eq=False)
class Fields:
    """The fields of view [H, W] of a clip's eyes, and their entry in the report. None: the whole picture, or no eye."""

    left: Mask | None
    right: Mask | None
    entry: FieldOfView

    def tissue(self, tissue: Mask) -> Mask:
        """The left eye's tissue [H, W] in its field of view."""
        return tissue if self.left is None else tissue & self.left

    @property
    def notices(self) -> tuple[Notice, ...]:
        """The assumption for the report, where something of the pictures is left out."""
        if self.left is None and self.right is None:
            return ()
        given = "as given, " if self.entry.source == "given" else ""
        text = f"field of view: {given}{self.entry.shape}, {self.entry.share:.1%} of the picture"
        text += "" if self.entry.right_share is None else f" ({self.entry.right_share:.1%} of the right eye's)"
        text += f"; labels cover {self.entry.label_share:.1%}" if self.entry.label_share else ""
        return (Notice.info(NoticeCode.FIELD_OF_VIEW, f"{text}; nothing is modelled outside"),)


def find_fields(
    eyes: Sequence[NDArray[np.uint8]],
    frames: Sequence[int],
    fov: Fov,
    mapping: Mapping = map,
    given: Sequence[Mask] = (),
    *,
    may_coincide: bool = False,
) -> Fields:
    """The fields of view of a clip's eyes, one or two.

    Args:
        eyes: [T, H, W, 3] of each eye.
        frames: those that show something and are not held out.
        mapping: a replacement of map(), such as a thread pool's.
        given: [H, W] of the eyes whose field the caller gave, from the left one on; it stays as it is, labels included.
        may_coincide: whether both eyes may show tissue at the same pixels, so that labels cannot be found.

    Raises:
        InputError: a field is given, and fov is "all".
    """
    if given:
        check_not_all(fov)
    if fov == "all":
        right_share = 1.0 if len(eyes) > 1 else None
        return Fields(None, None, FieldOfView(source="all", share=1, shape="whole", right_share=right_share))
    chosen = spread(frames, SAMPLED)
    found = [*given, *mapping(lambda eye: find_field(_released(eye, chosen)), eyes[len(given) :])]
    shape = shape_of(found[0])
    label_share = 0.0
    if len(given) < len(eyes) > 1 and not may_coincide:
        pairs = [[eye[index] for eye in eyes] for index in spread(chosen, COMPARED)]
        label = find_labels(pairs, found[0] & found[1], mapping)
        label_share = float(label.mean())
        found[len(given) :] = [field & ~label for field in found[len(given) :]]
    shares = [float(field.mean()) for field in found]
    entry = FieldOfView(
        source="given" if given else "found",
        share=shares[0],
        shape=shape,
        right_share=shares[1] if len(eyes) > 1 else None,
        label_share=label_share,
    )
    fields = [None if field.all() else field for field in found]
    return Fields(fields[0], fields[1] if len(eyes) > 1 else None, entry)


def _released(rgb: NDArray[np.uint8], frames: Iterable[int]) -> Iterator[RgbFrame]:
    """The frames of rgb [T, H, W, 3]; each is released from memory when the next is requested."""
    for index in frames:
        yield rgb[index]
        let_go(rgb[index])


def find_field(pictures: Iterable[RgbFrame]) -> Mask:
    """[H, W] the pixels in the field of view of an eye's pictures [H, W, 3]; all of them if no border is found.

    pictures: some, spread over the clip. OUTLIERS of them may be flashes.
    """
    levels = np.stack([cv2.blur(rgb.max(axis=2), (BLUR_PX, BLUR_PX)) for rgb in pictures])
    outliers = OUTLIERS if len(levels) > 4 * OUTLIERS else 0
    ordered = np.partition(levels, (outliers, len(levels) - 1 - outliers), axis=0)
    darkest, brightest = ordered[outliers], ordered[len(levels) - 1 - outliers]
    outside = _black(brightest) | _bars(darkest, brightest)
    if float(outside.mean()) < MIN_OUTSIDE:
        return np.ones(outside.shape, np.bool_)
    width = outside.shape[1]
    inside = _largest(_opened(~outside, OPENED_SHARE * width))
    if float(inside.mean()) < MIN_FIELD:
        return np.ones(outside.shape, np.bool_)
    inside |= _shadows(inside, SLIVER_SHARE * width)
    if 1 - float(inside.mean()) < MIN_OUTSIDE:
        return np.ones(outside.shape, np.bool_)
    field = _without_rim(inside, brightest)
    return field if field.any() else inside


def _without_rim(inside: Mask, brightest: Levels) -> Mask:
    """The field [H, W] without the rim on which its brightness falls to black."""
    width = inside.shape[1]
    frame = cv2.copyMakeBorder(inside.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    away_px = cv2.distanceTransform(frame, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
    most_px = MAX_RIM_SHARE * float(np.sqrt(np.count_nonzero(inside)))
    within = inside & (away_px > most_px) & (away_px <= 2 * most_px)
    if not within.any():
        return inside
    usual = float(np.median(brightest[within]))
    rim_px = max(RIM_SHARE * width, BLUR_PX / 2 + 1)
    while rim_px < most_px:
        ring = inside & (away_px > rim_px) & (away_px <= rim_px + 1)
        if not ring.any() or float(np.median(brightest[ring])) >= RIM_BRIGHTNESS * usual:
            break
        rim_px += 1
    return np.asarray(away_px > rim_px)


def _black(brightest: Levels) -> Mask:
    """The pixels [H, W] that are never brighter than the black that touches the picture's border."""
    dark = _touching_border(brightest <= MAX_BLACK_LEVELS)
    if not dark.any():
        return dark
    level = float(np.median(brightest[dark]))
    noise = SIGMAS_A_DEVIATION * float(np.median(np.abs(brightest[dark] - level)))
    return _touching_border(brightest <= min(level + max(ABOVE_BLACK_LEVELS, ABOVE_NOISE * noise), MAX_BLACK_LEVELS))


def _bars(darkest: Levels, brightest: Levels) -> Mask:
    """Rows and columns [H, W] at the picture's border that have one colour in all pictures, from end to end."""
    found = np.zeros(brightest.shape, np.bool_)
    for least, most, mask in ((darkest, brightest, found), (darkest.T, brightest.T, found.T)):
        plain = most.max(axis=0).astype(np.float32) - least.min(axis=0) <= SAME_LEVELS
        if not plain.all():
            mask[:, : int(np.argmin(plain))] = True
            mask[:, len(plain) - int(np.argmin(plain[::-1])) :] = True
    return found


def find_labels(pairs: Sequence[Sequence[RgbFrame]], field: Mask, mapping: Mapping = map) -> Mask:
    """[H, W] labels and menus within the field: edges that both eyes show at the same pixels, where no tissue is at the
    same pixels in both. They have a background of their own, or are text over the tissue.

    Args:
        pairs: pictures [H, W, 3] of the left and the right eye, spread over the clip.
        mapping: a replacement of map(), such as a thread pool's.
    """
    width = field.shape[1]
    within = cv2.erode(field.astype(np.uint8), _disc(LABEL_SHARE * width)) > 0
    found = np.stack(list(mapping(lambda pair: _same_edges(*pair), pairs)))
    label = np.zeros(field.shape, np.bool_)
    for agreeing, least_share in zip(found.mean(axis=0) >= AGREEING, (0.0, STROKE_SHARE), strict=True):
        edges = agreeing & within
        closed = cv2.morphologyEx(edges.astype(np.uint8), cv2.MORPH_CLOSE, _disc(LABEL_SHARE * width))
        _, part, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
        area = stats[:, cv2.CC_STAT_AREA]
        large = (area >= MIN_LABEL * closed.size) & (np.bincount(part[edges], minlength=len(area)) > least_share * area)
        large[0] = False
        label |= large[part]
    return np.asarray(cv2.dilate(label.astype(np.uint8), _disc(RIM_SHARE * width)) > 0)


def _same_edges(left: RgbFrame, right: RgbFrame) -> Mask:
    """[2, H, W] edges that both pictures [H, W, 3] show at the same pixels: with their surroundings, and alone."""
    around = cv2.blur(cv2.absdiff(left, right).max(axis=2), (BLUR_PX, BLUR_PX)) <= SAME_LEVELS
    softened = (cv2.GaussianBlur(eye, (3, 3), 0) for eye in (left, right))
    alone = cv2.absdiff(*softened).max(axis=2) <= STROKE_LEVELS
    slopes = [_slope(eye) for eye in (left, right)]
    wide = np.minimum(*(cv2.dilate(each, np.ones((3, 3), np.uint8)) for each in slopes))
    return np.stack([around & (wide > EDGE_LEVELS), alone & (np.minimum(*slopes) > STROKE_EDGE_LEVELS)])


def _slope(rgb: RgbFrame) -> NDArray[np.float32]:
    """[H, W] gradient of the brightness (Sobel, 3 x 3), levels."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)), np.float32)


def _touching_border(pixels: Mask) -> Mask:
    """The connected parts of `pixels` [H, W] that touch the picture's border."""
    framed = cv2.copyMakeBorder(pixels.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    _, part = cv2.connectedComponents(framed, connectivity=4)
    return np.asarray((part[1:-1, 1:-1] == part[0, 0]) & pixels)


def _opened(pixels: Mask, side_px: float) -> Mask:
    """`pixels` without parts narrower than side_px; the picture's border does not count as an edge."""
    return np.asarray(cv2.morphologyEx(pixels.astype(np.uint8), cv2.MORPH_OPEN, _disc(side_px / 2)) > 0)


def filled(pixels: Mask, gap_px: float) -> Mask:
    """The largest part of pixels [H, W] that touch or are less than gap_px apart, with its holes."""
    return _largest(cv2.morphologyEx(pixels.astype(np.uint8), cv2.MORPH_CLOSE, _disc(gap_px / 2)) > 0)


def _largest(pixels: Mask) -> Mask:
    """The largest connected part, with its holes."""
    count, part, stats, _ = cv2.connectedComponentsWithStats(pixels.astype(np.uint8), connectivity=4)
    if count < 2:
        return pixels
    largest = part == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    return ~_touching_border(~largest)


def _shadows(inside: Mask, depth_px: float) -> Mask:
    """Dark parts [H, W] within the convex hull of the field that cut into it deeper than depth_px."""
    outline, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = np.zeros(inside.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(outline)), 1)
    bites = hull.astype(np.bool_) & ~inside
    away = cv2.distanceTransform(np.pad(hull, 1), cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
    count, part = cv2.connectedComponents(bites.astype(np.uint8), connectivity=4)
    deepest = np.zeros(count, np.float32)
    np.maximum.at(deepest, part[bites], away[bites])
    return np.asarray((deepest > depth_px)[part] & bites)


def _disc(radius_px: float) -> NDArray[np.uint8]:
    side = 2 * max(round(radius_px), 1) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def shape_of(field: Mask) -> FieldShape:
    """The shape of a field [H, W]."""
    if field.all():
        return "whole"
    points = np.argwhere(field)[:, ::-1].astype(np.float32)
    (x, y), radius = cv2.minEnclosingCircle(cv2.convexHull(points))
    disc = np.zeros(field.shape, np.uint8)
    cv2.circle(disc, (round(x), round(y)), round(radius), 1, -1)
    _, _, across, down = cv2.boundingRect(field.astype(np.uint8))
    if field.sum() > LIKE_SHAPE * across * down:
        return "rectangular"
    return "round" if field.sum() > LIKE_SHAPE * disc.sum() else "other"
