"""Check the pictures, masks and depth of a clip, and warn about what may harm its scene.

Symbols: T frames, H W pixels. No check reads held-out frames. Each compares a number with a bound that lies between
the numbers of clean clips, real and synthetic, and those that harm a scene (docs/decisions/evaluation.md).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.split import REPEAT_LEVELS
from intrasplat.clip.types import DepthClip
from intrasplat.fusion import CLEAR_CONFIDENCE
from intrasplat.notices import Notice, NoticeCode
from intrasplat.quality.lenses import lens_warnings
from intrasplat.train.scoring import sample_frames

MIN_FRAMES = 16
MIN_CONFIDENT_SHARE = 0.8
SMOOTH_LEVELS = 2.0
"""Standard deviation in 9 x 9 pixels, in grey levels of 255; below it stereo has only noise to match."""
MAX_SMOOTH_SHARE = 0.4
MIN_TISSUE_SHARE = 0.3
MAX_BRIGHTNESS_DRIFT = 0.25
"""Range of the median brightness over its mean; beyond it, changing illumination and motion are hard to tell apart."""
ANALYSED_WIDTH = 640
"""Larger pictures are shrunk to this width first: those of 4K endoscopes are soft at the pixel scale even in focus."""
DARK_PERCENTILE, MAX_DARK_LEVEL = 5.0, 85.0
"""A percentile of each pixel's weakest colour, and its limit of 255: clean clips have at most 68; a veil that takes a
quarter of the contrast gives 90."""
FOCUS_SIGMAS_PX = (1.0, 2.0)
MIN_FINE_DETAIL = 0.62
"""Detail below 1 px over that of 1 to 2 px: 0.71 to 1.7 in clean clips, 0.58 where all is blurred by 1.5 px."""
MIN_DETAIL_LEVELS = 0.4
"""Detail in grey levels of 255; below it there is nothing that could be sharp, and the texture check warns."""
MIN_DOUBTFUL_FRAMES = 2
"""Smallest number of bad frames among the sampled ones that counts: one alone may be an accident."""
MAX_COLOUR_DRIFT = 0.25
"""Range of the median red over green, or blue over green, over its mean."""
BLOOD_RATIO, MAX_FLOODED_SHARE = 3.0, 0.1
"""Red over green of blood, and by how much blood's share of the tissue may change: by 0.005 in clean clips."""
MAX_REPEATED_SHARE = 0.1
MAX_HIDDEN_SHARE = 0.4
MAX_FLICKER = 3
"""Frames: no instrument leaves the picture and returns within so few."""
MIN_INSTRUMENT = 0.02
"""Share of the picture; less may be an instrument's tip that appears and disappears."""
SURE = 128
"""Smallest depth_confidence (of 255) that is checked; another check warns about less confident depth."""
DEPTH_JUMP, MAX_JUMPING_SHARE = 0.1, 0.03
"""Relative jump of depth between frames, and the tissue's share that may jump: 0.012 in clean clips, 0.05 with gross
errors on 0.05."""
MAX_PAIRS = 8


def clip_warnings(clip: DepthClip, train: Sequence[int]) -> list[Notice]:
    """Warnings about the clip itself; no check reads held-out frames."""
    sampled = sample_frames(train)
    found = []
    if len(train) < MIN_FRAMES:
        found.append(
            Notice.warning(
                NoticeCode.FEW_FRAMES, f"Only {len(train)} frames were trained on; motion between them is guessed."
            )
        )
    field_share = clip.field_pixels / clip.tissue[0].size
    tissue_share = float(np.mean([clip.tissue[index].mean() for index in clip.one_by_one(train)])) / field_share
    if tissue_share < MIN_TISSUE_SHARE:
        found.append(
            Notice.warning(
                NoticeCode.LITTLE_TISSUE,
                f"Only {tissue_share:.0%} of the field of view counts as tissue. If the masks are inverted, "
                "set mask_polarity.",
            )
        )
    if tissue_share > 1 - 1e-9:
        text = "No instrument is masked anywhere: an instrument in the clip is modelled as if it were tissue."
        if clip.masks is not None and clip.masks.source == "none":
            text += ' Give masks, or let mask_source "auto" find them.'
        found.append(Notice.warning(NoticeCode.NO_INSTRUMENT_MASKED, text))
    confident = _share_of_tissue(clip, sampled, lambda index: clip.depth_confidence[index] >= CLEAR_CONFIDENCE)
    if confident < MIN_CONFIDENT_SHARE:
        found.append(
            Notice.warning(
                NoticeCode.STEREO_UNSURE,
                f"Stereo depth is missing or unsure on {1 - confident:.0%} of the tissue; the shape there "
                "is interpolated.",
            )
        )
    smooth = _share_of_tissue(clip, sampled, lambda index: _roughness(clip.rgb[index]) < SMOOTH_LEVELS)
    if smooth > MAX_SMOOTH_SHARE:
        found.append(
            Notice.warning(
                NoticeCode.NO_TEXTURE,
                f"{smooth:.0%} of the tissue has no texture, so stereo and motion are guessed there.",
            )
        )
    of_pictures = picture_warnings(clip, sampled)
    if all(each.code is not NoticeCode.BLOOD for each in of_pictures):  # blood is dark
        found += _brightness_warnings(clip, sampled)
    return found + of_pictures + lens_warnings(clip, train) + sequence_warnings(clip, train)


def picture_warnings(clip: DepthClip, sampled: Sequence[int]) -> list[Notice]:
    """Warnings about the pictures of the sampled training frames: veiled, out of focus, changing colour."""
    seen = [index for index in clip.one_by_one(sampled) if clip.tissue[index].any()]
    if not seen:
        return []
    found = []
    dark = {index: _darkest(clip, index) for index in clip.one_by_one(seen)}
    pale = [index for index, level in dark.items() if level > MAX_DARK_LEVEL]
    if len(pale) >= min(MIN_DOUBTFUL_FRAMES, len(seen)):
        found.append(
            Notice.warning(
                NoticeCode.VEILED,
                f"Even the dark tissue is pale about frames {pale[0]} to {pale[-1]}, up to {max(dark.values()):.0f} of "
                "255 in every colour: smoke, a fogged lens or too much light takes its contrast, and the model shows "
                "the veil as if it were tissue.",
            )
        )
    return found + _focus_warnings(clip, seen) + _colour_warnings(clip, seen)


def sequence_warnings(clip: DepthClip, train: Sequence[int]) -> list[Notice]:
    """Warnings about the sequence of training frames: repeated, hidden at first, with masks or depth that jump."""
    found = []
    pairs = list(itertools.pairwise(train))
    repeated = 0
    for earlier, later in pairs:
        repeated += _repeats(clip.rgb[earlier], clip.rgb[later])
        clip.let_go(earlier)
    if repeated > MAX_REPEATED_SHARE * len(train):
        found.append(
            Notice.warning(
                NoticeCode.REPEATED_FRAMES,
                f"{repeated} of {len(train)} training frames repeat the one before: motion stands still there and then "
                "jumps. Give the frames as recorded, without those that were filled in.",
            )
        )
    hidden = np.zeros(clip.tissue.shape[1:], np.bool_)
    for index in clip.one_by_one(train[1:]):
        hidden |= clip.tissue[index]
    share = float((hidden & ~clip.tissue[train[0]]).mean()) if train else 0.0
    if share > MAX_HIDDEN_SHARE:
        found.append(
            Notice.warning(
                NoticeCode.HIDDEN_AT_FIRST,
                f"Masks hide {share:.0%} of the picture in the first frame that later ones show; there the model "
                "starts from those.",
            )
        )
    flickering = _flickering(np.array([1 - clip.tissue[index].mean() for index in clip.one_by_one(train)]))
    if flickering:
        found.append(
            Notice.warning(
                NoticeCode.MASK_GAPS,
                f"{flickering} frames have no mask although those before and after have: their instrument is modelled "
                "as if it were tissue.",
            )
        )
    return found + _depth_warnings(clip, train)


def _focus_warnings(clip: DepthClip, frames: Sequence[int]) -> list[Notice]:
    measured = [_fine_detail(clip, index) for index in clip.one_by_one(frames)]
    detail = np.array([each for each in measured if each is not None])
    if not detail.size:
        return []
    if np.median(detail) >= MIN_FINE_DETAIL:
        return []
    text = "The picture has no fine detail: it is out of focus, or was enlarged; the scene is as soft."
    return [Notice.warning(NoticeCode.OUT_OF_FOCUS, text)]


def _colour_warnings(clip: DepthClip, frames: Sequence[int]) -> list[Notice]:
    """Warn about blood that appears, or else about a white balance that drifts."""
    flooded = float(np.ptp([_blood_share(clip, index) for index in clip.one_by_one(frames)]))
    if flooded > MAX_FLOODED_SHARE:
        return [
            Notice.warning(
                NoticeCode.BLOOD,
                f"Blood covers {flooded:.0%} more of the tissue in some frames than in others: what it hides there is "
                "not seen, and it has no texture to follow.",
            )
        ]
    ratios = np.array([_colour_ratios(clip, index) for index in clip.one_by_one(frames)])
    drift = np.ptp(ratios, axis=0) / np.maximum(ratios.mean(axis=0), 1e-6)
    if drift.max() <= MAX_COLOUR_DRIFT:
        return []
    worst = int(drift.argmax())
    low, high = ratios[:, worst].min(), ratios[:, worst].max()
    return [
        Notice.warning(
            NoticeCode.COLOUR_CHANGES,
            f"The tissue's colour changes during the clip ({('red', 'blue')[worst]} over green from {low:.2f} to "
            f"{high:.2f}): the white balance drifts, and the model shows it.",
        )
    ]


def _depth_warnings(clip: DepthClip, train: Sequence[int]) -> list[Notice]:
    """Warn if the depth of much tissue jumps by a tenth within a frame: no tissue moves so fast, so depth is wrong.

    Depths are compared at the pixels to which the camera's motion takes the tissue.
    """
    still = set(clip.skipped)
    following = {one: two for one, two in itertools.pairwise(train) if still.issuperset(range(one + 1, two))}
    jumps, total = 0, 0
    for index in clip.one_by_one(list(following)[:: -(-len(following) // MAX_PAIRS) or 1]):
        pair = (index, following[index])
        before, after = _depths_of_both(clip, *pair)
        jumps += int((np.abs(after - before) > DEPTH_JUMP * before).sum())
        total += before.size
        clip.let_go(pair[1])
    if jumps <= MAX_JUMPING_SHARE * total:
        return []
    return [
        Notice.warning(
            NoticeCode.DEPTH_JUMPS,
            f"Depth jumps by more than {DEPTH_JUMP:.0%} from one frame to the next on {jumps / total:.0%} of the "
            "tissue: much of it is wrong, and so are distances in this scene.",
        )
    ]


def _depths_of_both(clip: DepthClip, one: int, two: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depths [M] in the second frame: of the first frame's tissue if it stayed in place, and as measured there."""
    k, pose = clip.intrinsics, clip.world_from_camera
    sure, there = (clip.tissue[i] & (clip.depth_confidence[i] >= SURE) for i in (one, two))
    if (pose[one] == pose[two]).all():
        return clip.depth_mm[one][sure & there], clip.depth_mm[two][sure & there]
    rows, columns = np.nonzero(sure)
    z = clip.depth_mm[one][sure].astype(np.float64)
    points = np.stack([(columns + 0.5 - k.cx) * z / k.fx, (rows + 0.5 - k.cy) * z / k.fy, z], axis=1)
    motion = np.linalg.inv(pose[two]) @ pose[one]
    x, y, depth = (points @ motion[:3, :3].T + motion[:3, 3]).T
    ahead = np.maximum(depth, 1e-3)
    column, row = np.floor(k.fx * x / ahead + k.cx), np.floor(k.fy * y / ahead + k.cy)
    inside = (depth > 0) & (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height)
    row, column, depth = row[inside].astype(np.intp), column[inside].astype(np.intp), depth[inside].astype(np.float32)
    seen = there[row, column]
    return depth[seen], clip.depth_mm[two][row[seen], column[seen]]


def _pixels(clip: DepthClip, index: int) -> NDArray[np.uint8]:
    """Colours [M, 3] of the tissue in every other row and column; of all of it where that is little."""
    rgb, tissue = clip.rgb[index], clip.tissue[index]
    sparse: NDArray[np.uint8] = rgb[::2, ::2][tissue[::2, ::2]]
    return sparse if len(sparse) else np.asarray(rgb[tissue])


def _brightness_warnings(clip: DepthClip, sampled: Iterable[int]) -> list[Notice]:
    shown = (clip.rgb[index][clip.tissue[index]] for index in clip.one_by_one(sampled))
    medians = [float(np.median(pixels)) for pixels in shown if pixels.size]
    mean = float(np.mean(medians)) if medians else 0.0
    if mean == 0 or (max(medians) - min(medians)) / mean <= MAX_BRIGHTNESS_DRIFT:
        return []
    return [
        Notice.warning(
            NoticeCode.BRIGHTNESS_CHANGES,
            f"The tissue's brightness changes from {min(medians):.0f} to {max(medians):.0f} of 255 during the clip; "
            "the model may take changing light for motion.",
        )
    ]


def _share_of_tissue(clip: DepthClip, frames: Iterable[int], holds: Callable[[int], NDArray[np.bool_]]) -> float:
    """Share of all tissue pixels of these frames for which `holds` is true; NaN without tissue."""
    kept, total = 0, 0
    for index in clip.one_by_one(frames):
        kept += int((clip.tissue[index] & holds(index)).sum())
        total += int(clip.tissue[index].sum())
    return kept / total if total else math.nan


def _roughness(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Standard deviation of grey in 9 x 9 pixels, [H, W], of 255."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.blur(grey, (9, 9))
    variance = cv2.blur(grey * grey, (9, 9)) - mean * mean
    return np.asarray(np.sqrt(np.maximum(variance, 0)), dtype=np.float32)


def _darkest(clip: DepthClip, index: int) -> float:
    return float(np.percentile(_pixels(clip, index).min(axis=1), DARK_PERCENTILE))


def _blood_share(clip: DepthClip, index: int) -> float:
    """Share of the tissue that is as red as blood."""
    pixels = _pixels(clip, index).astype(np.float32)
    return float((pixels[:, 0] > BLOOD_RATIO * np.maximum(pixels[:, 1], 1)).mean())


def _colour_ratios(clip: DepthClip, index: int) -> tuple[float, float]:
    """Median red over green and blue over green of the tissue."""
    red, green, blue = np.maximum(_pixels(clip, index).astype(np.float32), 1).T
    return float(np.median(red / green)), float(np.median(blue / green))


def _fine_detail(clip: DepthClip, index: int) -> float | None:
    """Deviation of the detail finer than 1 px over that of 1 to 2 px, on tissue away from masks; None without any."""
    grey = cv2.cvtColor(clip.rgb[index], cv2.COLOR_RGB2GRAY).astype(np.float32)
    tissue = clip.tissue[index].astype(np.uint8)
    if (width := grey.shape[1]) > ANALYSED_WIDTH:
        size = (ANALYSED_WIDTH, round(grey.shape[0] * ANALYSED_WIDTH / width))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        tissue = cv2.resize(tissue, size, interpolation=cv2.INTER_NEAREST)
    inside = cv2.erode(tissue, np.ones((9, 9), np.uint8)) > 0
    if not inside.any():
        inside = tissue > 0
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in FOCUS_SIGMAS_PX)
    coarser_levels = float((fine - coarse)[inside].std())
    return float((grey - fine)[inside].std()) / coarser_levels if coarser_levels > MIN_DETAIL_LEVELS else None


def _repeats(earlier: NDArray[np.uint8], later: NDArray[np.uint8]) -> bool:
    """Whether two frames show the same picture (intrasplat/clip/split.py). Every 8th row comes first, for speed."""
    return all(
        cv2.norm(earlier[::step], later[::step], cv2.NORM_L1) < REPEAT_LEVELS * earlier[::step].size for step in (8, 1)
    )


def _flickering(instrument: NDArray[np.floating]) -> int:
    """Number of frames without instrument in gaps of at most MAX_FLICKER. instrument: [T] its share of the picture."""
    masked = np.flatnonzero(instrument >= MIN_INSTRUMENT)
    gaps = [
        range(before + 1, after)
        for before, after in itertools.pairwise(masked)
        if 1 < after - before <= MAX_FLICKER + 1
    ]
    return sum(1 for gap in gaps for index in gap if instrument[index] == 0)
