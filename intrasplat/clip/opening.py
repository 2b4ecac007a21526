"""The first stage: opens files as a StereoClip or a DepthClip, or raises an error that says why it cannot."""

from __future__ import annotations

import atexit
import shutil
from dataclasses import replace
from pathlib import Path, PurePosixPath

from intrasplat.clip.files import FileTree, check_exists, open_tree, scratch_folder
from intrasplat.clip.images import open_images
from intrasplat.clip.layouts import ClipFiles, detect_layout, layout_named
from intrasplat.clip.layouts.layout import outside_masks
from intrasplat.clip.layouts.stereomis import CALIBRATION_FILE
from intrasplat.clip.masks import no_masks, open_masks, own_masks
from intrasplat.clip.packing import FrameSequence
from intrasplat.clip.stereo import two_sequence_clip, with_masks
from intrasplat.clip.types import DepthClip, StereoClip
from intrasplat.clip.video import open_video, open_video_in
from intrasplat.errors import InputError
from intrasplat.intake.limits import MAX_CALIBRATION_BYTES, ClipLimits
from intrasplat.notices import Notice, NoticeCode
from intrasplat.options import ClipOptions

_CALIBRATION_SUFFIXES = frozenset({".json", ".yaml", ".yml", ".xml", ".ini"})


def open_clip(
    path: Path | str,
    right: Path | str | None = None,
    *,
    masks: Path | str | None = None,
    options: ClipOptions | None = None,
    limits: ClipLimits | None = None,
) -> StereoClip | DepthClip:
    """The clip in these files, validated. `assumptions` lists every assumption about it.

    path     a stereo video, a folder or a zip; or the left eye's video or frames when `right` is given
    masks    zip or folder of PNG, or of videos, or a video, of the left eye or of both (masks.py); default: the clip's
             own masks/ folder, if it has one
    options  layout: the name of one of clip/layouts/; "auto" detects it by names, shape and content
             mask_polarity: "auto" uses layout and look (masks.tissue_from_masks)
             mask_source: "none" ignores all masks, also the clip's own

    Raises InputError for anything wrong, with field and remedy, and LimitError for a clip that is too large.
    """
    options, limits = options or ClipOptions(), limits or ClipLimits()
    layout, mask_polarity = options.layout, options.mask_polarity
    named = layout_named(layout) if layout != "auto" else None
    path = Path(path)
    check_exists(path, "clip")
    ignored = options.mask_source == "none"
    given = open_masks(Path(masks), limits) if masks is not None and not ignored else None
    if right is not None:
        clip = _open_two(path, Path(right), layout, limits)
        return with_masks(clip, given, mask_polarity, None) if given is not None else _without_masks(clip, ignored)
    tree = open_tree(path, "clip", limits)
    files = ClipFiles(path, tree, limits, named is None, given, ignored, mask_polarity, options.pose_convention)
    chosen = named or detect_layout(files)
    opened = chosen.open(files)
    if isinstance(opened, DepthClip):
        return opened
    found = given or (own_masks(tree) if tree is not None and not ignored else None)
    if found is None:
        return _without_masks(opened, ignored)
    by_layout = (chosen.title or chosen.name, chosen.white) if chosen.white is not None else None
    return with_masks(opened, found, mask_polarity, by_layout)


def find_calibration(path: Path | str, scratch: Path | None = None, limits: ClipLimits | None = None) -> Path | None:
    """The calibration file in a clip's folder or zip; None if there is none, or if path is a single file.

    StereoMIS's file name has priority, then calibration.*, then names that contain "calib". A file in a zip is copied
    into `scratch`, or into a temporary folder that lasts until the process ends.
    Raises InputError if several files are equally likely.
    """
    path = Path(path)
    check_exists(path, "clip")
    tree = open_tree(path, "clip", limits or ClipLimits())
    if tree is None:
        return None
    candidates = [name for name in tree.names if PurePosixPath(name).suffix.lower() in _CALIBRATION_SUFFIXES]
    stems = {name: PurePosixPath(name).stem.lower() for name in candidates}
    ranks = (
        [name for name in candidates if PurePosixPath(name).name.lower() == CALIBRATION_FILE.lower()],
        [name for name in candidates if stems[name] == "calibration"],
        [name for name in candidates if "calib" in stems[name]],
    )
    found = next((rank for rank in ranks if rank), [])
    if len(found) > 1:
        raise InputError("calibration", f"{tree.label} holds {', '.join(found)}.", "Say which one, as calibration.")
    return _as_path(tree, found[0], scratch) if found else None


def _open_two(left: Path, right: Path, layout: str, limits: ClipLimits) -> StereoClip:
    """Left and right eye as two videos, two folders or zips of frames, or two images."""
    if layout != "auto":
        raise InputError("options.layout", f'layout "{layout}" does not go with a second file.', "Leave it out.")
    check_exists(right, "right")
    eyes = _open_eye(left, "clip", limits), _open_eye(right, "right", limits)
    return two_sequence_clip(*eyes, Notice.info(NoticeCode.LAYOUT, "layout: two files, left eye first"), limits)


def _open_eye(path: Path, field: str, limits: ClipLimits) -> FrameSequence:
    tree = open_tree(path, field, limits)
    if tree is None:
        return open_video(path, field, limits)
    videos = outside_masks(tree.videos())
    return open_video_in(tree, videos[0]) if len(videos) == 1 else open_images(tree, outside_masks(tree.images()))


def _without_masks(clip: StereoClip, ignored: bool) -> StereoClip:
    return replace(clip, assumptions=(*clip.assumptions, no_masks(ignored=ignored)))


def _as_path(tree: FileTree, name: str, scratch: Path | None) -> Path:
    if (path := tree.path(name)) is not None:
        return path
    if scratch is None:
        scratch = scratch_folder()
        atexit.register(shutil.rmtree, scratch, ignore_errors=True)
    target = scratch / f"calibration{PurePosixPath(name).suffix.lower()}"
    tree.copy_to(name, target, MAX_CALIBRATION_BYTES)
    return target
