"""Logits and log-scales far beyond what training reaches: the image still follows them, and gradients stay numbers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.splat.camera import Camera
from intrasplat.splat.cpu import Rasterizer
from intrasplat.splat.cpu.vectors import LANES
from intrasplat.splat.step import camera_vector

SIZE = 24
VIEW = camera_vector(Camera(30.0, 30.0, SIZE / 2, SIZE / 2, SIZE, SIZE, np.eye(4)))
FAR_OUT = [-np.inf, -3e38, -1e4, -150.0, -104.0, -100.0, -90.0, -88.9, -88.0, -85.0, -60.0, -20.0]
NEITHER = [-10.0, -1.0, 0.0, 1.0, 3.0, 10.0]


def alpha_of(
    logit: float, log_scale: float | NDArray[np.float32], quaternion: tuple[float, ...] = (1.0, 0.3, 0.2, 0.5)
) -> NDArray[np.float32]:
    """[H, W] alpha of one Gaussian in the middle of the image, once all its gradients are known to be finite."""
    state = np.zeros((10, LANES), np.float32)
    state[2], state[3:7], state[7:] = 60.0, np.array(quaternion)[:, None], np.reshape(log_scale, (-1, 1))
    logits = np.full(LANES, -30.0, np.float32)
    logits[0] = logit
    rasterizer = Rasterizer(SIZE, SIZE)
    rasterizer.project_and_sort(VIEW, state, logits, np.ones((3, LANES), np.float32))
    alpha: NDArray[np.float32] = rasterizer.render()[4].copy()
    gradients = rasterizer.cotangent_backward(np.ones((5, SIZE, SIZE), np.float32))
    for field in dataclasses.fields(gradients):
        values = getattr(gradients, field.name)
        assert np.isfinite(values[:10] if field.name == "state" else values).all(), field.name
    assert np.isfinite(alpha).all()
    return alpha


def test_alpha_never_falls_as_the_logit_rises() -> None:
    logits = [*FAR_OUT, *NEITHER, *(-each for each in reversed(FAR_OUT))]
    assert logits == sorted(logits)
    most = [alpha_of(logit, 1.0).max() for logit in logits]
    assert most == sorted(most)
    assert most[: len(FAR_OUT)] == [0.0] * len(FAR_OUT)
    assert most[-1] > 0.85


def test_alpha_never_falls_as_a_round_gaussian_grows() -> None:
    log_scales = [*FAR_OUT, *NEITHER, *(-each for each in reversed(FAR_OUT))]
    least = [alpha_of(2.0, log_scale).min() for log_scale in log_scales]
    assert np.diff(least).min() > -1e-6  # of the cap on alpha and of rounding
    full = 1 / (1 + np.exp(-2.0))
    assert least[-len(FAR_OUT) :] == pytest.approx([full] * len(FAR_OUT), abs=1e-6)


def test_a_needle_however_long_is_finite_and_as_bright() -> None:
    for quaternion in ((1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.3), (0.7, 0.2, -0.4, 0.1)):
        long = alpha_of(2.0, np.array([9.0, 0.0, 0.0], np.float32), quaternion)
        for log_scale in (12.0, 16.0, 60.0, 90.0, 1e4):
            longer = alpha_of(2.0, np.array([log_scale, 0.0, 0.0], np.float32), quaternion)
            assert longer == pytest.approx(long, abs=2e-3)
