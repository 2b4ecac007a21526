"""Splitting and pruning: what they keep, what they change, and on what evidence."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from contract.wire.errors import TrainingDiverged
from tests.worker.models import (
    HEIGHT,
    RATES,
    WIDTH,
    endoscope,
    moving_fdm,
    moving_hexplane,
    moving_shared,
    take_steps,
    training_frames,
    wall,
)
from worker.methods.method import DensifySettings
from worker.model.deformation import FlexibleDeformation, SharedBasis
from worker.model.gaussians import Gaussians
from worker.model.layout import LOG_SCALE, MEAN
from worker.model.loss import LossSettings
from worker.raster.cpu.model import CpuModel
from worker.raster.cpu.unfused import AutogradMotion
from worker.raster.model import Model
from worker.raster.step import camera_vector
from worker.scene.resume_file import begin_resume, load_resume
from worker.train.densify import Densifier

NOTHING = DensifySettings(gradient_threshold=1e9)
EVERYTHING = DensifySettings(gradient_threshold=1e-30)


def fused(gaussians: Gaussians) -> CpuModel:
    return CpuModel(gaussians, moving_shared(gaussians), WIDTH, HEIGHT)


def trained(gaussians: Gaussians, settings: DensifySettings, frames: int = 3) -> tuple[CpuModel, Densifier]:
    """A model after a few observed steps."""
    model = fused(gaussians)
    densifier = Densifier(settings, model.count)
    for iteration, frame in enumerate(training_frames(frames), start=1):
        take_steps(model, [frame], first=iteration)
        densifier.observe(model)
    return model, densifier


def densify(model: Model, densifier: Densifier, *, seed: int = 0) -> None:
    densifier.apply(model, 600, np.random.default_rng(seed))


def copies(model: Model) -> dict[str, NDArray[np.float32]]:
    return {name: values.numpy().copy() for name, values in model.arrays().items()}


def with_opacity(gaussians: Gaussians, rows: list[int], opacity: float) -> Gaussians:
    logit = gaussians.opacity_logit.clone()
    logit[rows] = math.log(opacity / (1 - opacity))
    return dataclasses.replace(gaussians, opacity_logit=logit)


def test_it_happens_from_iteration_600_every_100_as_published() -> None:
    due = [iteration for iteration in range(1, 1001) if DensifySettings().due(iteration)]
    assert due == [600, 700, 800, 900, 1000]


def test_before_its_time_nothing_changes_and_statistics_go_on() -> None:
    model, densifier = trained(wall(), EVERYTHING)
    count, mean = model.count, densifier.mean_gradient
    densifier.apply(model, 599, np.random.default_rng(0))
    assert model.count == count
    assert bool((densifier.mean_gradient == mean).all())
    assert float(mean.max()) > 0


def test_the_mean_gradient_is_over_the_steps_that_saw_a_gaussian() -> None:
    model = fused(wall())
    densifier = Densifier(NOTHING, model.count)
    norms, seen = [], []
    for iteration, (frame, sideways) in enumerate(zip(training_frames(3), (0.0, 30.0, -45.0), strict=True), start=1):
        take_steps(model, [frame], first=iteration, camera=endoscope(sideways))
        densifier.observe(model)
        norms.append(model.gradient_norm.double().numpy())
        seen.append(model.visible.numpy())
    sometimes = np.any(seen, 0) & ~np.all(seen, 0)
    assert sometimes.sum() > 50
    for g in range(model.count):
        of_g = [float(norm[g]) for norm, visible in zip(norms, seen, strict=True) if visible[g]]
        assert densifier.mean_gradient[g] == pytest.approx(np.mean(of_g) if of_g else 0.0)


def test_gradients_are_in_device_coordinates() -> None:
    """One Gaussian, whose projection follows the principal point: d/dx_ndc = W / 2 d/dx_pixel, likewise for y."""
    gaussian = Gaussians(**{name: each[:1] for name, each in wall().tensors().items()})
    gaussian = dataclasses.replace(gaussian, mean=torch.tensor([[1.0, 2.0, 60.0]]), log_scale=torch.ones(1, 3))
    still = dataclasses.replace(moving_shared(gaussian), weight=torch.zeros(1, 10, 3))
    frame = training_frames(1)[0]

    def colour_l1(shift: tuple[float, float]) -> tuple[float, float]:
        model = CpuModel(gaussian, still, WIDTH, HEIGHT)
        camera = camera_vector(endoscope())
        camera[2:4] += shift
        seen, colours = frame.seen_from(camera), LossSettings(depth_weight=0.0)
        sums = model.step([seen], colours, RATES, 1)
        return sums.colour_l1 * float(seen.loss_settings(colours)[0]), float(model.gradient_norm[0])

    nudge = 0.1  # pixels
    by_x, by_y = (
        (colour_l1((dx, dy))[0] - colour_l1((-dx, -dy))[0]) / (2 * nudge) for dx, dy in ((nudge, 0.0), (0.0, nudge))
    )
    assert colour_l1((0.0, 0.0))[1] == pytest.approx(math.hypot(by_x * WIDTH / 2, by_y * HEIGHT / 2), rel=0.02)


def test_every_split_gaussian_becomes_two_smaller_ones_that_share_the_rest() -> None:
    model, densifier = trained(wall(sh_degree=1), EVERYTHING)
    seen = densifier.mean_gradient > 0
    before = copies(model)
    count = model.count
    densify(model, densifier)
    split, kept = np.flatnonzero(seen), np.flatnonzero(~seen)
    assert model.count == count + len(split)
    parents = np.concatenate([kept, split, split])
    born = slice(len(kept), model.count)
    after = copies(model)
    for name in ("opacity_logit", "sh_rest", "motion.weight"):
        assert bool((after[name][..., : model.count] == before[name][..., parents]).all()), name
    rest = np.r_[3:7, 10:13]
    assert bool((model.canonical[rest, : model.count] == before["canonical"][rest][:, parents]).all())
    shrunk = before["canonical"][LOG_SCALE, parents[born]] - math.log(1.6)
    np.testing.assert_allclose(model.canonical[LOG_SCALE, born], shrunk, rtol=1e-6, atol=1e-6)


def test_children_lie_where_their_parent_was_dense() -> None:
    gaussians = wall()
    model, densifier = trained(gaussians, EVERYTHING, frames=1)
    before, _ = model.export()
    parents = np.flatnonzero(densifier.mean_gradient > 0)
    survivors = model.count - len(parents)
    densify(model, densifier)
    children = model.canonical[MEAN, survivors : model.count].T.reshape(2, len(parents), 3)
    w, x, y, z = torch.nn.functional.normalize(before.quaternion[parents], dim=1).double().numpy().T
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    offset = children - before.mean[parents].numpy()
    along_axes = np.einsum("ijn,cni->cnj", rotation, offset) / before.scale[parents].numpy()
    samples = along_axes.reshape(-1, 3)  # standard normal if drawn from the parent, turned and scaled as it is
    assert len(samples) > 500
    np.testing.assert_allclose(samples.mean(0), 0, atol=0.15)
    np.testing.assert_allclose(np.cov(samples.T), np.eye(3), atol=0.15)
    assert float(np.abs(along_axes[0] - along_axes[1]).min()) > 0  # two draws, not one


def test_splitting_everything_changes_the_image_little() -> None:
    model = fused(wall(stride=2, opacity=0.9))
    densifier = Densifier(EVERYTHING, model.count)
    frame = training_frames(1)[0]
    take_steps(model, [frame])
    densifier.observe(model)
    camera = camera_vector(endoscope())
    before = model.render(camera, frame.t).copy()
    count = model.count
    densify(model, densifier)
    assert model.count - count > 500
    after = model.render(camera, frame.t)
    psnr = -10 * math.log10(float(np.mean((after[:3] - before[:3]) ** 2)))
    assert psnr > 25  # children land at random within their parent: texture moves by about its width
    assert abs(float(after[4].mean() - before[4].mean())) < 0.01


def test_transparent_gaussians_are_dropped_and_the_others_keep_their_numbers() -> None:
    rows = [0, 5, 77, 200]
    model, densifier = trained(with_opacity(wall(), rows, 0.001), NOTHING)
    before = copies(model)
    kept = np.setdiff1d(np.arange(model.count), rows)
    densify(model, densifier)
    assert model.count == len(kept)
    for name, values in copies(model).items():
        if name != "motion.steps":
            assert bool((values[..., : model.count] == before[name][..., kept]).all()), name


def test_what_is_transparent_is_not_split() -> None:
    model, densifier = trained(with_opacity(wall(), [210], 0.0045), EVERYTHING)  # above 1 / 255: it draws and is pulled
    assert densifier.mean_gradient[210] > 0
    count, pulled = model.count, int((densifier.mean_gradient > 0).sum())
    densify(model, densifier)
    assert model.count == count - 1 + pulled - 1


def test_moments_of_survivors_stay_and_those_of_children_start_at_zero() -> None:
    model, densifier = trained(wall(), dataclasses.replace(EVERYTHING, max_count=len(wall()) + 20))
    mean_gradient, before = densifier.mean_gradient, copies(model)
    split = np.sort(np.argsort(-mean_gradient)[:20])
    survivors = np.setdiff1d(np.arange(model.count), split)
    densify(model, densifier)
    moments = ("moments.canonical", "moments.opacity_logit", "motion.first", "motion.second")
    for name in moments:
        values = copies(model)[name]
        assert bool((values[..., : len(survivors)] == before[name][..., survivors]).all()), name
        assert not values[..., len(survivors) :].any(), name
        assert before[name].any(), name


def test_beyond_the_greatest_count_only_the_hardest_pulled_are_split() -> None:
    gaussians = wall()
    model, densifier = trained(gaussians, dataclasses.replace(EVERYTHING, max_count=len(gaussians) + 7))
    hardest = np.sort(np.argsort(-densifier.mean_gradient)[:7])
    asked = int((densifier.mean_gradient > 0).sum())
    logits = model.opacity_logit[hardest].copy()
    densify(model, densifier)
    assert asked > 7
    assert model.count == len(gaussians) + 7
    assert bool((model.opacity_logit[model.count - 14 : model.count] == np.tile(logits, 2)).all())


def test_a_seed_decides_where_children_lie() -> None:
    means = []
    for seed in (3, 3, 4):
        model, densifier = trained(wall(), EVERYTHING)
        densify(model, densifier, seed=seed)
        means.append(model.canonical[MEAN].copy())
    assert bool((means[0] == means[1]).all())
    assert not bool((means[0] == means[2]).all())


def test_statistics_start_anew_afterwards() -> None:
    model, densifier = trained(wall(), EVERYTHING)
    densify(model, densifier)
    assert densifier.mean_gradient.shape == (model.count,)
    assert not densifier.mean_gradient.any()
    take_steps(model, training_frames(1), first=601)
    densifier.observe(model)
    expected = torch.where(model.visible, model.gradient_norm, 0).numpy()
    assert bool((densifier.mean_gradient == expected).all())


def test_a_model_whose_motion_has_no_kernels_is_densified_likewise() -> None:
    gaussians = with_opacity(wall(), [3], 0.001)
    counts = []
    for model in (
        CpuModel(gaussians, moving_hexplane(gaussians), WIDTH, HEIGHT),
        CpuModel(gaussians, moving_fdm(gaussians), WIDTH, HEIGHT, make_motion=AutogradMotion),
        CpuModel(gaussians, moving_fdm(gaussians), WIDTH, HEIGHT),
    ):
        densifier = Densifier(EVERYTHING, model.count)
        take_steps(model, training_frames(1))
        densifier.observe(model)
        split = int((densifier.mean_gradient > 0).sum())  # the transparent Gaussian is not drawn, so it has none
        densify(model, densifier)
        count = model.count
        assert count == len(gaussians) - 1 + split
        take_steps(model, training_frames(1), first=601)
        assert len(model.export()[0]) == count
        counts.append(count)
    assert counts[1] == counts[2]


@pytest.mark.parametrize("moving", [moving_shared, moving_fdm])
def test_training_goes_on_as_in_a_model_made_of_the_edited_gaussians(
    moving: Callable[[Gaussians], SharedBasis | FlexibleDeformation],
) -> None:
    gaussians = wall(sh_degree=1)
    model = CpuModel(gaussians, moving(gaussians), WIDTH, HEIGHT)
    densifier = Densifier(EVERYTHING, model.count)
    frames = training_frames(2)
    take_steps(model, frames[:1], sh_degree=1)
    densifier.observe(model)
    densify(model, densifier)
    made = CpuModel(*model.export(), WIDTH, HEIGHT)
    made.load_arrays(model.arrays())
    for each in (model, made):
        take_steps(each, frames[1:], first=601, sh_degree=1)
    for name, values in made.arrays().items():
        assert bool((values == model.arrays()[name]).all()), name


def test_a_run_resumed_after_densification_takes_the_same_steps(tmp_path: Path) -> None:
    settings = DensifySettings(from_iteration=2, every=2, gradient_threshold=5e-4)
    frames = training_frames(6)

    def go_on(model: CpuModel, densifier: Densifier, first: int, last: int) -> None:
        for iteration in range(first, last + 1):
            take_steps(model, [frames[iteration - 1]], first=iteration)
            densifier.observe(model)
            densifier.apply(model, iteration, np.random.default_rng([0, iteration]))

    whole = fused(wall())
    statistics = Densifier(settings, whole.count)
    go_on(whole, statistics, 1, 3)
    stored = {name: values.contiguous() for name, values in (whole.arrays() | statistics.arrays()).items()}
    begin_resume(tmp_path, stored, {"count": whole.count})()
    go_on(whole, statistics, 4, 6)

    arrays, state = load_resume(tmp_path)
    resumed = fused(wall())
    assert state["count"] > resumed.count
    resumed_statistics = Densifier(settings, resumed.count)
    resumed.take(np.zeros(state["count"], np.int64), np.ones(state["count"], np.bool_))
    resumed.load_arrays(arrays)
    resumed_statistics.load_arrays(arrays)
    go_on(resumed, resumed_statistics, 4, 6)
    assert resumed.count == whole.count > state["count"]
    for name, values in resumed.arrays().items():
        assert bool((values == whole.arrays()[name]).all()), name


def test_losing_every_gaussian_is_an_error_that_says_so() -> None:
    gaussians = wall()
    model, densifier = trained(with_opacity(gaussians, list(range(len(gaussians))), 0.001), NOTHING)
    with pytest.raises(TrainingDiverged, match=f"All {len(gaussians)} Gaussians have become transparent"):
        densify(model, densifier)


def test_gradients_that_are_not_numbers_are_an_error() -> None:
    model, densifier = trained(wall(), NOTHING)
    stored = densifier.arrays()
    stored["densify.gradient_sum"][:2] = math.nan
    densifier.load_arrays(stored)
    with pytest.raises(TrainingDiverged, match="2 Gaussians"):
        densify(model, densifier)


def test_statistics_of_another_model_are_refused() -> None:
    model = fused(wall())
    with pytest.raises(ValueError, match="statistics are of 3"):
        Densifier(NOTHING, 3).observe(model)
    with pytest.raises(ValueError, match="same"):
        Densifier(NOTHING, 3).load_arrays(
            {"densify.gradient_sum": torch.zeros(3), "densify.steps_seen": torch.zeros(4)}
        )


@pytest.mark.parametrize(
    "wrong", [{"every": 0}, {"split_into": 1}, {"max_count": 0}, {"min_opacity": 0.0}, {"gradient_threshold": 0.0}]
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        dataclasses.replace(DensifySettings(), **wrong)  # type: ignore[arg-type]
