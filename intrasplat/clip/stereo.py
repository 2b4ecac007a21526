"""Stereo clips from one or two sequences of pictures, checked, and decoded on demand.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

from dataclasses import replace

from intrasplat.clip.bit_depth import at_own_depth
from intrasplat.clip.files import FileTree
from intrasplat.clip.frame_times import assumed_times
from intrasplat.clip.images import open_images
from intrasplat.clip.masks import BrightClass, MaskFrames, tissue_from_masks
from intrasplat.clip.naming import eye_folders, eye_of, left_eye_only, pair_names
from intrasplat.clip.packing import (
    PACKING_WORDS,
    FrameSequence,
    PackedPairs,
    Packing,
    TwoSequences,
    by_severity,
    pair_sequences,
)
from intrasplat.clip.types import StereoClip
from intrasplat.clip.video import open_video_in
from intrasplat.errors import InputError
from intrasplat.intake.limits import MIN_SIDE_PX, ClipLimits
from intrasplat.names import MaskPolarity
from intrasplat.notices import Notice, NoticeCode


def packed_clip(
    sequence: FrameSequence, packing: Packing, limits: ClipLimits, *, detected: bool, title: str = ""
) -> StereoClip:
    """The clip of a sequence whose pictures contain both eyes; title is the layout's, if it has one."""
    how = " (found by likeness of the halves)" if detected else ""
    words = f"layout: {title}{', ' if title else ''}{PACKING_WORDS[packing]}{how}"
    assumptions = [Notice.info(NoticeCode.LAYOUT, words)]
    odd = sequence.width % 2 if packing == "sbs" else sequence.height % 2
    if odd:
        line = "column" if packing == "sbs" else "row"
        text = f"layout: the odd middle {line} belongs to neither eye"
        assumptions.append(Notice.info(NoticeCode.MIDDLE_LINE_UNUSED, text))
    return _stereo_clip(PackedPairs(sequence, packing), tuple(assumptions), limits)


def two_sequence_clip(left: FrameSequence, right: FrameSequence, assumption: Notice, limits: ClipLimits) -> StereoClip:
    """The clip of one sequence per eye. InputError if their lengths or sizes differ."""
    return _stereo_clip(pair_sequences(*at_own_depth(left, right)), (assumption,), limits)


def two_video_clip(tree: FileTree, videos: tuple[str, ...]) -> StereoClip:
    """The clip of two videos in a tree whose names give the eye. InputError if there are other videos."""
    folders = eye_folders(videos)
    eyes = {found[0] for name in videos if (found := eye_of(name, folders))}
    if len(videos) != 2 or eyes != {"left", "right"}:
        raise InputError(
            "clip",
            f"{tree.label} holds {len(videos)} videos ({', '.join(videos[:4])}).",
            "Keep one stereo video, or two named left and right.",
        )
    left, right = left_eye_only(videos)[0], next(name for name in videos if name not in left_eye_only(videos))
    left_video, right_video = open_video_in(tree, left), open_video_in(tree, right)
    assumption = Notice.info(NoticeCode.LAYOUT, "layout: two files, told apart by their names")
    return two_sequence_clip(left_video, right_video, assumption, tree.limits)


def eye_images_clip(tree: FileTree, images: tuple[str, ...], title: str) -> StereoClip:
    """The clip of a tree's images, whose names give the eye; title is the layout's. InputError: none, or others."""
    left, right = pair_names(images)
    if not left:
        raise InputError(
            "clip",
            f"{tree.label} holds neither a video nor frames (PNG or JPEG).",
            "Give a stereo video, left and right frames, or the EndoNeRF or StereoMIS layout.",
        )
    assumption = Notice.info(NoticeCode.LAYOUT, f"layout: {title}, told apart by their names")
    return two_sequence_clip(open_images(tree, left), open_images(tree, right), assumption, tree.limits)


def with_masks(
    clip: StereoClip, given: MaskFrames, polarity: MaskPolarity, by_layout: tuple[str, BrightClass] | None
) -> StereoClip:
    """The clip with its tissue pixels, also the right eye's if the masks show it (see tissue_from_masks).

    Without masks of the right eye, stereo warps the left eye's by their depth (intrasplat/stereo/right_eye.py).
    """
    shape = (clip.frame_count, clip.height, clip.width)
    masks = tissue_from_masks(given, shape, polarity, by_layout, both_eyes=True)
    source = "the left eye's, moved by depth" if masks.right is None else "as given"
    right = Notice.info(NoticeCode.MASKS, f"masks of the right eye: {source}")
    return replace(
        clip,
        tissue=masks.tissue,
        tissue_right=masks.right,
        assumptions=(*clip.assumptions, masks.assumption, right, *masks.remarks),
        warnings=(*clip.warnings, *masks.warnings),
        damaged=tuple(sorted({*clip.damaged, *masks.damaged})),
    )


def _stereo_clip(pairs: PackedPairs | TwoSequences, assumptions: tuple[Notice, ...], limits: ClipLimits) -> StereoClip:
    first = pairs.sequences[0]
    height, width = pairs.eye_size if isinstance(pairs, PackedPairs) else (first.height, first.width)
    if min(height, width) < MIN_SIDE_PX:
        raise InputError("clip", f"one eye is {width}x{height} pixels.", f"Give at least {MIN_SIDE_PX} a side.")
    limits.check_clip("clip", first.label, first.frame_count, width, height, eyes=1)
    frame_times_s = first.frame_times_s
    if frame_times_s is None:
        frame_times_s, notice = assumed_times(first.frame_count)
        assumptions = (*assumptions, notice)
    infos, warnings = by_severity(pairs.sequences)
    return StereoClip(
        frame_count=first.frame_count,
        height=height,
        width=width,
        pairs=pairs,
        tissue=None,
        frame_times_s=frame_times_s,
        assumptions=(*assumptions, *infos),
        warnings=warnings,
        damaged=tuple(sorted({index for each in pairs.sequences for index in each.damaged})),
        pixel_aspect=first.pixel_aspect,
    )
