"""Finds frames that show no whole scene: empty, fading, smeared or torn pictures, a lost eye, frames that masks cover.

Symbols: T frames, h w pixels of a thumbnail (sampling.thumbnail).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.sampling import Thumbnail
from intrasplat.clip.sharpness import detail_of, relative_sharpness
from intrasplat.notices import Notice, NoticeCode, named_frames

PATCH_PX = 4
PATCH_CENTRES = slice(PATCH_PX // 2, None, PATCH_PX)
EMPTY, FADED = 0.2, 0.8
"""Contrast of an empty frame, and of a frame beside one that is still fading, as shares of the clip's median."""
KNOWN_PERCENTILE, UNKNOWN_PERCENTILE = 50.0, 95.0
"""Of the patches, where the field of view is known; where most of the picture may be outside it, or have no texture."""
FEW_PERCENTILE, MIN_CONTRAST_LEVELS = 90.0, 0.3
"""Of the training frames' contrast, where half of them are empty; the least contrast of one that shows something."""
MIN_TISSUE = 0.005
"""Share of a frame's pixels that masks must leave."""
SAME, OTHER = 0.1, 0.5
"""Largest and least change of a row, as shares of its usual change, that counts as none and as the usual one."""
MIN_CHANGE_LEVELS = 0.5
"""Rows that usually change less are not compared."""
MIN_COMPARED = 5
"""Frames from which the usual change of a row is measured."""
TORN_SHARE = 0.15
"""Least share of the picture's rows on either side of a tear."""

SMEARED_SHARPNESS = 0.45
"""Sharpness of a thumbnail beside those around it: 0.27 to 0.39 while the lens is wiped, 0.6 at a motion blur of 32 px
of 640, 0.84 and more in clean clips."""

EMPTY_FRAME, FADE, EYE_LOST, COVERED, TORN, SMEARED = (
    "show nothing", "fade", "show nothing to one eye", "are covered by masks", "are torn", "are smeared",
)  # fmt: skip


@dataclass(frozen=True)
class EmptyFrames:
    """Why each frame that shows no whole scene is left out, by its index."""

    reasons: Mapping[int, str] = field(default_factory=dict)

    @property
    def frames(self) -> tuple[int, ...]:
        """The frames, rising."""
        return tuple(sorted(self.reasons))

    def notices(self, frame_count: int) -> tuple[Notice, ...]:
        """A warning for each reason, for the report."""
        found = []
        for reason in dict.fromkeys(self.reasons.values()):
            frames = sorted(index for index, why in self.reasons.items() if why == reason)
            text = f"frames that {reason} were left out: {named_frames(frames)} ({len(frames)} of {frame_count:,})"
            if reason == COVERED:
                found.append(Notice.warning(NoticeCode.FRAMES_WITHOUT_TISSUE, text))
            else:
                found.append(Notice.warning(NoticeCode.FRAMES_SHOW_NOTHING, text))
        return tuple(found)


def find_empty(
    eyes: Sequence[Sequence[Thumbnail]],
    train: Sequence[int],
    fields: Sequence[NDArray[np.bool_] | None] = (),
    tissue_shares: Sequence[float] = (),
) -> EmptyFrames:
    """The frames of a clip that show no whole scene. Each is compared with the clip's training frames.

    Args:
        eyes: T thumbnails of each eye.
        train: the frames that are not held out, rising.
        fields: [H, W] field of view of each eye, None for the whole picture; none: not known.
        tissue_shares: T shares of each frame that the masks leave; none: no masks.
    """
    count = len(eyes[0])
    faded, torn, smeared = np.zeros((3, count), np.bool_)
    empty = np.zeros((len(eyes), count), np.bool_)
    for eye, (thumbnails, inside) in enumerate(zip(eyes, fields or [None] * len(eyes), strict=True)):
        patches = _patches_inside(inside, thumbnails[0].shape)
        for percentile in (KNOWN_PERCENTILE, UNKNOWN_PERCENTILE) if fields else (UNKNOWN_PERCENTILE,):
            contrast = np.array([_contrast(each, patches, percentile) for each in thumbnails])
            usual = float(np.median(contrast[train]))
            if usual < MIN_CONTRAST_LEVELS:  # most frames may be empty
                usual = float(np.percentile(contrast[train], FEW_PERCENTILE))
            if usual >= MIN_CONTRAST_LEVELS:
                break
        usual = max(usual, MIN_CONTRAST_LEVELS)
        empty[eye] = contrast < EMPTY * usual
        faint = contrast < FADED * usual
        faded[train] |= _fading(empty[eye][train], faint[train])
        left_out = faded | empty[eye]
        beside = np.concatenate([[False], left_out[:-1]]) | np.concatenate([left_out[1:], [False]])
        faded |= faint & beside & ~np.isin(np.arange(count), train)
        torn[train] |= _torn([thumbnails[index] for index in train])
        smeared |= _smeared(thumbnails, [index for index in train if not left_out[index]], inside)
    covered = np.zeros(count, np.bool_)
    covered[: len(tissue_shares)] = np.asarray(tissue_shares) < MIN_TISSUE
    reasons: dict[int, str] = {}
    for frames, reason in (
        (smeared, SMEARED), (torn, TORN), (covered, COVERED), (faded, FADE), (empty.any(axis=0), EYE_LOST),
        (empty.all(axis=0), EMPTY_FRAME),
    ):  # fmt: skip
        reasons |= dict.fromkeys(np.flatnonzero(frames).tolist(), reason)
    return EmptyFrames(reasons)


def _patches_inside(field: NDArray[np.bool_] | None, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """The patches of a thumbnail [h, w] that lie wholly in the field [H, W]; None: all of them."""
    if field is None or field.all():
        return None
    small = cv2.resize(field.astype(np.uint8) * 255, shape[::-1], interpolation=cv2.INTER_AREA)
    wholly = cv2.erode((small == 255).astype(np.uint8), np.ones((PATCH_PX + 1, PATCH_PX + 1), np.uint8))
    chosen = wholly[PATCH_CENTRES, PATCH_CENTRES] > 0
    return chosen if chosen.any() else None


def _contrast(thumbnail: Thumbnail, patches: NDArray[np.bool_] | None, percentile: float) -> float:
    """A percentile of the standard deviations of a thumbnail's patches, levels; None: of all patches."""
    size = (PATCH_PX, PATCH_PX)
    mean, square = cv2.blur(thumbnail, size), cv2.blur(np.square(thumbnail), size)
    deviation = np.sqrt(np.maximum(square - np.square(mean), 0))[PATCH_CENTRES, PATCH_CENTRES]
    return float(np.percentile(deviation if patches is None else deviation[patches], percentile))


def _fading(empty: NDArray[np.bool_], faint: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The faint frames [T] in runs that touch an empty frame."""
    found = empty.copy()
    for ordered, fades in ((found, faint), (found[::-1], faint[::-1])):
        for index in range(1, len(ordered)):
            ordered[index] |= ordered[index - 1] and fades[index]
    return found & ~empty


def _smeared(
    thumbnails: Sequence[Thumbnail], train: Sequence[int], field: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """Frames [T] of which nothing finer than a twentieth of the picture is left, as while the lens is wiped."""
    shape = thumbnails[0].shape
    inside = (
        None if field is None else cv2.resize(field.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_AREA) > 0
    )
    details = {index: detail for index, each in enumerate(thumbnails) if (detail := detail_of(each, inside))}
    found = np.zeros(len(thumbnails), np.bool_)
    for index, sharpness in relative_sharpness(details, train if details else ()).items():
        found[index] = sharpness < SMEARED_SHARPNESS
    return found


def _torn(thumbnails: Sequence[Thumbnail]) -> NDArray[np.bool_]:
    """Frames [T] whose upper or lower part is that of the frame before, while the other part has gone on."""
    found = np.zeros(len(thumbnails), np.bool_)
    if len(thumbnails) < MIN_COMPARED:
        return found
    changes = [np.abs(later - earlier).mean(axis=1) for earlier, later in pairwise(thumbnails)]
    usual = np.median(changes, axis=0)
    rows = np.flatnonzero(usual > MIN_CHANGE_LEVELS)
    least = max(2, round(TORN_SHARE * len(usual)))
    if len(rows) < len(usual) - least:
        return found
    for index, change in enumerate(changes, start=1):
        share = change[rows] / usual[rows]
        for ordered in (share, share[::-1]):
            resting = int(np.argmax(np.append(ordered, np.inf) > SAME))
            found[index] |= least <= resting <= len(rows) - least and bool((ordered[resting + 1 :] > OTHER).all())
    return found
