"""Instrument masks: which pixels are tissue, and how white was interpreted.

Masks show the left eye or both eyes. Masks of both eyes are two videos or one image per frame and eye, distinguished by
name, or are packed into one picture like frames. The left eye alone determines the meaning of white.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.files import FileTree, check_exists, open_tree
from intrasplat.clip.images import ImageSequence, open_images
from intrasplat.clip.mask_levels import MASK_THRESHOLD, MaskLevels, read_levels
from intrasplat.clip.naming import check_aligned, left_eye_only, right_eye_only
from intrasplat.clip.packing import Packing, by_severity, halves, packing_by_size
from intrasplat.clip.video import VideoFile, open_video, open_video_in
from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.names import MaskPolarity
from intrasplat.notices import Notice, NoticeCode

BrightClass = Literal["tool", "tissue"]  # what a white pixel means

MAX_TOOL_SHARE = 0.4  # of the area: by look, a larger class is never taken as the instrument
MAX_PARTS = 4
"""Classes besides tissue: shaft, wrist, jaws and another part. Where there are more, some may be organs."""
_FIELD = "masks"
_POLARITY_REMEDY = 'Say mask_polarity "tool" if white marks instruments, "tissue" if white marks tissue.'
_LEVELS_REMEDY = (
    'Write 255 on instruments and 0 elsewhere; or say mask_polarity "tool" if all levels but the lowest are '
    'instruments, "tissue" if all but the highest are.'
)


@dataclass(frozen=True)
class TissueMasks:
    """Tissue pixels, tissue [T, H, W] bool, True = tissue, with the assumption behind them and warnings.

    right is the same for the right eye; None if the masks show the left eye alone. given: False if there are no masks.
    remarks: what is good to know of masks in a video. damaged: indices of its damaged frames.
    """

    tissue: NDArray[np.bool_]
    assumption: Notice
    warnings: tuple[Notice, ...] = ()
    right: NDArray[np.bool_] | None = None
    given: bool = True
    remarks: tuple[Notice, ...] = ()
    damaged: tuple[int, ...] = ()


@dataclass(frozen=True)
class MaskFrames:
    """Masks of known number and size, not decoded yet, because a small file may decode to gigabytes.

    right has the right eye's masks if the names distinguish eyes; frames are then the left eye's alone.
    """

    frames: ImageSequence | VideoFile
    right: ImageSequence | VideoFile | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(T, H, W) of `frames`."""
        return self.frames.frame_count, self.frames.height, self.frames.width

    def packing(self, shape: tuple[int, int, int]) -> Packing | None:
        """The packing of both eyes' masks in each picture, for a clip of `shape` (T, H, W); None: it shows one eye."""
        return packing_by_size(self.shape[1:], shape[1:]) if self.right is None else None


def open_masks(path: Path, limits: ClipLimits) -> MaskFrames:
    """The masks in a video, or in a zip or folder of images, one video or two. InputError, LimitError."""
    check_exists(path, _FIELD)
    tree = open_tree(path, _FIELD, limits)
    if tree is None:
        return MaskFrames(open_video(path, _FIELD, limits))
    return own_masks(tree) or _masks_named(tree, tree.images(), tree.videos())


def own_masks(tree: FileTree) -> MaskFrames | None:
    """The masks in a clip's folder masks or mask; None if there are none. InputError, LimitError."""
    images, videos = _in_mask_folders(tree.images()), _in_mask_folders(tree.videos())
    return _masks_named(tree, images, videos) if images or videos else None


def _in_mask_folders(names: tuple[str, ...]) -> tuple[str, ...]:
    folders = {"masks", "mask"}
    return tuple(name for name in names if folders & {part.lower() for part in PurePosixPath(name).parts[:-1]})


def _masks_named(tree: FileTree, images: tuple[str, ...], videos: tuple[str, ...]) -> MaskFrames:
    return _mask_videos(tree, videos) if videos and not images else _mask_images(tree, images)


def _mask_videos(tree: FileTree, names: tuple[str, ...]) -> MaskFrames:
    left, right = left_eye_only(names), right_eye_only(names)
    if len(left) > 1 or len(right) > 1:
        raise InputError(
            _FIELD,
            f"{tree.label} holds {len(names)} videos ({', '.join(names[:4])}).",
            "Keep one video of masks, or two named left and right.",
        )
    return MaskFrames(open_video_in(tree, left[0]), open_video_in(tree, right[0]) if right else None)


def _mask_images(tree: FileTree, names: tuple[str, ...]) -> MaskFrames:
    left, right = left_eye_only(names), right_eye_only(names)
    if not right:
        return MaskFrames(open_images(tree, left))
    check_aligned(_FIELD, left, right)
    return MaskFrames(open_images(tree, left), open_images(tree, right))


def no_masks(*, ignored: bool = False) -> Notice:
    """The assumption for a clip without masks, or with masks that are ignored."""
    return Notice.info(NoticeCode.MASKS, f"masks: none {'used' if ignored else 'given'}, every pixel is tissue")


def tissue_from_masks(
    masks: MaskFrames,
    shape: tuple[int, int, int],
    polarity: MaskPolarity,
    by_layout: tuple[str, BrightClass] | None = None,
    *,
    both_eyes: bool = False,
) -> TissueMasks:
    """The tissue pixels from masks. The masks are decoded only if their number and size fit `shape` (T, H, W).

    The caller determines what white means (`polarity`), else the layout (its name and meaning of white), else the look:
    the tool is the class that touches the border in most frames and covers less than 40 % of the area.
    both_eyes: the tissue of the right eye, too, if the masks show it.
    InputError if the masks do not fit, contradict the layout, mark nothing, leave no tissue, or look ambiguous.
    """
    packing = masks.packing(shape) if both_eyes else None
    _check_shape(masks.shape, (shape[0], *masks.shape[1:]) if packing else shape, "left")
    if both_eyes and masks.right is not None:
        _check_shape((masks.right.frame_count, masks.right.height, masks.right.width), shape, "right")
    levels, right_values = _levels_of_eyes(masks, packing, both_eyes=both_eyes)
    above_lowest, highest = levels.thresholds
    white_tissue = levels.values >= highest if levels.several else None
    white_tool = _white(levels.values, above_lowest)
    bright, reason = _bright_class(white_tool, white_tissue, levels, polarity, by_layout)
    if levels.has_colours and bright == "tissue":
        problem = f"the masks have {levels.colours} colours, and it is not clear which are tissue."
        raise InputError(_FIELD, problem, "Write 255 on instruments and 0 elsewhere.")
    tissue = white_tool if white_tissue is None or bright == "tool" else white_tissue
    right = None if right_values is None else _white(right_values, above_lowest if bright == "tool" else highest)
    if bright == "tool":
        for eye in (tissue, right):
            if eye is not None:
                np.logical_not(eye, out=eye)
    assumption = Notice.info(NoticeCode.MASKS, f"masks: {_classes(levels, bright)} ({reason})")
    sequences = (masks.frames,) if masks.right is None else (masks.frames, masks.right)
    remarks, warned = by_severity(sequences)
    warnings = (*_level_warnings(levels, bright), *_tissue_warnings(tissue, right), *warned)
    damaged = tuple(sorted({index for each in sequences for index in each.damaged}))
    if damaged and not both_eyes:
        raise InputError(_FIELD, f"{len(damaged)} of its frames are damaged.", "Export the masks again, as PNG.")
    return TissueMasks(tissue, assumption, warnings, right, True, remarks, damaged)


def _classes(levels: MaskLevels, bright: BrightClass) -> str:
    """Which levels are the instrument, as text."""
    if set(levels.thresholds) == {MASK_THRESHOLD}:
        return f"white is {bright}"
    tissue = levels.levels[0 if bright == "tool" else -1]
    others = [str(each) for each in levels.levels if each != tissue]
    one = len(others) == 1
    return f"level{'' if one else 's'} {', '.join(others)} {'is' if one else 'are'} instrument, {tissue} is tissue"


def _level_warnings(levels: MaskLevels, bright: BrightClass) -> tuple[Notice, ...]:
    if not levels.several:
        return ()
    classes = "all colours but black are instrument" if levels.has_colours else _classes(levels, bright)
    text = (
        f"the masks have {levels.colours} classes, taken as parts of instruments: {classes}; if one of them "
        "is an organ, give masks of the instruments alone"
    )
    return (Notice.warning(NoticeCode.MASK_LEVELS, text),)


def _tissue_warnings(tissue: NDArray[np.bool_], right: NDArray[np.bool_] | None) -> tuple[Notice, ...]:
    """Warnings about the left eye's tissue. InputError if either eye shows no tissue."""
    for eye in (tissue, right):
        if eye is not None and not eye.any():
            which = "" if right is None else f" of the {'left' if eye is tissue else 'right'} eye"
            raise InputError(_FIELD, f"every pixel of every mask{which} is tool.", _POLARITY_REMEDY)
    warnings = []
    if tissue.all():
        warnings.append(Notice.warning(NoticeCode.MASKS_MARK_NOTHING, "the masks mark no instrument in any frame"))
    return tuple(warnings)


def _levels_of_eyes(
    masks: MaskFrames, packing: Packing | None, *, both_eyes: bool
) -> tuple[MaskLevels, NDArray[np.uint8] | None]:
    """The left eye's masks, and the right eye's values [T, H, W] if masks show it and both_eyes is set.

    InputError if the images have nonzero values but no level that could be white.
    """
    read = read_levels(masks.frames)
    largest = int(read.values.max())
    if isinstance(masks.frames, ImageSequence) and len(read.levels) < 2 and 0 < largest < MASK_THRESHOLD:
        raise InputError(
            _FIELD, f"the largest value in the masks is {largest} of 255.", "Write masks with the values 0 and 255."
        )
    if packing is not None:
        left, right = (np.stack(eye) for eye in zip(*(halves(each, packing) for each in read.values), strict=True))
        return replace(read, values=left), right
    return read, read_levels(masks.right).values if both_eyes and masks.right is not None else None


def _white(values: NDArray[np.uint8], threshold: int) -> NDArray[np.bool_]:
    """Where values reach the threshold, in the place of the values: masks may fill much of the memory."""
    return np.greater_equal(values, threshold, out=values.view(np.bool_))


def _bright_class(
    white_tool: NDArray[np.bool_],
    white_tissue: NDArray[np.bool_] | None,
    levels: MaskLevels,
    polarity: MaskPolarity,
    by_layout: tuple[str, BrightClass] | None,
) -> tuple[BrightClass, str]:
    """What white means, and the reason as text.

    white_tool are the bright pixels if these are the instrument, white_tissue if they are tissue; None: the same.
    """
    if polarity != "auto":
        return polarity, "as specified"
    if white_tool.all() or not white_tool.any():
        colour = "white" if white_tool.any() else "black"
        raise InputError(
            _FIELD,
            f"every mask is {colour} all over, so nothing is marked.",
            "Leave the masks out if no instrument shows. " + _POLARITY_REMEDY,
        )
    remedy, share = _POLARITY_REMEDY, f"white covers {100 * white_tool.mean():.0f} % of the area"
    if levels.several:
        remedy, share = _LEVELS_REMEDY, f"levels of 255: {levels}"
        if levels.colours - 1 > MAX_PARTS:
            problem = f"the masks have {levels.colours} classes, perhaps organs among them ({share})."
            raise InputError(_FIELD, problem, remedy)
    look = _bright_class_by_look(white_tool, white_tool if white_tissue is None else white_tissue)
    if by_layout is not None:
        layout, bright = by_layout
        if look in (None, bright):
            return bright, f"the {layout} layout's rule"
        raise InputError(
            _FIELD, f"the {layout} layout says white is {bright}, the masks look inverted ({share}).", remedy
        )
    if look is None:
        which = "which levels mark" if levels.several else "whether white or black marks"
        raise InputError(_FIELD, f"cannot tell {which} the instrument ({share}).", remedy)
    return look, f"the instrument enters from the border and covers less than {100 * MAX_TOOL_SHARE:.0f} %; {share}"


def _bright_class_by_look(white_tool: NDArray[np.bool_], white_tissue: NDArray[np.bool_]) -> BrightClass | None:
    """What white means, if one class covers little area and touches the border in most of its frames; else None."""
    if _looks_like_instrument(white_tool):
        return "tool"
    return "tissue" if _looks_like_instrument(~white_tissue) else None


def _looks_like_instrument(marked: NDArray[np.bool_]) -> bool:
    if marked.mean() >= MAX_TOOL_SHARE:
        return False
    border = np.concatenate([marked[:, 0], marked[:, -1], marked[:, :, 0], marked[:, :, -1]], axis=1)
    return bool(2 * border.any(axis=1).sum() > marked.any(axis=(1, 2)).sum())


def _check_shape(given: tuple[int, int, int], shape: tuple[int, int, int], eye: str) -> None:
    frames, height, width = shape
    if given[0] != frames:
        of = " of the right eye" if eye == "right" else ""
        raise InputError(
            _FIELD, f"there are {given[0]} masks{of} for {frames} frames.", "Give one mask for each frame."
        )
    if given[1:] != (height, width):
        raise InputError(
            _FIELD,
            f"the masks are {given[2]}x{given[1]} pixels, the {eye} eye is {width}x{height}.",
            f"Give masks in the size of the {eye} eye.",
        )
