"""Poses that come with a clip: kept where they are good, steadied where they jump to and fro, and told."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.errors import InputError
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import NoticeCode
from intrasplat.options import Poses, ReconstructionOptions
from intrasplat.poses import StoredPoses, estimate, with_poses
from intrasplat.poses.chain import Chain
from intrasplat.poses.trajectory import trajectory_error
from intrasplat.scene.scene import POSE_WARNINGS
from lab.conditions.clean import clean_of
from lab.conditions.scenes import noisy
from lab.evaluate.sources import open_source, source_of
from lab.phantom import PhantomSettings, make_phantom
from lab.phantom.scene import Phantom


@cache
def drawn(path: str) -> DepthClip:
    """Callers share the arrays."""
    return open_source(source_of(f"phantom:breathing+{path}:96x80:32frames"), "none", Hooks()).clip


def brought(path: str, noise_mm: float) -> tuple[DepthClip, DepthClip]:
    """A clip with depth and its true poses, and the same with poses that err."""
    clip = drawn(path)
    poses = noisy(clip.world_from_camera, noise_mm, np.random.default_rng(1))
    return clip, replace(clip, world_from_camera=poses)


def posed(clip: DepthClip, poses: Poses = "auto") -> DepthClip:
    return with_poses(clip, ReconstructionOptions(poses=poses, holdout="none"), Hooks(), Timings())


@pytest.mark.parametrize("path", ["swing", "turn", "shake"])
def test_smooth_and_shaken_poses_stay_as_they_were_given(path: str) -> None:
    clip, _ = brought(path, 0.0)
    result = posed(clip)
    np.testing.assert_array_equal(result.world_from_camera, clip.world_from_camera)
    assert result.poses is not None
    assert result.poses.source == "given"
    assert result.poses.steadied_mm is None
    assert result.warnings == clip.warnings
    assert result.assumptions == clip.assumptions


@pytest.mark.parametrize("path", ["swing", "roll"])
def test_poses_that_jump_are_refined_to_half_of_their_noise_and_the_rest_is_told(path: str) -> None:
    clip, given = brought(path, 1.0)
    result = posed(given)
    before, after = (trajectory_error(each.world_from_camera, clip.world_from_camera) for each in (given, result))
    assert after.mm < 0.5 * before.mm
    assert after.deg < 0.5 * before.deg
    assert result.poses is not None
    assert result.poses.steadied_mm == pytest.approx(1.0 * np.sqrt(5), rel=0.3)
    assert [notice.code for notice in result.warnings] == [NoticeCode.POSE_JITTER]
    assert [notice.code for notice in result.assumptions if notice not in clip.assumptions] == [NoticeCode.POSES]


def test_poses_that_must_be_given_stay_as_they_are_and_their_jumps_are_told() -> None:
    _, given = brought("swing", 1.0)
    result = posed(given, "given")
    np.testing.assert_array_equal(result.world_from_camera, given.world_from_camera)
    assert [notice.code for notice in result.warnings if notice not in given.warnings] == [NoticeCode.POSE_JITTER]
    assert NoticeCode.POSE_JITTER in POSE_WARNINGS  # so every view repeats it


@dataclass(frozen=True)
class JumpingPhantom(Phantom):
    """A phantom whose endoscope itself jumps to and fro from frame to frame."""

    def world_from_camera(self, frame: float) -> NDArray[np.float64]:
        still = np.tile(np.eye(4), (self.settings.frames, 1, 1))
        return noisy(still, 0.7, np.random.default_rng(1))[round(frame)]


def test_jumps_that_the_pictures_show_are_the_cameras() -> None:
    made = make_phantom(PhantomSettings(width=96, height=80, frames=32, motion="breathing"))
    jumping = JumpingPhantom(**{each.name: getattr(made, each.name) for each in fields(made)})
    clip = clean_of(jumping).clip
    result = posed(clip)
    np.testing.assert_array_equal(result.world_from_camera, clip.world_from_camera)


def test_poses_that_jump_stay_where_no_frames_show_common_tissue(monkeypatch: pytest.MonkeyPatch) -> None:
    _, given = brought("swing", 1.0)
    monkeypatch.setattr(estimate, "chained", lambda *_: Chain([0], np.eye(4)[None], []))
    result = posed(given)
    np.testing.assert_array_equal(result.world_from_camera, given.world_from_camera)
    assert [notice.code for notice in result.warnings] == [NoticeCode.POSE_JITTER]


@pytest.mark.parametrize("poses", ["fixed", "estimate"])
def test_a_file_of_poses_that_the_options_do_not_use_is_refused(poses: Poses) -> None:
    clip = replace(drawn("swing"), poses=None)
    stored = StoredPoses(clip.world_from_camera)
    with pytest.raises(InputError) as refused:
        with_poses(clip, ReconstructionOptions(poses=poses, holdout="none"), Hooks(), Timings(), stored)
    assert refused.value.field == "options.poses"
