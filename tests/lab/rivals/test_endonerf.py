"""A canonical field that a network displaces into."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from lab.rivals import endonerf
from lab.rivals.endonerf import EndoNerf, EndoNerfSettings, _encoded
from lab.rivals.rival import Seen
from tests.lab.rivals.cases import (
    check_gradient,
    check_moving_camera,
    check_overfit,
    check_what_counts,
    fitted,
    plain,
    small_clip,
    weights_drawn_by,
)

SMALL = EndoNerfSettings(
    rays=256, samples=4, layers=4, width=64, spread=0.01, space_octaves=6, time_octaves=4,
    rate=1e-2, last_rate=1e-3, depth_weight=0.1,
)  # fmt: skip
"""What learns 64x48 pixels in seconds."""
TINY = EndoNerfSettings(rays=16, samples=3, layers=3, width=8, space_octaves=2, time_octaves=2, view_octaves=1)


def small(seen: Seen, seed: int) -> EndoNerf:
    return EndoNerf(seen, seed, SMALL)


def test_its_gradient_is_that_of_finite_differences() -> None:
    seen = Seen.of(small_clip(2), [1], dtype=torch.float64)
    rival = EndoNerf(seen, 3, TINY)
    with torch.no_grad():  # at 0 the network before it has no part in the loss
        rival.field.displacement.weight.normal_(generator=torch.Generator().manual_seed(0)).div_(10)
    check_gradient(rival, rival.parameters())


def test_its_loss_is_the_squared_colour_error_and_the_absolute_depth_error(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = plain()
    rival = EndoNerf(seen, 0, dataclasses.replace(SMALL, depth_weight=0.3))
    true_share = rival._box.share_of(seen.depth_mm.max())

    def shown(origin: Tensor, *_: object) -> tuple[Tensor, Tensor, Tensor]:
        one = torch.ones_like(origin[:, 0])
        return 0.7 * torch.ones_like(origin), (true_share - 0.2) * one, one

    monkeypatch.setattr(rival, "_shown", shown)
    np.testing.assert_allclose(float(rival.loss(1, 0.0).detach()), 0.2**2 + 0.3 * 0.2, rtol=1e-5)


def test_its_network_and_its_rates_are_those_published() -> None:
    rival = EndoNerf(Seen.of(small_clip(2), [1]), 0)
    sizes = [layer.in_features for layer in rival.field.trunk.layers]
    assert sizes == [63, 256, 256, 256, 256, 63 + 256, 256, 256], "the place joins the fifth layer's output again"
    assert [layer.in_features for layer in rival.field.displace.layers][::5] == [63 + 9, 63 + 9 + 256]
    np.testing.assert_allclose([rival.rates(each)[0] for each in (0.0, 0.5, 1.0)], [5e-4, 5e-4 / 10**0.5, 5e-5])


def test_encodings_are_sines_and_cosines_of_octaves() -> None:
    x = 0.3
    found = _encoded(torch.tensor([[x, 0.0]], dtype=torch.float64), 2)[0]
    angles = x * np.array([1.0, 2.0])
    sines, cosines = (np.stack([of(angles), of(0 * angles)], 1).ravel() for of in (np.sin, np.cos))
    np.testing.assert_allclose(found, [x, 0.0, *sines, *cosines], atol=1e-12)


def test_it_overfits_one_frame_above_30_db() -> None:
    check_overfit(small, 400)


def test_it_learns_from_a_camera_that_moves_and_from_depth_with_holes() -> None:
    check_moving_camera(small, 160)


def test_time_matters_held_out_frames_do_not_and_a_seed_gives_the_same_numbers() -> None:
    check_what_counts(small)


def test_it_learns_from_the_start_whatever_the_seed() -> None:
    seen = Seen.of(small_clip(2), [1])
    for seed in range(6):
        rival = EndoNerf(seen, seed, TINY)
        rival.loss(1, 0.0).backward()  # type: ignore[no-untyped-call]
        of_density = [each.grad for each in rival.field.density.parameters()]
        assert all(each is not None and bool((each != 0).any()) for each in of_density)


def test_its_network_displaces_places_by_their_time() -> None:
    rival = fitted(small, small_clip(9), [0, 8], 40)
    assert isinstance(rival, EndoNerf)
    place, view = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    with torch.no_grad():
        early, late = (torch.cat([each.flatten() for each in rival.field(place, t, view)]) for t in (0.3, 0.9))
    assert float((early - late).abs().max()) > 1e-3


def test_rays_are_drawn_more_often_where_instruments_hide_the_tissue_more_often(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clip = small_clip(9)
    seen = Seen.of(clip, range(9))
    rival = small(seen, 0)
    often = (~clip.tissue).sum(0)
    importance = rival._importance.numpy()
    assert importance[often > 0].min() > importance[often == 0].max() == 1
    weight = weights_drawn_by(monkeypatch, endonerf, rival).reshape(48, 64)
    of_frames = [torch.allclose(weight, (rival._importance * tissue).double()) for tissue in seen.tissue]
    assert sum(of_frames) == 1, "those of one frame, where it shows tissue"


def test_depth_that_the_field_contradicts_gives_way_late() -> None:
    clip = small_clip(2)
    rival = small(Seen.of(clip, [1]), 0)
    before = rival._guide_share.clone()
    rival.loss(1, 0.0)
    assert torch.equal(rival._guide_share, before)
    rival.loss(1, 0.5)
    changed = int((rival._guide_share != before).sum())
    assert 0 < changed <= 3, "a hundredth of 256 rays"
    for iteration in range(2, 40):
        rival.loss(iteration, 0.5)
    most = int(0.01 * rival._has_depth.sum())
    assert 0 < most // 2 < int((rival._guide_share != before).sum()) <= most, "and of all pixels"
