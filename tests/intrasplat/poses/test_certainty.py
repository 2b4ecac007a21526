"""What is expected of a path's error is the error that such noise makes."""

from __future__ import annotations

import numpy as np
import pytest

from intrasplat.poses.certainty import aligned_sigma, by_place_and_turn
from intrasplat.poses.rigid import Reals, exp
from intrasplat.poses.trajectory import trajectory_error

FRAMES = 24


def path() -> Reals:
    """[K, 4, 4] a camera that moves by 40 mm and turns by 20 degrees."""
    done = np.linspace(0, 1, FRAMES)
    return np.stack([exp(np.array([40 * s, 5 * s**2, 0, 0, 0.35 * s, 0])) for s in done])


def test_what_moves_all_cameras_alike_is_no_error() -> None:
    alike = np.tile(np.eye(6), (FRAMES, FRAMES))
    sigma = aligned_sigma(by_place_and_turn(alike, path()), path())
    assert sigma == pytest.approx((0, 0), abs=1e-5)


def test_the_expected_error_is_that_of_noisy_paths() -> None:
    random = np.random.default_rng(0)
    sizes = np.repeat([0.4, 0.004], 3)
    slow = np.exp(-np.square(np.subtract.outer(np.arange(FRAMES), np.arange(FRAMES)) / 6.0) / 2)
    of_twists = np.kron(slow, np.diag(sizes**2))
    root = np.linalg.cholesky(of_twists + 1e-9 * np.eye(6 * FRAMES))
    errors = []
    for _ in range(400):
        twists = (root @ random.standard_normal(6 * FRAMES)).reshape(FRAMES, 6)
        noisy = np.stack([exp(twist) @ pose for twist, pose in zip(twists, path(), strict=True)])
        error = trajectory_error(noisy, path())
        errors.append((error.mm, error.deg))
    expected = aligned_sigma(by_place_and_turn(of_twists, path()), path())
    assert expected == pytest.approx(tuple(np.sqrt(np.square(errors).mean(0))), rel=0.05)
