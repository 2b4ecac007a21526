"""What a view shows of the gloss: each eye its own highlights, far from both the tissue without them.
And by how much a view enlarges the recording."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from intrasplat.notices import NoticeCode
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.layout import ENLARGED, POSE, RECORDED
from intrasplat.splat.step import camera_vector
from intrasplat.train.targets import camera_in_units
from intrasplat.view.camera import FADING, endoscope_pose, gloss_seen, nearest_recorder, view_camera
from intrasplat.view.render import render_frame
from tests.intrasplat.scenes import random_scene

RIGHT_EYE_MM = (3.0, 0.0, 4.0)
BASELINE_MM = 5.0
T = 0.5


@pytest.fixture
def scene() -> TrainedScene:
    """Each Gaussian is solid, and one eye saw it brighter, some the left eye, some the right one."""
    made = random_scene(count=40)
    turned = made.world_from_camera.copy()
    turned[:, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    gaussians = dataclasses.replace(
        made.gaussians,
        opacity_logit=torch.full_like(made.gaussians.opacity_logit, 4.0),
        gloss=torch.linspace(-0.4, 0.4, 40),
    )
    return dataclasses.replace(made, gaussians=gaussians, world_from_camera=turned, right_eye_mm=RIGHT_EYE_MM)


def beside(scene: TrainedScene, place: float, away_mm: float = 0.0) -> NDArray[np.float64]:
    """The endoscope's pose [4, 4], moved along the baseline (1: to the right eye) and away from it."""
    pose = endoscope_pose(scene, T)
    pose[:3, 3] += pose[:3, :3] @ (place * np.array(RIGHT_EYE_MM) + [0, away_mm, 0])
    return pose


@pytest.mark.parametrize(
    ("place", "away_mm", "side"),
    [
        (0.0, 0.0, -0.5),
        (1.0, 0.0, 0.5),
        (0.5, 0.0, 0.0),
        (0.75, 0.0, 0.25),
        (0.0, 1000.0, 0.0),
        (1.0, 1000.0, 0.0),
        (1.0, FADING * BASELINE_MM, np.exp(-0.5) / 2),
        (2.0, 0.0, np.exp(-0.5 / FADING**2) / 2),
    ],
)
def test_each_eye_sees_its_highlights_and_away_from_both_a_view_sees_their_mean(
    scene: TrainedScene, place: float, away_mm: float, side: float
) -> None:
    centre_mm = beside(scene, place, away_mm)[:3, 3]
    assert gloss_seen(scene, T, centre_mm) == pytest.approx((side, 0.0), abs=1e-12)
    assert gloss_seen(scene, T, centre_mm, highlights=False) == (0.0, 0.5)


def test_a_scene_of_one_eye_has_no_gloss_to_see(scene: TrainedScene) -> None:
    one_eyed = dataclasses.replace(scene, right_eye_mm=None)
    for highlights in (True, False):
        assert gloss_seen(one_eyed, T, np.zeros(3), highlights=highlights) == (0.0, 0.0)
    on, off = (render_frame(one_eyed, T, highlights=each) for each in (True, False))
    np.testing.assert_array_equal(on.rgb, off.rgb)
    assert [each.code for each in off.warnings if each not in on.warnings] == [NoticeCode.HIGHLIGHTS_UNKNOWN]


@pytest.mark.parametrize("place", [0.0, 1.0])
def test_without_highlights_no_pixel_is_brighter_than_an_eye_saw_it(scene: TrainedScene, place: float) -> None:
    on, off = (render_frame(scene, T, beside(scene, place), highlights=each) for each in (True, False))
    assert (off.rgb <= on.rgb).all()
    assert (on.rgb.astype(int) - off.rgb).max() > 5
    np.testing.assert_array_equal(off.depth_mm, on.depth_mm)
    assert off.warnings == on.warnings


def test_far_from_both_eyes_a_view_shows_what_it_would_without_gloss(scene: TrainedScene) -> None:
    far = beside(scene, 0.5, 6 * BASELINE_MM)
    one_eyed = dataclasses.replace(scene, right_eye_mm=None)
    np.testing.assert_array_equal(render_frame(scene, T, far).rgb, render_frame(one_eyed, T, far).rgb)
    assert (render_frame(scene, T, far).rgb > render_frame(scene, T, far, highlights=False).rgb).any()


@pytest.mark.parametrize("scale", [0.5, 1.0])
@pytest.mark.parametrize("t", [0.0, 0.21, 0.5, 0.83])
def test_the_endoscopes_own_view_is_to_the_bit_what_training_saw(t: float, scale: float) -> None:
    scene = random_scene()  # whose camera moves
    pose = endoscope_pose(scene, t)
    lens = scene.intrinsics.resized(round(64 * scale), round(48 * scale))
    trained_on = camera_vector(camera_in_units(lens, pose, scene.units_per_mm))
    np.testing.assert_array_equal(view_camera(scene, t, pose, lens), trained_on)


def test_a_longer_lens_and_a_nearer_place_enlarge_alike(scene: TrainedScene) -> None:
    middle = np.array([0.0, 0.0, 60 / scene.units_per_mm, 1.0])

    def enlarged(pose: NDArray[np.float64], scale: int) -> NDArray[np.float64]:
        lens = scene.intrinsics.resized(scale * scene.intrinsics.width, scale * scene.intrinsics.height)
        camera = view_camera(scene, T, pose, lens)
        in_units = middle * [*[scene.units_per_mm] * 3, 1]
        depth = camera[POSE + 8 :] @ in_units
        return np.asarray(camera[ENLARGED : ENLARGED + 2] * (camera[RECORDED : RECORDED + 4] @ in_units) / depth)

    own = endoscope_pose(scene, T)
    nearer = own.copy()
    nearer[2, 3] += middle[2] / 2
    np.testing.assert_allclose(enlarged(own, 2), [2, 2], rtol=1e-9)
    np.testing.assert_allclose(enlarged(nearer, 1), [2, 2], rtol=1e-9)
    np.testing.assert_allclose(enlarged(nearer, 3), [6, 6], rtol=1e-9)


def test_of_all_places_of_the_endoscope_the_nearest_to_a_view_recorded_it() -> None:
    made = random_scene()
    poses = made.world_from_camera.copy()
    poses[:, 2, 3] = 10.0 * np.arange(6)
    scene = dataclasses.replace(made, world_from_camera=poses)  # it stands at 30 mm; frames 0 and 2 are trained on
    places_mm = (0.0, 21.0, 28.0, 41.0)
    found = [nearest_recorder(scene, 0.5, np.array([0.0, 0.0, each]))[2, 3] for each in places_mm]
    assert found == [0.0, 20.0, 30.0, 30.0]
