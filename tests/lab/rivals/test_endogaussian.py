"""Gaussians from the depth of all frames, moved by factor planes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from intrasplat.methods.method import DensifySettings
from intrasplat.splat.camera import Rendered
from lab.rivals.endogaussian import EndoGaussian, EndoGaussianSettings
from lab.rivals.planes import Smoothness
from lab.rivals.rival import Seen
from tests.lab.rivals.cases import (
    check_gradient,
    check_moving_camera,
    check_overfit,
    check_step,
    check_what_counts,
    plain,
    small_clip,
)

SMALL = EndoGaussianSettings(
    start_share=0.4, cells=(16,), features=4, time_cells=4, mean_rate=(1e-2, 1e-3),
    decoder_rate=(5e-2, 5e-3), plane_rate=(5e-2, 5e-3), log_scale_rate=1e-2, static_share=0.25,
)  # fmt: skip
"""What learns 64x48 pixels in seconds."""
TINY = EndoGaussianSettings(start_share=0.01, opacity=0.5, cells=(3, 5), features=2, time_cells=3, hidden=8)


def small(seen: Seen, seed: int) -> EndoGaussian:
    return EndoGaussian(seen, seed, SMALL)


def test_its_gradient_is_that_of_finite_differences() -> None:
    seen = Seen.of(small_clip(2), [0, 1], dtype=torch.float64)
    rival = EndoGaussian(seen, 3, TINY)
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():  # at 0 the planes have no part in the loss
        for decode in rival.field.decode:
            decode[-1].weight.copy_(torch.randn(decode[-1].weight.shape, generator=random) / 10)
        rival.field.low.sub_(1)  # no Gaussian on the planes' edge, where the looked-up value has a kink
        rival.field.high.add_(1)
    # a step so small that no Gaussian reaches another pixel, where the rasteriser cuts it off
    check_gradient(rival, rival.parameters(), step=1e-7, progress=0.9)


def test_its_loss_is_the_sum_of_its_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = plain()
    smoothness = Smoothness(space=1.0, time=0.0, time_l1=0.0, acceleration=0.0)
    rival = EndoGaussian(seen, 0, dataclasses.replace(SMALL, tv_weight=1e4, smoothness=smoothness))
    columns, rows = torch.linspace(0.5, 0.8, 64), torch.linspace(30, 31, 48)
    rgb, depth = columns[None, :, None].expand(48, 64, 3), rows[:, None].expand(48, 64)
    monkeypatch.setattr(rival, "_shown", lambda *_: Rendered(rgb, depth, torch.full((48, 64), 0.9)))
    colour, inverse_depth = 0.15, float((1 / rows - 1 / 60).mean())  # the median depth is 60 units
    variation = 1e4 * (64 / 640) ** 2 * ((0.3 / 63) ** 2 + (1 / 47) ** 2)
    rough = float(rival.field.planes.roughness(smoothness).detach())
    assert rough > 0.01
    still, moving = (float(rival.loss(1, progress).detach()) for progress in (0.1, 0.9))
    np.testing.assert_allclose(still, colour + inverse_depth + variation, rtol=1e-5)
    np.testing.assert_allclose(moving, colour + inverse_depth + variation + rough, rtol=1e-5)


def test_it_overfits_one_frame_above_30_db() -> None:
    check_overfit(small, 220)


def test_it_learns_from_a_camera_that_moves_and_from_depth_with_holes() -> None:
    check_moving_camera(small, 60)


def test_time_matters_held_out_frames_do_not_and_a_seed_gives_the_same_numbers() -> None:
    check_what_counts(small)


def test_gaussians_start_at_the_measured_tissue_of_all_frames_up_to_a_limit() -> None:
    clip = small_clip(9)
    seen = Seen.of(clip, range(9))
    measured = (seen.depth_mm > 0).sum((1, 2)).tolist()
    assert EndoGaussian(seen, 0, TINY).gaussians == sum(round(0.01 * each) for each in measured)
    few = EndoGaussianSettings(start_share=0.5, start_most=200, cells=(3,), features=2)
    mean = EndoGaussian(seen, 0, few)._deformable[0]
    assert len(mean) == 200
    camera, median_mm = clip.intrinsics, float(np.median(seen.depth_mm[seen.depth_mm > 0]))
    x, y, z_mm = (mean.detach() * median_mm / 60).numpy().T
    column, row = (camera.fx * x / z_mm + camera.cx - 0.5, camera.fy * y / z_mm + camera.cy - 0.5)
    for each in (column, row):
        np.testing.assert_allclose(each, each.round(), atol=1e-3)
    found_mm = seen.depth_mm[:, row.round().astype(int), column.round().astype(int)].numpy()
    nearest = np.abs(found_mm - z_mm).argmin(0)
    np.testing.assert_allclose(found_mm[nearest, np.arange(200)], z_mm, rtol=1e-5)
    assert len(set(nearest.tolist())) > 3, "more than one frame gives Gaussians"


def test_nothing_moves_in_the_first_quarter_which_sees_the_first_frame_alone() -> None:
    rival = small(Seen.of(small_clip(3), range(3)), 0)

    def losses(progress: float) -> set[float]:
        return {float(rival.loss(iteration, progress).detach()) for iteration in range(1, 10)}

    assert len(losses(0.2)) == 1
    rival.loss(1, 0.2).backward()
    assert all(each.grad is None for each in rival.field.parameters())
    assert len(losses(0.3)) == 3
    rival.loss(1, 0.3).backward()
    assert all(float(decode[-1].weight.grad.abs().max()) > 0 for decode in rival.field.decode)


def test_nothing_moves_for_the_published_steps_where_steps_end_the_training_and_rates_fall_afterwards() -> None:
    rival = small(Seen.of(small_clip(3), range(3)), 0)

    def moves(iteration: int, progress: float) -> bool:
        rival.step(iteration, progress)
        return all(each.grad is not None for each in rival.field.parameters())

    assert not moves(1000, 999 / 4000)
    static_rates = rival.rates(999 / 4000)
    assert static_rates == [group["lr"] for group in rival.optimizer.param_groups]
    assert static_rates[0] == SMALL.mean_rate[0]
    assert moves(1001, 1000 / 4000)
    np.testing.assert_allclose(rival.rates(1.0)[0], SMALL.mean_rate[1])
    assert moves(1000, 0.26), "of fewer steps the share"
    rival.settings = dataclasses.replace(SMALL, static_share=0.06)
    assert not moves(300, 299 / 4000)
    assert moves(300, 299 / 3999), "even of one fewer"
    rival.settings = SMALL
    rival.time_share = 0.24
    assert not moves(300, 0.24)
    rival.time_share = 0.25
    assert moves(300, 0.25), "of less time the share, however many steps it holds"


def test_a_degree_of_harmonics_is_learnt_every_quarter() -> None:
    rival = EndoGaussian(Seen.of(small_clip(2), [1]), 0, TINY)
    for progress, degree in ((0.2, 0), (0.3, 1), (0.6, 2), (0.8, 3)):
        learnt = torch.autograd.grad(rival.loss(1, progress), rival._harmonics)[0].abs().amax((0, 2)) > 0
        assert int(learnt.sum()) == len(learnt[: (degree + 1) ** 2 - 1]) == int(learnt[: (degree + 1) ** 2 - 1].sum())


def test_gaussians_are_split_when_that_is_due_until_late_in_the_training() -> None:
    often = DensifySettings(from_iteration=4, every=2, gradient_threshold=1e-7)
    rival = EndoGaussian(Seen.of(small_clip(3), range(3)), 0, dataclasses.replace(TINY, densify=often))
    counts = []
    for iteration, progress in enumerate((0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.89, 0.9), 1):
        assert np.isfinite(rival.step(iteration, progress))
        counts.append(rival.gaussians)
    assert counts[0] == counts[2] < counts[3] == counts[4] < counts[5] == counts[7]
    check_step(rival)


def test_its_motion_is_the_displacement_of_the_gaussians_that_a_pixel_shows() -> None:
    clip = small_clip(2)
    rival = small(Seen.of(clip, [0, 1]), 0)
    with torch.no_grad():
        for space in rival.field.planes.space:
            space.fill_(1.0)
        for time in rival.field.planes.time:  # the product of the three is t^3
            time.copy_(torch.linspace(0, 1, time.shape[2])[:, None].expand(time.shape))
        of_place = rival.field.decode[0]
        of_place[0].weight.fill_(1.0 / rival.field.planes.size)
        of_place[0].bias.zero_()
        of_place[-1].weight[0] = 2.0 / len(of_place[0].bias)
        rival._deformable[3].fill_(5.0)  # nearly opaque
    pose, camera = clip.world_from_camera[0], clip.intrinsics
    moved_mm = rival.motion_mm(0.5, pose, camera)
    covered = np.isfinite(moved_mm[..., 0])
    np.testing.assert_array_equal(covered, rival.render(0.0, pose, camera).alpha >= 0.5)
    assert covered.mean() > 0.9
    want_mm = np.array([2.0 * 0.5**3 / rival._scale, 0, 0])
    np.testing.assert_allclose(moved_mm[covered], np.broadcast_to(want_mm, moved_mm[covered].shape), rtol=1e-4)
    assert float(np.abs(rival.motion_mm(0.0, pose, camera)[covered]).max()) == 0.0
