"""A number a Gaussian, blended beside colour in the same walk."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from intrasplat.splat.cpu import Rasterizer
from tests.helpers import assert_close
from tests.intrasplat.splat.scenes import pixels_near_a_cut, random_scene
from tests.intrasplat.splat.test_cpu import project_with


def test_a_value_is_blended_as_colour_is_and_leaves_the_rest_as_it_was() -> None:
    scene = random_scene(220, width=45, height=37, seed=37).to(torch.float32)
    values = torch.rand(220, generator=torch.Generator().manual_seed(0))
    grey = dataclasses.replace(scene, colour=values[:, None].repeat(1, 3)).to(torch.float64)
    rasterizer = Rasterizer(45, 37)
    project_with(rasterizer, scene)
    without = rasterizer.render().copy()
    project_with(rasterizer, scene)
    with_values = rasterizer.render(values.numpy())
    assert without.shape == (5, 37, 45)
    assert np.array_equal(with_values[:5], without)
    assert_close(with_values[5], grey.render().rgb[..., 0], where=~pixels_near_a_cut(scene), name="values")
