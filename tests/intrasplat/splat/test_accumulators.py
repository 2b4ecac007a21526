"""Gradients are summed in accumulators (intrasplat/splat/cpu/bins.py): each addition once, for splats of any shape."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from intrasplat.splat.cpu import Rasterizer
from tests.helpers import assert_close
from tests.intrasplat.splat.scenes import pixels_near_a_cut, random_scene
from tests.intrasplat.splat.test_cpu import NORMALISED, assert_same_bits, project_with, random_frame


def test_a_second_backward_of_one_projection_gives_the_same_bits() -> None:
    scene = random_scene(60, width=45, height=37, seed=31)
    frame = random_frame(scene.camera, np.zeros((37, 45), bool))
    rasterizer = Rasterizer(45, 37)
    project_with(rasterizer, scene)
    target, settings = frame.target(rasterizer), frame.kernel_settings(NORMALISED)
    first = rasterizer.loss_backward(target, settings).state[:10].copy()
    assert_same_bits([rasterizer.loss_backward(target, settings).state[:10]], [first])


def test_tall_thin_and_long_splats_have_the_gradients_of_the_loss() -> None:
    """Ellipses over many tiles, bands and blocks, upright and aslant, whose alpha spans more than float32 does."""
    scene = random_scene(70, width=300, height=150, seed=36, pixels=1.0).to(torch.float32)
    scale = scene.scale.clone()
    scale[:, 0] *= torch.linspace(1, 40, 70)
    scene = dataclasses.replace(scene, scale=scale)
    left_out = pixels_near_a_cut(scene)
    frame = random_frame(scene.camera, left_out)
    rasterizer = Rasterizer(300, 150)
    project_with(rasterizer, scene)
    got = rasterizer.loss_backward(frame.target(rasterizer), frame.kernel_settings(NORMALISED))
    live = scene.to(torch.float64).differentiable()
    leaves = live.leaves()
    gradients = torch.autograd.grad(frame.loss(live, NORMALISED), list(leaves.values()))
    wanted = dict(zip(leaves, gradients, strict=True))
    assert_close(got.state[0:3, :70].T, wanted["mean"], name="mean")
    assert_close(got.state[3:7, :70].T, wanted["quaternion"], name="quaternion")
    assert_close(got.state[7:10, :70].T, wanted["scale"] * live.scale.detach(), name="log_scale")
    assert_close(got.colour[:, :70].T, wanted["colour"], name="colour")
