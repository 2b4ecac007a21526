"""Rigid motions, and their estimation from matches."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from intrasplat.poses.rigid import StereoCamera, align, between, exp, inverse, log

CAMERA = StereoCamera(fx=285.0, fy=285.0, cx=159.5, cy=127.5, baseline_mm=4.3)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.5, 2.0])
def test_log_undoes_exp(size: float) -> None:
    twist = size * np.array([3.0, -2.0, 5.0, 0.6, -0.5, 0.4])
    assert_allclose(log(exp(twist)), twist, atol=1e-9)
    assert_allclose(inverse(exp(twist)) @ exp(twist), np.eye(4), atol=1e-12)


def test_slopes_are_those_of_what_is_seen() -> None:
    points = np.random.default_rng(0).uniform([-30, -30, 50], [30, 30, 110], (20, 3))
    slopes = CAMERA.slopes(points)
    for axis, step in enumerate(np.eye(6) * 1e-5):
        motion = exp(step)
        moved = points @ motion[:3, :3].T + motion[:3, 3]
        assert_allclose(slopes[:, :, axis], (CAMERA.seen(moved) - CAMERA.seen(points)) / 1e-5, rtol=1e-3, atol=1e-3)


def test_alignment_finds_the_motion_of_most_matches() -> None:
    random = np.random.default_rng(1)
    points = random.uniform([-30, -30, 60], [30, 30, 100], (600, 3))
    motion = exp(np.array([4.0, -2.0, 3.0, 0.02, -0.03, 0.05]))
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    moved[:200] += [6.0, 0.0, -5.0]  # a third is pulled aside
    before = CAMERA.seen(points) + random.normal(0, 0.1, (600, 3))
    after = CAMERA.seen(moved) + random.normal(0, 0.1, (600, 3))
    found = align(CAMERA, before, after, np.ones(600), np.eye(4))
    off = log(found.motion @ inverse(motion))
    assert np.linalg.norm(off[:3]) < 0.3
    assert np.linalg.norm(off[3:]) < np.radians(0.25)
    assert found.weight[:200].mean() < 0.1 < found.weight[200:].mean()


def test_between_two_frames_the_camera_moves_evenly() -> None:
    end = exp(np.array([4.0, 0.0, 0.0, 0.0, 0.4, 0.0]))
    poses = np.stack([np.eye(4), end])
    assert between([2, 6], poses, 3) == pytest.approx(exp(np.array([1.0, 0.0, 0.0, 0.0, 0.1, 0.0])))
    assert (between([2, 6], poses, 1) == np.eye(4)).all()
    assert (between([2, 6], poses, 9) == end).all()
