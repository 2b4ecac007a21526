"""Poses that come with a clip or in a file of their own, read as the pictures show the camera move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.names import PoseConvention
from intrasplat.notices import Notice, NoticeCode
from intrasplat.poses.agreement import OPENCV_AXES, Agreement, Convention, Unit, agreement, likely_unit
from intrasplat.poses.placing import placed
from intrasplat.poses.pose_file import StoredPoses, poses_of_frames

MIN_FRAMES = 2


def with_stored_poses(clip: DepthClip, train: Sequence[int], stored: StoredPoses) -> tuple[DepthClip, bool]:
    """The clip with poses from a file or an array, and whether the pictures contradict them.

    Raises:
        InputError: the poses do not belong to this clip.
    """
    poses = poses_of_frames(clip, stored)
    usual: Unit = "mm" if stored.stamps is None else "m"
    declared = stored.declared or Convention(usual if usual == "mm" else likely_unit(poses))
    found = agreement(clip, train, poses, declared) if len(train) >= MIN_FRAMES else Agreement(declared)
    if found.contradicts:
        why = "the pictures contradict them in every unit, direction and axes"
    elif found.convention != declared:
        why = f"not as {declared}: only so do they fit the pictures"
    elif found.determined:
        why = "which fits the pictures"
    else:
        why = "which the pictures cannot check: the camera hardly moves"
    text = f"poses: as given, read as {found.convention}{_factor(found.convention.unit, usual)}; {why}"
    clip = with_notice(placed(clip, found.convention.world_from_camera(poses)), Notice.info(NoticeCode.POSES, text))
    return clip, found.contradicts


def with_checked_poses(clip: DepthClip, train: Sequence[int], axes: PoseConvention) -> tuple[DepthClip, bool]:
    """The clip with its layout's poses in the reading that fits the pictures, and whether they contradict all.

    axes: those of poses_bounds.npy by the options.
    """
    poses = clip.world_from_camera
    if len(train) < MIN_FRAMES or (poses == poses[:1]).all():
        return clip, False
    declared = Convention()
    if clip.first_pose is not None:
        declared = Convention(axes=axes)
        poses = clip.first_pose @ poses @ np.linalg.inv(OPENCV_AXES[axes])
    found = agreement(clip, train, poses, declared)
    if found.convention == declared:
        return clip, found.contradicts
    factor = _factor(found.convention.unit, declared.unit)
    text = f"poses: read as {found.convention}{factor}, not as {declared}: only so do they fit the pictures"
    corrected = placed(clip, found.convention.world_from_camera(poses))
    return with_notice(corrected, Notice.info(NoticeCode.POSES, text)), found.contradicts


def contradicted(clip: DepthClip, *, used: bool) -> DepthClip:
    """The clip with a warning that the pictures contradict its poses."""
    text = "The given camera poses contradict the pictures in every unit, direction and axes: "
    text += "they are used nevertheless; check them, or estimate them." if used else "they were not used."
    return replace(clip, warnings=(*clip.warnings, Notice.warning(NoticeCode.POSES_CONTRADICT, text)))


def _factor(unit: Unit, usual: Unit) -> str:
    return f" (not in {usual}: a factor of 1000)" if unit != usual else ""


def with_notice(clip: DepthClip, notice: Notice) -> DepthClip:
    """The clip with this notice on its poses instead of an earlier one."""
    others = (each for each in clip.assumptions if each.code is not NoticeCode.POSES)
    return replace(clip, assumptions=(*others, notice))
