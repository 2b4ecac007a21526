"""Poses from a file or a layout, read in the unit, direction and axes that fit the pictures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from intrasplat.clip import DepthClip
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import NoticeCode
from intrasplat.options import Poses, ReconstructionOptions
from intrasplat.poses import StoredPoses, with_poses
from intrasplat.poses.agreement import OPENCV_AXES, Axes
from intrasplat.poses.rigid import Reals, exp, inverse
from intrasplat.poses.trajectory import trajectory_error
from intrasplat.stereo import match_eyes
from lab.phantom import CameraPath, Motion, PhantomSettings, make_phantom

WORLD = exp(np.array([30.0, -20.0, 50.0, 0.5, 0.8, -0.3]))
STAMPS = np.arange(14.0)


@cache
def drawn(motion: Motion, *camera: CameraPath) -> tuple[DepthClip, Reals]:
    """A stereo clip without poses, and the true ones in another world. Callers share the arrays."""
    phantom = make_phantom(
        PhantomSettings(
            width=160, height=128, frames=14, motion=motion, tools=(), camera=camera, period_frames=12.0,
            frame_rate_hz=10.0,
        )
    )  # fmt: skip
    recording = phantom.stereo_recording()
    clip = match_eyes(recording.clip, recording.calibration, "every8", Hooks(), Timings())
    return clip, WORLD @ np.stack([phantom.world_from_camera(i) for i in range(14)])


def written(poses: Reals, *, unit_mm: float = 1.0, to_world: bool = True, axes: Axes = "opencv") -> Reals:
    """True poses as a file of this convention has them."""
    stored = poses @ np.linalg.inv(OPENCV_AXES[axes])
    stored = stored.copy() if to_world else inverse(stored)
    stored[:, :3, 3] /= unit_mm
    return stored


def posed(clip: DepthClip, stored: StoredPoses | None, poses: Poses = "auto") -> DepthClip:
    return with_poses(clip, ReconstructionOptions(poses=poses), Hooks(), Timings(), stored)


def told(clip: DepthClip) -> str:
    (text,) = (each.text for each in clip.assumptions if each.code is NoticeCode.POSES)
    return text


@pytest.mark.parametrize("path", [("still", "swing"), ("breathing", "pan"), ("breathing", "shake")])
@pytest.mark.parametrize(
    ("unit_mm", "to_world", "axes", "said"),
    [
        (1000.0, True, "opencv", "camera-to-world in m, OpenCV axes; which fits"),
        (1.0, True, "opencv", "camera-to-world in mm, OpenCV axes"),
        (1000.0, False, "opencv", "world-to-camera in m, OpenCV axes; not as"),
        (1000.0, True, "opengl", "camera-to-world in m, OpenGL axes; not as"),
        (1.0, False, "opengl", "world-to-camera in mm, OpenGL axes"),
    ],
)
def test_poses_in_any_convention_are_read_as_the_pictures_show(
    path: tuple[Motion, CameraPath], unit_mm: float, to_world: bool, axes: Axes, said: str
) -> None:
    clip, true = drawn(*path)
    stored = StoredPoses(written(true, unit_mm=unit_mm, to_world=to_world, axes=axes), STAMPS)
    result = posed(clip, stored)
    error = trajectory_error(result.world_from_camera, true)
    assert error.mm < 1e-3
    assert error.deg < 1e-3
    assert said in told(result)
    assert result.poses is not None
    assert result.poses.source == "given"
    assert not {each.code for each in result.warnings} & {NoticeCode.POSES_CONTRADICT, NoticeCode.POSE_JITTER}
    assert result.right is not None
    left_from_right = np.linalg.inv(result.world_from_camera) @ result.right.world_from_camera
    np.testing.assert_allclose(left_from_right, left_from_right[:1].repeat(14, 0), atol=1e-9)


def test_a_factor_of_1000_is_told() -> None:
    clip, true = drawn("still", "swing")
    assert "a factor of 1000" in told(posed(clip, StoredPoses(written(true, unit_mm=1000.0))))
    assert "a factor of 1000" in told(posed(clip, StoredPoses(true, STAMPS)))
    assert "a factor" not in told(posed(clip, StoredPoses(true)))


def test_poses_of_another_clip_are_not_used_unless_they_must_be() -> None:
    clip, _ = drawn("still", "shake")
    _, other = drawn("breathing", "pan")
    stored = StoredPoses(other)
    result = posed(clip, stored)
    assert NoticeCode.POSES_CONTRADICT in {each.code for each in result.warnings}
    assert result.poses is not None
    assert result.poses.source != "given"
    forced = posed(clip, stored, "given")
    assert NoticeCode.POSES_CONTRADICT in {each.code for each in forced.warnings}
    assert forced.poses is not None
    assert forced.poses.source == "given"
    assert trajectory_error(forced.world_from_camera, other).mm < 1e-3


def test_a_camera_that_rests_leaves_the_convention_told() -> None:
    clip, true = drawn("breathing")
    result = posed(clip, StoredPoses(written(true, unit_mm=1000.0), STAMPS))
    assert "camera-to-world in m, OpenCV axes; which the pictures cannot check" in told(result)
    np.testing.assert_allclose(result.world_from_camera, np.eye(4)[None].repeat(14, 0), atol=1e-6)


@pytest.mark.parametrize("motion", ["still", "breathing"])
@pytest.mark.parametrize(
    ("to_world", "axes", "said"),
    [(True, "opengl", ""), (False, "opengl", "world-to-camera"), (True, "llff", "LLFF"), (True, "opencv", "OpenCV")],
)
def test_poses_of_a_layout_are_corrected(motion: Motion, to_world: bool, axes: Axes, said: str) -> None:
    clip, true = drawn(motion, "pan")
    parsed = written(true, to_world=to_world, axes=axes) @ OPENCV_AXES["opengl"]  # as by --pose-convention opengl
    relative = inverse(parsed[0]) @ parsed
    result = posed(replace(clip, right=None, world_from_camera=relative, first_pose=parsed[0]), None)
    assert trajectory_error(result.world_from_camera, true).mm < 1e-3
    notices = [each.text for each in result.assumptions if each.code is NoticeCode.POSES]
    assert len(notices) == (1 if said else 0)
    assert all(said in each for each in notices)
