"""The front of the pipeline: what the user gave becomes a StereoClip or a DepthClip, or an error that says why not."""

from __future__ import annotations

import atexit
import shutil
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import get_args

from contract.intake.limits import MOST_CALIBRATION_BYTES, ClipLimits
from contract.wire.errors import InputError
from contract.wire.names import Layout, MaskPolarity, PoseConvention
from worker.input.clip.endonerf import is_endonerf, read_endonerf
from worker.input.clip.files import FileTree, check_exists, open_tree, scratch_folder
from worker.input.clip.masks import NO_MASKS, BrightClass, MaskFrames, open_masks
from worker.input.clip.stereo_source import (
    STEREOMIS,
    STEREOMIS_CALIBRATION,
    is_stereomis,
    open_tree_clip,
    open_two_files,
    open_video_clip,
    own_masks,
    with_masks,
)
from worker.input.clip.types import DepthClip, StereoClip

_CALIBRATION_SUFFIXES = frozenset({".json", ".yaml", ".yml", ".xml", ".ini"})


def open_clip(
    path: Path | str,
    right: Path | str | None = None,
    *,
    layout: Layout = "auto",
    masks: Path | str | None = None,
    mask_polarity: MaskPolarity = "auto",
    pose_convention: PoseConvention = "opengl",
    limits: ClipLimits | None = None,
) -> StereoClip | DepthClip:
    """Opens and validates a clip; every assumption made on the way is in the clip's `assumptions`.

    path             a stereo video, a folder or a zip; or the left eye's video or frames when `right` is given
    layout           "endonerf" (gives a DepthClip, decoded at once), "stereomis", "sbs" and "tb" (both eyes in one
                     picture), "frames" (left and right images); "auto" tells them by names, shape and content
    masks            zip or folder of PNG, or a video; without it the clip's own masks/ folder is used, if there is one
    mask_polarity    what white means; "auto" asks layout and look (masks.tissue_from_masks)
    pose_convention  axes in poses_bounds.npy: "opengl" as EndoNeRF writes them, "llff" for files made by LLFF

    Raises InputError, naming field and remedy, for everything that is wrong, and LimitError when it is too large.
    """
    _check_choice("options.layout", layout, get_args(Layout))
    _check_choice("options.mask_polarity", mask_polarity, get_args(MaskPolarity))
    _check_choice("options.pose_convention", pose_convention, get_args(PoseConvention))
    limits = limits or ClipLimits()
    path = Path(path)
    check_exists(path, "clip")
    given = open_masks(Path(masks), limits) if masks is not None else None
    if right is not None:
        return _finish(_open_two(path, Path(right), layout, limits), given, mask_polarity, None)
    tree = open_tree(path, "clip", limits)
    if layout == "endonerf" or (layout == "auto" and tree is not None and is_endonerf(tree)):
        return read_endonerf(_needs_tree(tree, path), given, mask_polarity, pose_convention)
    clip = open_video_clip(path, layout, limits) if tree is None else open_tree_clip(tree, layout)
    if given is None and tree is not None:
        given = own_masks(tree)
    return _finish(clip, given, mask_polarity, _mask_rule(tree, layout))


def find_calibration(path: Path | str, scratch: Path | None = None, limits: ClipLimits | None = None) -> Path | None:
    """The calibration file that lies in a clip's folder or zip; None when there is none, or path is a single file.

    StereoMIS's own name goes first, then files called calibration.*, then any whose name contains "calib".
    From a zip it is copied into `scratch`, or into a temporary folder that lasts until the process ends.
    Raises InputError when several files are equally likely.
    """
    path = Path(path)
    check_exists(path, "clip")
    tree = open_tree(path, "clip", limits or ClipLimits())
    if tree is None:
        return None
    candidates = [name for name in tree.names if PurePosixPath(name).suffix.lower() in _CALIBRATION_SUFFIXES]
    stems = {name: PurePosixPath(name).stem.lower() for name in candidates}
    ranks = (
        [name for name in candidates if PurePosixPath(name).name.lower() == STEREOMIS_CALIBRATION.lower()],
        [name for name in candidates if stems[name] == "calibration"],
        [name for name in candidates if "calib" in stems[name]],
    )
    found = next((rank for rank in ranks if rank), [])
    if len(found) > 1:
        raise InputError("calibration", f"{tree.label} holds {', '.join(found)}.", "Say which one, as calibration.")
    return _as_path(tree, found[0], scratch) if found else None


def _open_two(left: Path, right: Path, layout: Layout, limits: ClipLimits) -> StereoClip:
    if layout != "auto":
        raise InputError("options.layout", f'layout "{layout}" does not go with a second file.', "Leave it out.")
    check_exists(right, "right")
    return open_two_files(left, right, limits)


def _finish(
    clip: StereoClip,
    given: MaskFrames | None,
    told: MaskPolarity,
    by_layout: tuple[str, BrightClass] | None,
) -> StereoClip:
    if given is None:
        return replace(clip, assumptions=(*clip.assumptions, NO_MASKS))
    return with_masks(clip, given, told, by_layout)


def _mask_rule(tree: FileTree | None, layout: Layout) -> tuple[str, BrightClass] | None:
    """What the layout says white means in masks, if it says anything."""
    if layout == "stereomis" or (layout == "auto" and tree is not None and is_stereomis(tree)):
        return STEREOMIS, "tissue"
    return None


def _needs_tree(tree: FileTree | None, path: Path) -> FileTree:
    if tree is None:
        raise InputError(
            "options.layout", f'layout "endonerf" needs a folder or zip, {path.name} is neither.', "Leave it out."
        )
    return tree


def _as_path(tree: FileTree, name: str, scratch: Path | None) -> Path:
    if (path := tree.path(name)) is not None:
        return path
    if scratch is None:
        scratch = scratch_folder()
        atexit.register(shutil.rmtree, scratch, ignore_errors=True)
    target = scratch / f"calibration{PurePosixPath(name).suffix.lower()}"
    tree.copy_to(name, target, MOST_CALIBRATION_BYTES)
    return target


def _check_choice(field: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(field, f"{value!r} is not known.", f"Choose one of {', '.join(allowed)}.")
