"""Instrument masks: which pixels are tissue, and how white was interpreted.

Masks show the left eye or both eyes. Masks of both eyes are two videos or one image per frame and eye, distinguished by
name, or are packed into one picture like frames. The left eye alone determines the meaning of white.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.files import FileTree, check_exists, open_tree
from intrasplat.clip.images import MASK_THRESHOLD, ImageSequence, as_mask, open_images
from intrasplat.clip.naming import check_aligned, left_eye_only, right_eye_only
from intrasplat.clip.packing import Packing, by_severity, halves, packing_by_size
from intrasplat.clip.video import VideoFile, open_video, open_video_in
from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.names import MaskPolarity
from intrasplat.notices import Notice, NoticeCode

BrightClass = Literal["tool", "tissue"]  # what a white pixel means

MAX_TOOL_SHARE = 0.4  # of the area: by look, a larger class is never taken as the instrument
_FIELD = "masks"
_POLARITY_REMEDY = 'Say mask_polarity "tool" if white marks instruments, "tissue" if white marks tissue.'


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
    white, right = _white_of_eyes(masks, packing, both_eyes=both_eyes)
    bright, reason = _bright_class(white, polarity, by_layout)
    if bright == "tool":
        for eye in (white, right):
            if eye is not None:
                np.logical_not(eye, out=eye)
    assumption = Notice.info(NoticeCode.MASKS, f"masks: white is {bright} ({reason})")
    sequences = (masks.frames,) if masks.right is None else (masks.frames, masks.right)
    remarks, warnings = by_severity(sequences)
    damaged = tuple(sorted({index for each in sequences for index in each.damaged}))
    if damaged and not both_eyes:
        raise InputError(_FIELD, f"{len(damaged)} of its frames are damaged.", "Export the masks again, as PNG.")
    return TissueMasks(white, assumption, (*_tissue_warnings(white, right), *warnings), right, True, remarks, damaged)


def _tissue_warnings(tissue: NDArray[np.bool_], right: NDArray[np.bool_] | None) -> tuple[Notice, ...]:
    """Warnings about the left eye's tissue. InputError if either eye shows no tissue."""
    for eye in (tissue, right):
        if eye is not None and not eye.any():
            which = "" if right is None else f" of the {'left' if eye is tissue else 'right'} eye"
            raise InputError(_FIELD, f"every pixel of every mask{which} is tool.", _POLARITY_REMEDY)
    warnings = []
    if tissue.all():
        warnings.append(Notice.warning(NoticeCode.MASKS_MARK_NOTHING, "the masks mark no instrument in any frame"))
    covered = int((~tissue.any(axis=(1, 2))).sum())
    if covered:
        warnings.append(
            Notice.warning(
                NoticeCode.FRAMES_WITHOUT_TISSUE,
                f"{covered} of {len(tissue)} frames are all tool in their masks and cannot be learnt from",
            )
        )
    return tuple(warnings)


def _white_of_eyes(
    masks: MaskFrames, packing: Packing | None, *, both_eyes: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_] | None]:
    """White pixels [T, H, W] of the left eye, and of the right eye if masks show it and both_eyes is set."""
    white = _white(masks.frames)
    if packing is not None:
        left, right = (np.stack(eye) for eye in zip(*(halves(each, packing) for each in white), strict=True))
        return left, right
    return white, _white(masks.right) if both_eyes and masks.right is not None else None


def _white(frames: ImageSequence | VideoFile) -> NDArray[np.bool_]:
    """White pixels [T, H, W]. InputError if the images have nonzero values but no white."""
    decoded: Iterator[NDArray[Any]]
    decoded = map(frames.decode, frames.names) if isinstance(frames, ImageSequence) else frames.frames()
    white = np.empty((frames.frame_count, frames.height, frames.width), dtype=np.bool_)
    largest = 0
    for index, image in enumerate(decoded):
        white[index] = as_mask(image)
        largest = max(largest, int(image.max()) // (257 if image.dtype == np.uint16 else 1))
    if isinstance(frames, ImageSequence) and 0 < largest < MASK_THRESHOLD:
        raise InputError(
            _FIELD, f"the largest value in the masks is {largest} of 255.", "Write masks with the values 0 and 255."
        )
    return white


def _bright_class(
    white: NDArray[np.bool_], polarity: MaskPolarity, by_layout: tuple[str, BrightClass] | None
) -> tuple[BrightClass, str]:
    """What white means, and the reason as text."""
    if polarity != "auto":
        return polarity, "as specified"
    if white.all() or not white.any():
        colour = "white" if white.any() else "black"
        raise InputError(
            _FIELD,
            f"every mask is {colour} all over, so nothing is marked.",
            "Leave the masks out if no instrument shows. " + _POLARITY_REMEDY,
        )
    look = _bright_class_by_look(white)
    share = f"white covers {100 * white.mean():.0f} % of the area"
    if by_layout is not None:
        layout, bright = by_layout
        if look in (None, bright):
            return bright, f"the {layout} layout's rule"
        raise InputError(
            _FIELD, f"the {layout} layout says white is {bright}, the masks look inverted ({share}).", _POLARITY_REMEDY
        )
    if look is None:
        raise InputError(
            _FIELD, f"cannot tell whether white or black marks the instrument ({share}).", _POLARITY_REMEDY
        )
    return look, f"the instrument enters from the border and covers less than {100 * MAX_TOOL_SHARE:.0f} %; {share}"


def _bright_class_by_look(white: NDArray[np.bool_]) -> BrightClass | None:
    """What white means, if one class covers little area and touches the border in most of its frames; else None."""
    border = np.concatenate([white[:, 0], white[:, -1], white[:, :, 0], white[:, :, -1]], axis=1)
    if white.mean() < MAX_TOOL_SHARE:
        touches = 2 * border.any(axis=1).sum() > white.any(axis=(1, 2)).sum()
        return "tool" if touches else None
    if 1.0 - white.mean() < MAX_TOOL_SHARE:
        touches = 2 * (~border).any(axis=1).sum() > (~white.all(axis=(1, 2))).sum()
        return "tissue" if touches else None
    return None


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
