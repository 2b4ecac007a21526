"""Stereo clips of every layout but EndoNeRF's, opened and checked, decoded when asked for.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from contract.intake.limits import SMALLEST_SIDE_PX, ClipLimits
from contract.wire.errors import InputError
from contract.wire.names import MaskPolarity
from worker.input.clip.files import FileTree, open_tree
from worker.input.clip.images import ImageSequence, open_images
from worker.input.clip.masks import BrightClass, MaskFrames, mask_names, tissue_from_masks
from worker.input.clip.naming import eye_of, left_eye_only, pair_names
from worker.input.clip.packing import (
    PACKING_WORDS,
    FrameSequence,
    PackedPairs,
    Packing,
    TwoSequences,
    detect_packing,
    pair_sequences,
)
from worker.input.clip.types import StereoClip
from worker.input.clip.video import FALLBACK_RATE_HZ, open_video, open_video_in

STEREOMIS = "StereoMIS"
STEREOMIS_CALIBRATION = "StereoCalibration.ini"

StereoLayout = Literal["auto", "stereomis", "sbs", "tb", "frames"]
_Pairs = PackedPairs | TwoSequences


def open_two_files(left: Path, right: Path, limits: ClipLimits) -> StereoClip:
    """Left and right eye as two videos, two folders or zips of frames, or two images."""
    pairs = pair_sequences(_open_eye(left, "clip", limits), _open_eye(right, "right", limits))
    return _stereo_clip(pairs, ("layout: two files, left eye first",), limits)


def open_video_clip(path: Path, layout: StereoLayout, limits: ClipLimits) -> StereoClip:
    """Both eyes in one video, side by side or top-bottom."""
    if layout in ("frames", "stereomis"):
        raise InputError(
            "options.layout", f'layout "{layout}" needs a folder or zip, {path.name} is a file.', "Leave it out."
        )
    return _packed_clip(open_video(path, "clip", limits), layout, limits)


def open_tree_clip(tree: FileTree, layout: StereoLayout) -> StereoClip:
    """A folder or zip with one or two videos, or with left and right frames; StereoMIS if its calibration is there."""
    videos = _outside_masks(tree.videos())
    if videos and layout != "frames":
        return _open_tree_videos(tree, videos, layout)
    images = _outside_masks(tree.images())
    nameless = bool(images) and not any(eye_of(name) for name in images)
    if layout in ("sbs", "tb") or (layout == "auto" and nameless):
        return _packed_clip(open_images(tree, images), layout, tree.limits)
    left, right = pair_names(images)
    if not left:
        raise InputError(
            "clip",
            f"{tree.label} holds neither a video nor frames (PNG or JPEG).",
            "Give a stereo video, left and right frames, or the EndoNeRF or StereoMIS layout.",
        )
    pairs = pair_sequences(open_images(tree, left), open_images(tree, right))
    word = STEREOMIS if layout == "stereomis" or is_stereomis(tree) else "left and right frames"
    return _stereo_clip(pairs, (f"layout: {word}, told apart by their names",), tree.limits)


def is_stereomis(tree: FileTree) -> bool:
    return any(PurePosixPath(name).name.lower() == STEREOMIS_CALIBRATION.lower() for name in tree.names)


def own_masks(tree: FileTree) -> MaskFrames | None:
    """The masks that lie in the clip's own folder, if any."""
    names = mask_names(tree)
    return MaskFrames(open_images(tree, names)) if names else None


def with_masks(
    clip: StereoClip, given: MaskFrames, told: MaskPolarity, by_layout: tuple[str, BrightClass] | None
) -> StereoClip:
    """The clip with its tissue pixels; see tissue_from_masks for how white is read."""
    masks = tissue_from_masks(given, (clip.frame_count, clip.height, clip.width), told, by_layout)
    return replace(
        clip,
        tissue=masks.tissue,
        assumptions=(*clip.assumptions, masks.assumption),
        warnings=(*clip.warnings, *masks.warnings),
    )


def _open_tree_videos(tree: FileTree, videos: tuple[str, ...], layout: StereoLayout) -> StereoClip:
    if len(videos) == 1:
        video = open_video_in(tree, videos[0])
        known = f"{STEREOMIS}, " if layout == "stereomis" or is_stereomis(tree) else ""
        return _packed_clip(video, "tb" if layout == "stereomis" else layout, tree.limits, known)
    eyes = {found[0] for name in videos if (found := eye_of(name))}
    if len(videos) != 2 or eyes != {"left", "right"}:
        raise InputError(
            "clip",
            f"{tree.label} holds {len(videos)} videos ({', '.join(videos[:4])}).",
            "Keep one stereo video, or two named left and right.",
        )
    left, right = left_eye_only(videos)[0], next(name for name in videos if name not in left_eye_only(videos))
    pairs = pair_sequences(open_video_in(tree, left), open_video_in(tree, right))
    return _stereo_clip(pairs, ("layout: two files, told apart by their names",), tree.limits)


def _packed_clip(sequence: FrameSequence, layout: StereoLayout, limits: ClipLimits, known: str = "") -> StereoClip:
    packing: Packing = layout if layout in ("sbs", "tb") else detect_packing(sequence)
    how = " (found by likeness of the halves)" if layout == "auto" else ""
    assumptions = [f"layout: {known}{PACKING_WORDS[packing]}{how}"]
    odd = sequence.width % 2 if packing == "sbs" else sequence.height % 2
    if odd:
        assumptions.append(f"layout: the odd middle {'column' if packing == 'sbs' else 'row'} belongs to neither eye")
    return _stereo_clip(PackedPairs(sequence, packing), tuple(assumptions), limits)


def _stereo_clip(pairs: _Pairs, assumptions: tuple[str, ...], limits: ClipLimits) -> StereoClip:
    first = pairs.sequence if isinstance(pairs, PackedPairs) else pairs.left
    height, width = pairs.eye_size if isinstance(pairs, PackedPairs) else (first.height, first.width)
    if min(height, width) < SMALLEST_SIDE_PX:
        raise InputError("clip", f"one eye is {width}x{height} pixels.", f"Give at least {SMALLEST_SIDE_PX} a side.")
    limits.check_clip("clip", first.label, first.frame_count, width, height, eyes=1)
    frame_times_s = first.frame_times_s
    if frame_times_s is None:
        frame_times_s = np.arange(first.frame_count) / FALLBACK_RATE_HZ
        assumptions = (*assumptions, f"time: {FALLBACK_RATE_HZ:g} frames a second, the clip carries none")
    return StereoClip(first.frame_count, height, width, pairs, None, frame_times_s, assumptions, pairs.warnings)


def _open_eye(path: Path, field: str, limits: ClipLimits) -> FrameSequence:
    tree = open_tree(path, field, limits)
    if tree is None:
        return open_video(path, field, limits)
    videos = _outside_masks(tree.videos())
    return open_video_in(tree, videos[0]) if len(videos) == 1 else _eye_images(tree)


def _eye_images(tree: FileTree) -> ImageSequence:
    return open_images(tree, _outside_masks(tree.images()))


def _outside_masks(names: tuple[str, ...]) -> tuple[str, ...]:
    masks = {"masks", "mask"}
    return tuple(name for name in names if not masks & {part.lower() for part in PurePosixPath(name).parts[:-1]})
