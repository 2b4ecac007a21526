"""Cameras of frames that lie far apart: stills, jumps, and frames that show other tissue than the rest."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from intrasplat.clip import DepthClip, training_frames
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import NoticeCode
from intrasplat.options import ReconstructionOptions
from intrasplat.poses import with_poses
from intrasplat.poses.chain import _ahead, tied
from intrasplat.poses.estimate import find_path
from intrasplat.poses.links import FrameLink, Frames
from intrasplat.poses.rigid import Reals, exp, inverse
from intrasplat.poses.trajectory import trajectory_error
from lab.phantom import CameraPath, PhantomSettings
from tests.intrasplat.phantoms import matched_stereo


@cache
def clip_of(camera: CameraPath, frames: int, seed: int = 0, breath: float = 1e6) -> tuple[DepthClip, Reals]:
    """A stereo clip without poses, and the true ones. Callers share the arrays. breath: its period in frames."""
    settings = PhantomSettings(
        width=240,
        height=192,
        frames=frames,
        motion="breathing" if breath < frames else "still",
        tools=(),
        camera=(camera,),
        seed=seed,
        period_frames=breath,
        frame_rate_hz=0.6,
    )
    return matched_stereo(settings)


def picked(clip: DepthClip, frames: list[int]) -> DepthClip:
    """The clip of some frames alone, in the order given."""
    arrays = {name: array[frames] for name, array in clip.arrays_at(slice(None)).items()}
    assert clip.right is not None
    right = replace(clip.right, **{name: array[frames] for name, array in clip.right.arrays_at(slice(None)).items()})
    return replace(clip, right=right, frame_times_s=np.arange(len(frames)) / 25, skipped=(), **arrays)


def test_stills_of_an_endoscope_that_retreats_and_returns_are_placed() -> None:
    clip, true = clip_of("retreat", 17, breath=2.5)
    found = find_path(clip, training_frames(17, "every8"))
    assert found.unsure == ()
    assert trajectory_error(found.world_from_camera, true).mm < 2


def test_a_camera_that_jumps_is_followed() -> None:
    clip, true = clip_of("pan", 24)
    frames = [*range(6), *range(11, 17)]  # the jump is a third of the view
    found = find_path(picked(clip, frames), range(len(frames)))
    assert found.unsure == ()
    error = trajectory_error(found.world_from_camera, true[frames])
    assert error.mm < 1.5
    assert error.deg < 1


def test_frames_of_other_tissue_are_lost_left_out_and_named() -> None:
    clip, true = clip_of("turn", 16)
    other, _ = clip_of("turn", 16, seed=5)
    rgb, depth_mm = clip.rgb.copy(), clip.depth_mm.copy()
    rgb[5:8], depth_mm[5:8] = other.rgb[5:8], other.depth_mm[5:8]
    mixed = replace(clip, rgb=rgb, depth_mm=depth_mm)
    found = with_poses(mixed, ReconstructionOptions(holdout="none", poses="estimate"), Hooks(), Timings())
    assert found.poses is not None
    assert found.poses.unsure_frames == (5, 6, 7)
    assert found.skipped == (5, 6, 7)
    warning = next(each for each in found.warnings if each.code == NoticeCode.POSES_UNSURE)
    assert "3 of 16 frames (5, 6, 7)" in warning.text
    placed = [i for i in range(16) if i not in found.skipped]
    assert trajectory_error(found.world_from_camera[placed], true[placed]).mm < 1.3


def test_a_held_out_frame_without_any_depth_is_not_placed() -> None:
    """As where one lens is fogged: no track to it has a point."""
    clip, _ = clip_of("retreat", 17, breath=2.5)
    train = training_frames(17, "every8")
    fogged = next(index for index in range(17) if index not in train)
    depth_mm, rgb = clip.depth_mm.copy(), clip.rgb.copy()
    depth_mm[fogged], rgb[fogged] = 0, 200
    found = find_path(replace(clip, depth_mm=depth_mm, rgb=rgb), train)
    assert fogged in found.unsure


def test_a_held_out_frame_between_far_ones_is_placed_by_features() -> None:
    clip, true = clip_of("pan", 24)
    frames = [0, 9, 1, 2, 3, 4, 5, 6, 7, 8]  # frames 0 and 1 show nothing that frame 9 does
    found = find_path(picked(clip, frames), [0, *range(2, 10)])
    assert found.unsure == ()
    assert trajectory_error(found.world_from_camera, true[frames]).mm < 1.5


def test_features_place_two_frames_of_common_tissue_and_no_others() -> None:
    clip, true = clip_of("pan", 24)
    frames = Frames(clip)
    far = frames.far_motion(0, 4)
    assert far is not None
    assert far.motion == pytest.approx(inverse(true[4]) @ true[0], abs=1.0)
    assert frames.far_motion(0, 23) is None  # a view and a half apart
    other, _ = clip_of("turn", 16, seed=5)
    rgb = clip.rgb.copy()
    rgb[8] = other.rgb[8]
    assert Frames(replace(clip, rgb=rgb)).far_motion(0, 8) is None


def link(a: int, b: int) -> FrameLink:
    return cast(FrameLink, SimpleNamespace(a=a, b=b))


def test_frames_that_no_link_ties_to_the_largest_set_are_no_part_of_it() -> None:
    assert tied([0, 1, 2, 3], [link(0, 1), link(1, 2)]) == [0, 1, 2]
    assert tied([0, 2, 4, 6, 8], [link(0, 2), link(4, 6), link(6, 8)]) == [4, 6, 8]
    assert tied([5], []) == [5]


def test_after_a_jump_no_velocity_is_carried_over() -> None:
    poses = {i: exp(np.array([10.0 * i, 0, 0, 0, 0, 0])) for i in range(4)}
    np.testing.assert_allclose(_ahead(poses, [0, 1], 3)[0, 3], 30.0)
    np.testing.assert_array_equal(_ahead(poses, [1], 3), poses[1])
