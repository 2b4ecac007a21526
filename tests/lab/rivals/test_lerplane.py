"""A radiance field in planes of space and of time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from lab.rivals import lerplane
from lab.rivals.fields import Shown, rays
from lab.rivals.lerplane import LerPlane, LerPlaneSettings, importance
from lab.rivals.planes import Planes, Smoothness
from lab.rivals.proposals import annealed, drawn_edges, interlevel_loss, middles
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

SMALL = LerPlaneSettings(
    rays=256, samples=8, cells=(16, 64), features=8, time_cells=4, proposal_samples=(16, 12), proposal_cells=(32,),
    proposal_features=4, hidden=32, rate=2e-2,
)  # fmt: skip
"""What learns 64x48 pixels in seconds."""
TINY = LerPlaneSettings(
    rays=16, samples=3, cells=(3, 5), features=2, time_cells=2, proposal_samples=(4,), proposal_cells=(3,),
    proposal_features=2, hidden=4, bins=2, proposal_weight=0.0,
)  # fmt: skip
"""Without the proposals' loss: what they learn from is held fixed, so a difference of it is not its gradient."""


def small(seen: Seen, seed: int) -> LerPlane:
    return LerPlane(seen, seed, SMALL)


def test_its_gradient_is_that_of_finite_differences() -> None:
    seen = Seen.of(small_clip(2), [0, 1], dtype=torch.float64)
    rival = LerPlane(seen, 3, TINY)
    with torch.no_grad():
        for each in (*rival.field.planes.time, *rival.proposals[0].planes.time):
            each.add_(0.1)  # away from 1, where the distance from it has a kink
    check_gradient(rival, rival.parameters())


def test_its_loss_is_the_sum_of_its_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = dataclasses.replace(SMALL, depth_weight=0.5, proposal_depth_weight=0.25, proposal_weight=2.0)
    rival = LerPlane(plain(), 0, chosen)  # of which each measured pixel lies at s = 0.5

    def shown(origin: Tensor, *_: object) -> tuple[Shown, list[tuple[Tensor, Tensor]]]:
        edges = torch.tensor([0.0, 0.5, 1.0]).expand(len(origin), 3)
        proposed, weight = (torch.tensor(each).expand(len(origin), 2) for each in ([0.2, 0.8], [0.4, 0.6]))
        one = torch.ones_like(origin[:, 0])
        return (0.7 * torch.ones_like(origin), one, one), [(edges, proposed)] * 2 + [(edges, weight)]

    monkeypatch.setattr(rival, "_shown", shown)
    depth = 2 * 0.25 * (0.65 - 0.5) ** 2 / 2 + 0.5 * (0.55 - 0.5) ** 2 / 2
    exceeding = 2 * 2.0 * ((0.4 - 0.2) ** 2 / 0.4 + 0) / 2
    roughness = rival.field.planes.roughness(chosen.smoothness)
    for proposal in rival.proposals:
        roughness = roughness + proposal.planes.roughness(chosen.proposal_smoothness)
    rough = float(roughness.detach())
    assert rough > 1e-3
    np.testing.assert_allclose(float(rival.loss(1, 0.0).detach()), 0.2**2 + depth + exceeding + rough, rtol=1e-4)


def test_the_proposals_loss_has_the_gradient_of_finite_differences_and_is_zero_where_they_allow_the_weights() -> None:
    random = torch.Generator().manual_seed(0)
    edges = torch.sort(torch.rand(5, 4, generator=random, dtype=torch.float64)).values
    proposed_edges = torch.linspace(0, 1, 7, dtype=torch.float64).expand(5, 7)
    weight, proposed = (torch.rand(5, n, generator=random, dtype=torch.float64) / n for n in (3, 6))
    proposed.requires_grad_()
    assert torch.autograd.gradcheck(lambda each: interlevel_loss(edges, weight, proposed_edges, each), (proposed / 9,))
    assert float(interlevel_loss(edges, weight, proposed_edges, torch.ones_like(proposed))) == 0.0


def test_the_proposals_loss_is_by_how_much_weights_exceed_what_they_allow() -> None:
    edges, weight = torch.tensor([[0.25, 0.5, 1.0]]), torch.tensor([[0.4, 0.6]])
    proposed_edges, proposed = torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[0.2, 0.3]])
    want = ((0.4 - 0.2) ** 2 / 0.4 + (0.6 - 0.3) ** 2 / 0.6) / 2
    np.testing.assert_allclose(float(interlevel_loss(edges, weight, proposed_edges, proposed)), want, rtol=1e-5)


def test_its_rate_rises_then_falls_like_a_cosine() -> None:
    rival = LerPlane(Seen.of(small_clip(2), [0, 1]), 0, dataclasses.replace(SMALL, rate=1e-2))
    rates = [rival.rates(progress)[0] for progress in (0.0, 0.05, 0.525, 1.0)]
    np.testing.assert_allclose(rates, [1e-4, 1e-2, 5e-3, 0.0], atol=1e-12)


def test_its_decoder_is_told_place_and_time_as_blobs_on_their_axes() -> None:
    field = LerPlane(Seen.of(small_clip(2), [0, 1]), 0, SMALL).field
    given: list[torch.Tensor] = []
    field.decode.register_forward_pre_hook(lambda _, args: given.append(args[0]))
    with torch.no_grad():
        field(torch.tensor([[-1.0, 0.0, 1.0]]), torch.tensor([0.25]))
    bins = (np.arange(4) + 0.5) / 4
    want = np.exp(-0.5 * ((np.array([0.0, 0.5, 1.0, 0.25])[:, None] - bins) * 4) ** 2)
    np.testing.assert_allclose(given[0][0, field.planes.size :].reshape(4, 4), want, rtol=1e-5)


def test_how_rough_planes_are_has_the_gradient_of_finite_differences() -> None:
    planes = Planes((3, 5), 4, 2).double()
    with torch.no_grad():
        for each in planes.time:
            each.normal_(1.0, 0.2, generator=torch.Generator().manual_seed(2))

    def roughness(*_: torch.Tensor) -> torch.Tensor:
        return planes.roughness(Smoothness(space=1.0, time=0.7, time_l1=0.3, acceleration=0.5))

    assert torch.autograd.gradcheck(roughness, tuple(planes.parameters()))
    of_acceleration = planes.roughness(Smoothness(space=0.0, time=0.0, time_l1=0.0, acceleration=2.0))
    first, second = (each.diff(dim=2).diff(dim=2).square().mean() for each in planes.time)
    assert torch.isclose(of_acceleration, 2 * (first + second))


def test_samples_gather_where_the_proposals_have_weight() -> None:
    edges, weight = torch.linspace(0, 1, 11).expand(2, 11), torch.zeros(2, 10)
    weight[0, 3], weight[1, 8] = 1.0, 1.0
    found = drawn_edges(edges, weight, 20, None)
    assert bool((found.diff(dim=-1) >= 0).all())
    for row, (low, high) in zip(found, ((0.3, 0.4), (0.8, 0.9)), strict=True):
        there = (row >= low - 1e-6) & (row <= high + 1e-6)
        assert 0.8 < float(there.float().mean()) < 1, "most of them, and some look elsewhere"


def test_the_proposals_learn_where_the_field_has_its_weight() -> None:
    clip, taught_by_the_field_alone = small_clip(2), dataclasses.replace(SMALL, proposal_depth_weight=0.0)
    rival = fitted(lambda seen, seed: LerPlane(seen, seed, taught_by_the_field_alone), clip, [1], 120)
    assert isinstance(rival, LerPlane)
    seen = Seen.of(clip, [1])
    row, column = (each[::7] for each in torch.nonzero(seen.depth_mm[0] > 0, as_tuple=True))
    origin, direction = rays(seen.intrinsics, row, column, seen.world_from_camera[0])
    with torch.no_grad():
        _, rounds = rival._shown(origin, direction, seen.t.expand(len(row)), 1.0, None)
    *proposed, field_share = ((weight * middles(edges)).sum(1) for edges, weight in rounds)
    for each in proposed:
        assert float((each - field_share).abs().median()) < 0.1, "of 1, the length of a ray"
    assert (annealed(0.0), annealed(1.0), annealed(2.0)) == (0.0, 1.0, 1.0)


def test_it_overfits_one_frame_above_30_db() -> None:
    check_overfit(small, 180)


def test_it_learns_from_a_camera_that_moves_and_from_depth_with_holes() -> None:
    check_moving_camera(small, 130)


def test_time_matters_held_out_frames_do_not_and_a_seed_gives_the_same_numbers() -> None:
    check_what_counts(small)


def test_pixels_that_change_and_tissue_that_hides_are_drawn_more_often(monkeypatch: pytest.MonkeyPatch) -> None:
    clip = small_clip(3)
    still = dataclasses.replace(clip, rgb=clip.rgb[[0, 0, 0]].copy(), tissue=np.ones_like(clip.tissue))
    still.rgb[1, 10, 20] ^= 128
    still.tissue[0, 30:, :] = False
    seen = Seen.of(still, range(3))
    weight = importance(seen, 0.01, 0.1)
    assert float(weight[1, 10, 20]) > 5 * float(weight[1, 11, 20])
    assert bool((weight[0, 30:] == 0).all())
    assert float(weight[1, 40, 5]) > float(weight[1, 5, 5])
    of_equal_change = importance(seen, 0.05, 0.05)
    np.testing.assert_allclose(of_equal_change[1, 40, 5] / of_equal_change[1, 5, 5], 3 / 2, rtol=1e-6)
    drawn_by = weights_drawn_by(monkeypatch, lerplane, small(seen, 0)).reshape(weight.shape)
    torch.testing.assert_close(drawn_by, weight.double(), rtol=1e-6, atol=1e-9)
