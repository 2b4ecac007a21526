"""What left the view is trusted less the longer it is away; under a fixed camera nothing changes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from intrasplat.scene.model import model_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.view.out_of_view import FADES_IN_S, REMAINING_TRUST, OutOfView
from intrasplat.view.render import render_frame
from tests.intrasplat.scenes import random_scene

FRAMES = 12


def panned() -> TrainedScene:
    """Two Gaussians at rest, 20 mm apart; the first half of the clip shows one, the second half the other."""
    scene = random_scene(count=2)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[FRAMES // 2 :, 0, 3] = 80.0
    still = dataclasses.replace(scene.deformation, weight=torch.zeros_like(scene.deformation.weight))  # type: ignore[type-var]
    unit = scene.units_per_mm
    gaussians = dataclasses.replace(
        scene.gaussians,
        mean=torch.tensor([[0.0, 0.0, 80.0 * unit], [80.0 * unit, 0.0, 80.0 * unit]]),
        log_scale=torch.full((2, 3), 1.5),
        opacity_logit=torch.full((2,), 4.0),
    )
    return dataclasses.replace(
        scene,
        gaussians=gaussians,
        deformation=still,
        world_from_camera=poses,
        frame_times_s=np.arange(FRAMES) * 0.5,
        trained_t=tuple(index / FRAMES for index in range(FRAMES)),
        seen=torch.ones(2),
    )


def test_trust_falls_with_the_time_out_of_view_and_to_a_rest() -> None:
    scene = panned()
    away = OutOfView.of(scene, model_of(scene))
    assert away is not None
    values = np.array([0.8, -0.1], np.float32)
    trust = np.array([away.faded(values, time_s) for time_s in scene.frame_times_s])
    np.testing.assert_allclose(trust[: FRAMES // 2, 0], 0.8, rtol=1e-6)
    later = trust[FRAMES // 2 :, 0]
    assert (np.diff(later) < 0).all()
    assert later[-1] == pytest.approx(0.8 * REMAINING_TRUST, rel=0.05)
    assert (trust[:, 1] == values[1]).all(), "what was never seen stays so"


def test_between_two_frames_that_see_it_nothing_was_away() -> None:
    scene = panned()
    away = OutOfView.of(scene, model_of(scene))
    assert away is not None
    values = np.ones(2, np.float32)
    for time_s in np.linspace(0, 2.5, 11):
        assert away.faded(values, float(time_s))[0] == 1
    assert away.faded(values, 2.5 + 0.5 + FADES_IN_S)[0] < 1


def test_a_view_of_what_left_is_less_sure_than_it_was() -> None:
    scene = panned()
    before, after = (render_frame(scene, t, np.eye(4)) for t in (0.0, (FRAMES - 1) / FRAMES))
    assert 0 < after.confidence.max() < before.confidence.max()
    np.testing.assert_array_equal(before.rgb, after.rgb)


def test_a_fixed_camera_keeps_everything_in_view() -> None:
    scene = panned()
    fixed = dataclasses.replace(scene, world_from_camera=np.tile(np.eye(4), (FRAMES, 1, 1)))
    assert OutOfView.of(fixed, model_of(fixed)) is None
