"""Sets a clip's camera poses: those given with the clip, those of a fixed camera, or an estimated path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from intrasplat.clip import DepthClip, training_frames
from intrasplat.errors import InputError
from intrasplat.intake.fit import check_poses_used
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import Notice, NoticeCode, named_frames
from intrasplat.options import ReconstructionOptions
from intrasplat.poses.given import MIN_FRAMES, contradicted, with_checked_poses, with_notice, with_stored_poses
from intrasplat.poses.jitter import MAX_JITTER, MIN_JITTER, jitter_mm, steadied
from intrasplat.poses.placing import placed
from intrasplat.poses.pose_file import StoredPoses
from intrasplat.poses.still import camera_rests
from intrasplat.report import CameraPoses

if TYPE_CHECKING:  # imported when needed: a fixed camera needs none of it
    from intrasplat.poses.estimate import FoundPath

STAGE = "poses"
WORTH = 0.7
"""Smoothed poses replace the given ones only if less than this share of the jitter remains."""
MAX_UNSURE = 0.5
"""With a larger share of unsure frames, the path is rejected."""


def with_poses(
    clip: DepthClip, options: ReconstructionOptions, hooks: Hooks, timings: Timings, stored: StoredPoses | None = None
) -> DepthClip:
    """The clip with its poses and their entry for the report. A clip whose poses are set is returned unchanged.

    A fixed camera leaves all arrays unchanged. timings get poses_s. stored: poses that replace the clip's own.

    Raises:
        InputError: options.poses asks for given poses, and there are none; or poses are stored, and the option does not
            use them, or they do not fit the clip.
        Cancelled: hooks.should_stop said so.
    """
    if clip.poses is not None:
        return clip
    if stored is not None:
        check_poses_used(options.poses, stored.field)
    has_given = clip.right is None or stored is not None  # only layouts with depth bring poses
    if options.poses == "given" and not has_given:
        problem = '"given" asks for poses that come with the clip, and stereo clips bring none.'
        raise InputError("options.poses", problem, 'Give a file of poses, or say "auto" or "estimate".')
    train = sorted(set(training_frames(clip.frame_count, options.holdout)) - set(clip.skipped))
    with timings.measure("poses_s"):
        if has_given and options.poses in ("auto", "given"):
            clip = _given(clip, train, options, hooks, stored)
            if clip.poses is not None:
                return clip
        hooks.report_stage(STAGE, 0.0)
        if len(train) < MIN_FRAMES:
            return _fixed(clip, "was taken as fixed")
        if options.poses == "fixed":
            moves = ", though most of the picture moves: all of that counts as the tissue's motion"
            return _fixed(clip, f"was taken as fixed, as asked{'' if camera_rests(clip, train) else moves}")
        if options.poses == "auto" and camera_rests(clip, train):
            return _fixed(clip, "is fixed: most of the picture rests")
        from intrasplat.poses.estimate import find_path

        return _posed_or_fixed(clip, find_path(clip, train, lambda share: hooks.report_stage(STAGE, share)), options)


def _given(
    clip: DepthClip, train: Sequence[int], options: ReconstructionOptions, hooks: Hooks, stored: StoredPoses | None
) -> DepthClip:
    """The clip with its given poses; unplaced and with a warning if the pictures contradict those of a file.

    Poses that jitter are not judged: the jitter hides what is right in them.
    """
    if stored is not None:
        read, contradicts = with_stored_poses(clip, train, stored)
    else:
        read, contradicts = with_checked_poses(clip, train, options.pose_convention)
    jumps_mm, depth_mm = jitter_mm(read, train)
    if contradicts and not _harms(read, jumps_mm, depth_mm, MIN_JITTER):
        if stored is not None and options.poses == "auto":
            return contradicted(clip, used=False)
        read = contradicted(read, used=True)
    if options.poses == "given":
        return _as_given(read, jumps_mm, depth_mm)
    return _steadied(read, train, jumps_mm, depth_mm, hooks)


def _harms(clip: DepthClip, jumps_mm: float, depth_mm: float, most: float) -> bool:
    """Whether jitter at the tissue exceeds this share of the picture's width."""
    return clip.intrinsics.fx * jumps_mm > most * clip.intrinsics.width * depth_mm


def _as_given(clip: DepthClip, jumps_mm: float, depth_mm: float) -> DepthClip:
    """The clip with its given poses, and a warning if their jitter harms the model."""
    clip = replace(clip, poses=CameraPoses(source="given"))
    if not _harms(clip, jumps_mm, depth_mm, MAX_JITTER):
        return clip
    text = (
        f"The camera's poses jump to and fro by about {jumps_mm:.1f} mm at the tissue from frame to frame: they seem "
        "to be inexact, and the model takes their errors for motion."
    )
    return replace(clip, warnings=(*clip.warnings, Notice.warning(NoticeCode.POSE_JITTER, text)))


def _steadied(clip: DepthClip, train: Sequence[int], jumps_mm: float, depth_mm: float, hooks: Hooks) -> DepthClip:
    """The clip with its given poses; jitter is removed if the pictures show that the camera did not move so."""
    if not _harms(clip, jumps_mm, depth_mm, MIN_JITTER):
        return _as_given(clip, 0.0, depth_mm)
    from intrasplat.poses.estimate import find_path

    found = find_path(clip, train, lambda share: hooks.report_stage(STAGE, share))
    is_found = len(found.unsure) <= MAX_UNSURE * clip.frame_count
    steady = steadied(clip.world_from_camera, found.world_from_camera, found.unsure) if is_found else None
    if steady is not None and steady.jumps_mm < WORTH * jumps_mm:  # the same jitter: the camera itself shakes
        return _as_given(clip, 0.0, depth_mm)
    text = f"poses: the given ones jump to and fro by about {jumps_mm:.2f} mm at the tissue from frame to frame; "
    if steady is None or steady.left_mm > WORTH * jumps_mm:
        notice = Notice.info(NoticeCode.POSES, f"{text}the pictures do not place the frames better, so they stay")
        return _as_given(replace(clip, assumptions=(*clip.assumptions, notice)), jumps_mm, depth_mm)
    text += "each frame was moved to where its picture places it between its neighbours, which may leave "
    notice = Notice.info(NoticeCode.POSES, f"{text}{steady.left_mm:.2f} mm")
    clip = replace(placed(clip, steady.world_from_camera), assumptions=(*clip.assumptions, notice))
    clip = replace(clip, poses=CameraPoses(source="given", steadied_mm=jumps_mm))
    if _harms(clip, steady.left_mm, depth_mm, MAX_JITTER):
        text = f"The camera's poses, once steadied, may still be off by {steady.left_mm:.1f} mm at the tissue."
        clip = replace(clip, warnings=(*clip.warnings, Notice.warning(NoticeCode.POSE_JITTER, text)))
    return clip


def _posed_or_fixed(clip: DepthClip, found: FoundPath, options: ReconstructionOptions) -> DepthClip:
    """The clip with the found path, or with a fixed camera if that explains the clip as well."""
    if len(found.unsure) > MAX_UNSURE * clip.frame_count:
        text = f"The camera's pose could not be found in {_named(clip, found)}: too little tissue with texture and "
        text += "depth is common to them. The camera was taken as fixed."
        return _fixed(clip, "was taken as fixed", None, Notice.warning(NoticeCode.POSES_UNSURE, text))
    if not found.seems_to_move and not found.confused:
        how = f"is fixed: placed frame by frame, it stays within about {found.spread_mm:.1f} mm of one place"
        return _fixed(clip, how, found)
    if options.poses == "auto" and not found.moves:
        text = (
            f"Camera or tissue moved as a whole, by up to {found.extent_mm:.1f} mm and {found.extent_deg:.1f} degrees; "
            "the clip does not tell which. The camera was taken as fixed, and the motion as the tissue's."
        )
        return _fixed(clip, "was taken as fixed", found, Notice.warning(NoticeCode.CAMERA_OR_TISSUE, text))
    warnings = []
    if found.confused:
        text = (
            "The clip hardly tells the camera's motion from the tissue's: poses may be off by "
            f"{found.sigma_mm:.1f} mm and {found.sigma_deg:.1f} degrees, and the tissue's motion by as much."
        )
        warnings.append(Notice.warning(NoticeCode.CAMERA_OR_TISSUE, text))
    if found.unsure:
        text = f"The camera's pose could not be found in {_named(clip, found)}: no other frame shows enough of their "
        text += "tissue. They were left out, and are not scored."
        warnings.append(Notice.warning(NoticeCode.POSES_UNSURE, text))
    text = (
        f"poses: the camera moved by {found.extent_mm:.1f} mm and {found.extent_deg:.1f} degrees; its path fits the "
        f"rigid parts within {found.rigid_fit_mm:.2f} mm, and is good to about {found.sigma_mm:.1f} mm and "
        f"{found.sigma_deg:.1f} degrees"
    )
    entry = _report_entry(clip, "estimated", found)
    clip = placed(clip, found.world_from_camera)
    clip = replace(clip, skipped=tuple(sorted({*clip.skipped, *found.unsure})))
    clip = with_notice(replace(clip, poses=entry), Notice.info(NoticeCode.POSES, text))
    return replace(clip, warnings=(*clip.warnings, *warnings))


def _named(clip: DepthClip, found: FoundPath) -> str:
    """How many frames' pose is unreliable, and which."""
    return f"{len(found.unsure)} of {clip.frame_count} frames ({named_frames(found.unsure)})"


def _fixed(clip: DepthClip, how: str, found: FoundPath | None = None, *warnings: Notice) -> DepthClip:
    entry = CameraPoses(source="fixed")
    if found is not None:
        entry = _report_entry(clip, "fixed", found).model_copy(
            update={"path_mm": None, "extent_mm": None, "extent_deg": None}
        )
    if not (clip.world_from_camera == np.eye(4)).all():
        clip = placed(clip, np.tile(np.eye(4), (clip.frame_count, 1, 1)))
    clip = with_notice(replace(clip, poses=entry), Notice.info(NoticeCode.POSES, f"poses: the camera {how}"))
    return replace(clip, warnings=(*clip.warnings, *warnings))


def _report_entry(clip: DepthClip, source: Literal["fixed", "estimated"], found: FoundPath) -> CameraPoses:
    """A path's entry in the report."""
    return CameraPoses(
        source=source,
        path_mm=found.path_mm,
        extent_mm=found.extent_mm,
        extent_deg=found.extent_deg,
        sigma_mm=found.sigma_mm,
        sigma_deg=found.sigma_deg,
        rigid_fit_mm=found.rigid_fit_mm,
        tissue_mm=found.tissue_mm,
        tissue_period_s=None if found.period_frames is None else found.period_frames * clip.frame_s,
        unsure_frames=found.unsure,
    )
