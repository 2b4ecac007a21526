"""The paths that the endoscope follows: how far they go, that they can be combined, and that tissue is wherever they
look.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lab.phantom import CAMERA_PATHS, CameraPath, Motion, Phantom, PhantomSettings, make_phantom, scene
from lab.phantom.camera import endoscope_pose, farther_mm
from lab.phantom.settings import MEAN_DEPTH_MM

FRAMES = 65


@pytest.fixture(scope="module", autouse=True)
def _nothing_is_painted() -> Iterator[None]:
    """Only the tissue's shape matters here, and its paint takes ten times as long."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(scene, "paint_tissue", lambda *_: None)
        yield


def settings(*camera: CameraPath, frames: int = FRAMES, motion: Motion = "breathing") -> PhantomSettings:
    return PhantomSettings(96, 80, frames, motion, camera=camera)


def poses(*camera: CameraPath) -> NDArray[np.float64]:
    return np.stack([endoscope_pose(frame, settings(*camera)) for frame in range(FRAMES)])


def turned_deg(pose: NDArray[np.float64]) -> float:
    return float(np.rad2deg(Rotation.from_matrix(pose[:3, :3]).magnitude()))


@pytest.mark.parametrize("path", CAMERA_PATHS)
def test_a_path_starts_at_the_world_is_rigid_and_leaves_it(path: CameraPath) -> None:
    found = poses(path)
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)
    for pose in found:
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    farthest = max(found, key=lambda pose: float(np.linalg.norm(pose - np.eye(4))))
    assert turned_deg(farthest) > 1 or np.linalg.norm(farthest[:3, 3]) > 2


def test_a_pan_goes_one_and_a_half_views_to_the_right() -> None:
    camera = settings().intrinsics
    view_mm = MEAN_DEPTH_MM * camera.width / camera.fx
    assert poses("pan")[-1, 0, 3] == pytest.approx(1.5 * view_mm)
    assert (np.diff(poses("pan")[:, 0, 3]) > 0).all()


def test_an_advance_comes_nearer_by_30_mm_and_goes_back() -> None:
    ahead_mm = poses("advance")[:, 2, 3]
    assert ahead_mm.max() == pytest.approx(30)
    assert ahead_mm[-1] == pytest.approx(0, abs=1e-9)


def test_a_roll_turns_by_20_degrees_about_the_optical_axis() -> None:
    last = poses("roll")[-1]
    assert turned_deg(last) == pytest.approx(20)
    np.testing.assert_allclose(last[:3, 2], (0, 0, 1), atol=1e-12)


def test_a_fast_turn_takes_a_second_and_a_half_about_a_port_behind_the_endoscope() -> None:
    rate_hz = settings().frame_rate_hz
    before, after = (endoscope_pose(seconds * rate_hz, settings("turn")) for seconds in (0.4, 1.9))
    np.testing.assert_allclose(before, np.eye(4), atol=1e-12)
    assert turned_deg(after) == pytest.approx(5)
    port_mm = (0, 0, -120, 1)
    np.testing.assert_allclose(after @ port_mm, port_mm, atol=1e-9)


def test_a_shake_trembles_and_stays_near() -> None:
    found = poses("shake")
    assert 1 < np.linalg.norm(found[:, :3, 3], axis=1).max() < 5
    assert 0.5 < max(map(turned_deg, found)) < 3
    steps_mm = np.diff(found[:, 1, 3])
    assert np.count_nonzero(np.diff(np.sign(steps_mm))) > 6, "it turns back many times"


def test_paths_are_followed_at_once_in_whatever_order_they_are_named() -> None:
    both = poses("pan", "shake")
    np.testing.assert_allclose(both, poses("pan") @ poses("shake"), atol=1e-12)
    np.testing.assert_array_equal(both, poses("shake", "pan"))


def corners(made: Phantom) -> list[float]:
    """The least depth that the right and the left eye see in the four corners and the middle of first, middle and last
    frames: 0 where there is no tissue."""
    found = []
    for frame in np.linspace(0, made.settings.frames - 1, 7):
        for pose in (made.world_from_camera(frame), made.world_from_right(frame)):
            found.append(float(made.surface_pixels(frame, pose).depth_mm.min()))
    return found


@pytest.mark.parametrize("motion", ["breathing", "pull"])
@pytest.mark.parametrize("path", CAMERA_PATHS)
def test_wherever_a_path_looks_there_is_tissue(path: CameraPath, motion: Motion) -> None:
    assert min(corners(make_phantom(settings(path, motion=motion)))) > 10


@pytest.mark.parametrize("pair", list(itertools.combinations(CAMERA_PATHS, 2)))
def test_so_there_is_for_two_at_once(pair: tuple[CameraPath, CameraPath]) -> None:
    assert min(corners(make_phantom(settings(*pair)))) > 10


def test_a_fixed_and_a_swinging_endoscope_need_no_more_tissue_than_the_usual() -> None:
    assert farther_mm(settings(), 100) == farther_mm(settings("swing"), 100) == (0, 0)
    assert farther_mm(settings("pan"), 100)[0] > 130


def test_points_that_come_into_view_have_their_way_too() -> None:
    panned = make_phantom(settings("pan"))
    late = panned.trajectories(stride_px=4, shown_in=FRAMES - 1)
    assert late.points_mm.shape[0] == FRAMES
    row, column = late.pixels.T
    pose = panned.world_from_camera(FRAMES - 1)
    z_mm = ((late.points_mm[-1] - pose[:3, 3]) @ pose[:3, :3])[:, 2]
    np.testing.assert_allclose(z_mm, panned.surface_pixels(FRAMES - 1).depth_mm[row, column], rtol=1e-5)
    assert (late.points_mm[0, :, 0] > 60).all(), "frame 0 does not show them"
