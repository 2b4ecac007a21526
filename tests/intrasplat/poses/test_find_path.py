"""Paths of phantoms' endoscopes, found from the pictures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from intrasplat.clip import DepthClip, training_frames
from intrasplat.errors import Cancelled, InputError
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import NoticeCode
from intrasplat.options import ReconstructionOptions
from intrasplat.poses import camera_rests, with_poses
from intrasplat.poses.estimate import CHAINING, FITTING, FoundPath, find_path
from intrasplat.poses.links import Frames
from intrasplat.poses.rigid import Reals
from intrasplat.poses.trajectory import trajectory_error
from lab.phantom import CameraPath, Motion, PhantomSettings, make_phantom
from tests.intrasplat.phantoms import matched_stereo

FRAMES = 24
TRAIN = training_frames(FRAMES, "every8")


@cache
def clip_of(motion: Motion, *camera: CameraPath, period_frames: float = 12.0) -> tuple[DepthClip, Reals]:
    """A stereo clip without poses, and the true ones. Callers share the arrays."""
    settings = PhantomSettings(
        width=160,
        height=128,
        frames=FRAMES,
        motion=motion,
        tools=(),
        camera=camera,
        period_frames=period_frames,
        frame_rate_hz=10.0,
    )
    return matched_stereo(settings)


@cache
def path_of(motion: Motion, *camera: CameraPath, period_frames: float = 12.0) -> FoundPath:
    """What find_path finds in clip_of the same. Callers share it."""
    clip, _ = clip_of(motion, *camera, period_frames=period_frames)
    return find_path(clip, TRAIN)


def posed(clip: DepthClip, poses: str = "auto") -> DepthClip:
    return with_poses(clip, ReconstructionOptions.model_validate({"poses": poses}), Hooks(), Timings())


def test_a_camera_over_still_tissue_is_found() -> None:
    clip, true = clip_of("still", "turn")
    found = posed(clip)
    error = trajectory_error(found.world_from_camera, true)
    assert error.mm < 1.3  # a pixel is 0.6 mm
    assert error.deg < 0.6
    assert found.poses is not None
    assert found.poses.source == "estimated"
    assert found.poses.extent_deg == pytest.approx(np.degrees(np.arccos((np.trace(true[-1, :3, :3]) - 1) / 2)), abs=0.5)
    assert found.right is not None
    assert clip.right is not None
    between = np.linalg.inv(found.world_from_camera) @ found.right.world_from_camera
    assert between == pytest.approx(clip.right.world_from_camera, abs=1e-9)
    assert found.rgb is clip.rgb


def test_held_out_frames_change_no_other_pose() -> None:
    clip, _ = clip_of("still", "turn")
    spoilt = clip.rgb.copy()
    held_out = sorted(set(range(FRAMES)) - set(TRAIN))
    spoilt[held_out] = 255 - spoilt[held_out]
    one, two = path_of("still", "turn"), find_path(replace(clip, rgb=spoilt), TRAIN)
    assert (one.world_from_camera[TRAIN] == two.world_from_camera[TRAIN]).all()
    assert one.period_frames == two.period_frames


def test_a_path_does_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("intrasplat.machine.pool.cores", lambda: 1)
    clip, _ = clip_of("still", "turn")
    alone = find_path(clip, TRAIN)
    monkeypatch.setattr("intrasplat.machine.pool.cores", lambda: 4)
    together = find_path(clip, TRAIN)
    assert (alone.world_from_camera == together.world_from_camera).all()
    assert alone.sigma_mm == together.sigma_mm


def test_what_progress_raises_ends_the_search() -> None:
    clip, _ = clip_of("still", "turn")

    def stop(share: float) -> None:
        if share >= CHAINING + FITTING:  # other frames are being placed
            raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        find_path(clip, TRAIN, stop)


def test_a_fixed_camera_leaves_the_clip_as_it_is() -> None:
    clip, _ = clip_of("still")
    assert camera_rests(clip, TRAIN)
    found = posed(clip)
    assert found.poses is not None
    assert found.poses.source == "fixed"
    assert found.world_from_camera is clip.world_from_camera
    assert found.right is clip.right
    assert found.depth_mm is clip.depth_mm


def test_tissue_that_breathes_is_not_taken_for_a_camera() -> None:
    clip, _ = clip_of("breathing")
    assert not camera_rests(clip, TRAIN)
    found = posed(clip)
    assert found.poses is not None
    assert found.poses.source == "fixed"
    assert found.poses.tissue_mm is not None
    assert found.poses.tissue_mm > 1
    assert found.world_from_camera is clip.world_from_camera


def test_a_camera_that_cannot_be_followed_is_told() -> None:
    clip, _ = clip_of("still", "turn")
    random = np.random.default_rng(0)
    found = posed(replace(clip, rgb=random.integers(0, 255, clip.rgb.shape, np.uint8)))
    assert found.poses is not None
    assert found.poses.source == "fixed"
    assert NoticeCode.POSES_UNSURE in [each.code for each in found.warnings]


def test_a_fast_pan_is_followed() -> None:
    _, true = clip_of("still", "pan")
    path = path_of("still", "pan")
    error = trajectory_error(path.world_from_camera, true)
    assert error.mm < 1.5  # of 127 mm in a second; frames share half of their view with the next but one
    assert error.deg < 1


@pytest.mark.parametrize("camera", ["advance", "turn", "shake"])
def test_less_than_a_breath_tells_no_camera_from_tissue_and_says_so(
    camera: CameraPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip, true = clip_of("breathing", camera, period_frames=36.0)
    path = path_of("breathing", camera, period_frames=36.0)
    error = trajectory_error(path.world_from_camera[TRAIN], true[TRAIN])
    assert error.mm > 1.5
    assert path.sigma_mm > error.mm / 2
    assert path.confused
    monkeypatch.setattr("intrasplat.poses.estimate.find_path", lambda *_: path)  # which posed() would find again
    assert NoticeCode.CAMERA_OR_TISSUE in [each.code for each in posed(clip).warnings]


def test_frames_that_show_nothing_of_the_others_are_told() -> None:
    clip, _ = clip_of("still", "turn")
    random = np.random.default_rng(0)
    rgb = clip.rgb.copy()
    rgb[10] = random.integers(0, 255, rgb[10].shape, np.uint8)
    path = find_path(replace(clip, rgb=rgb), TRAIN)
    assert path.unsure == (10,)
    assert not path.confused


@pytest.mark.parametrize("camera", [(), ("turn",)])
def test_a_camera_that_must_be_fixed_is_told_if_the_picture_moves(camera: tuple[CameraPath, ...]) -> None:
    clip, _ = clip_of("still", *camera)
    fixed = posed(clip, "fixed")
    assert fixed.world_from_camera is clip.world_from_camera
    (notice,) = (each for each in fixed.assumptions if each.code is NoticeCode.POSES)
    assert ("though most of the picture moves" in notice.text) is bool(camera)


def test_poses_that_are_not_there_cannot_be_asked_for() -> None:
    clip, _ = clip_of("still")
    with pytest.raises(InputError) as caught:
        posed(clip, "given")
    assert caught.value.field == "options.poses"


def test_a_clip_with_poses_keeps_them_unless_others_are_asked_for() -> None:
    phantom = make_phantom(PhantomSettings(width=96, height=80, frames=3, camera=("swing",)))
    clip = phantom.depth_clip()
    given = posed(clip)
    assert given.poses is not None
    assert given.poses.source == "given"
    assert given.world_from_camera is clip.world_from_camera
    assert posed(given, "fixed") is given
    fixed = posed(clip, "fixed")
    assert (fixed.world_from_camera == np.eye(4)).all()


def test_a_frame_without_depth_matches_no_other() -> None:
    clip, _ = clip_of("still", "turn")
    blind = replace(clip, depth_mm=clip.depth_mm.copy(), depth_confidence=clip.depth_confidence.copy())
    blind.depth_mm[3], blind.depth_confidence[3] = 0, 0
    link = Frames(blind).link(3, 4)
    assert (len(link.cells), link.overlap) == (0, 0.0)
    assert find_path(blind, TRAIN).world_from_camera.shape == (FRAMES, 4, 4)
