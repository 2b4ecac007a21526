"""Rays, what they show, and the box that they cross."""

from __future__ import annotations

import torch

from lab.rivals.fields import SOLID, Box, cumulated, drawn_pixels, rays, weights_along
from lab.rivals.rival import Seen
from tests.lab.rivals.cases import small_clip


def test_pixels_are_drawn_in_proportion_to_their_weights() -> None:
    weight = torch.tensor([[0.0, 1.0], [3.0, 0.0]])
    drawn = drawn_pixels(cumulated(weight), 8000, torch.Generator().manual_seed(0))
    count = torch.bincount(drawn, minlength=4)
    assert count[0] == count[3] == 0
    assert 2.7 < float(count[2] / count[1]) < 3.3


def test_a_ray_shows_what_passes_through_the_samples_before() -> None:
    density, length = torch.tensor([[0.0, 2.0, 0.5, 1.0]]), torch.tensor([[0.3, 0.5, 0.2, SOLID]])
    through = torch.exp(-torch.tensor([0.0, 0.0, 1.0, 1.1]))
    want = through * torch.tensor([0.0, 1 - torch.exp(torch.tensor(-1.0)), 1 - torch.exp(torch.tensor(-0.1)), 1.0])
    found = weights_along(density, length)
    torch.testing.assert_close(found, want[None])
    assert torch.allclose(found.sum(), torch.tensor(1.0)), "its last sample is opaque"


def test_the_box_holds_what_is_measured_and_s_is_even_in_inverse_depth() -> None:
    seen = Seen.of(small_clip(3), range(3), dtype=torch.float64)
    box = Box.of(seen)
    frame, row, column = torch.nonzero(seen.depth_mm > 0, as_tuple=True)
    depth_mm = seen.depth_mm[frame, row, column]
    origin, direction = rays(seen.intrinsics, row, column, seen.world_from_camera[frame])
    place = box.place(origin + depth_mm[:, None] * direction)
    assert float((place.abs() <= 1).all(1).double().mean()) > 0.99
    assert bool((place.amax(0) > 0.85).all())
    assert bool((place.amin(0) < -0.85).all()), "and little else"
    share = box.share_of(depth_mm)
    assert float(share.min()) < 0.06
    assert float(share.max()) > 0.94
    torch.testing.assert_close(box.depth_mm(share), depth_mm, rtol=1e-6, atol=1e-6)
    s = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    near, middle, far = (1 / box.depth_mm(s)).tolist()
    assert near > middle > far > 0
    assert abs(near + far - 2 * middle) < 1e-12
