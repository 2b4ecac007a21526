"""A model whose motion has no kernels: against the fused step where both exist, against plain autograd where not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.helpers import assert_close
from tests.worker.models import (
    HEIGHT,
    NORMALISED,
    PAPER,
    RATES,
    WIDTH,
    endoscope,
    frame_of,
    moving_fdm,
    moving_hexplane,
    moving_shared,
    take_steps,
    training_frames,
    wall,
)
from worker.evaluate.variants.hexplane import HexPlane
from worker.model.deformation import Deformation
from worker.model.gaussians import Gaussians
from worker.model.loss import LossSettings, training_loss
from worker.raster import reference
from worker.raster.cpu.model import CpuModel
from worker.raster.cpu.motion import FdmMotion, LinearMotion, motion_of
from worker.raster.cpu.unfused import AutogradMotion
from worker.raster.step import StepSums, TrainingFrame, camera_vector
from worker.scene.resume_file import begin_resume, load_resume

LOSSES = pytest.mark.parametrize("loss", [PAPER, NORMALISED], ids=["paper", "normalised"])


@LOSSES
@pytest.mark.parametrize("moving", [moving_shared, moving_fdm])
def test_it_takes_the_steps_of_the_fused_model(moving: Callable[[Gaussians], Deformation], loss: LossSettings) -> None:
    gaussians = wall(sh_degree=1)
    models = [
        CpuModel(gaussians, moving(gaussians), WIDTH, HEIGHT, make_motion=each) for each in (motion_of, AutogradMotion)
    ]
    fused_sums, sums = (take_steps(model, training_frames(), loss=loss, sh_degree=1) for model in models)
    for name in ("colour_l1", "depth_l1", "squared_error", "holes"):
        assert_close([getattr(each, name) for each in sums], [getattr(each, name) for each in fused_sums], name=name)
    (fused, fused_motion), (unfused, motion) = (model.export() for model in models)
    for name, each in (unfused.tensors() | motion.parameters()).items():
        wanted = (fused.tensors() | fused_motion.parameters())[name]
        start = (gaussians.tensors() | moving(gaussians).parameters())[name]
        assert name == "gloss" or not torch.equal(wanted, start), f"{name} was not trained"
        # Adam's first steps are of one size whatever the gradient's: only where it is all rounding may the sign differ.
        assert float(((each - wanted).abs() > 1e-5 + 1e-4 * wanted.abs()).float().mean()) < 2e-3, name


@LOSSES
def test_the_first_moments_of_hexplane_are_the_gradients_of_the_loss(loss: LossSettings) -> None:
    gaussians = wall()
    field = moving_hexplane(gaussians)
    frame, camera = training_frames(1)[0], endoscope()
    leaves = {name: each.double().requires_grad_() for name, each in gaussians.tensors().items()}
    parameters = {name: each.double().requires_grad_() for name, each in field.parameters().items()}
    exact = HexPlane.from_tensors(parameters | {"bounds": field.bounds.double()})
    moved = exact.deform(Gaussians(**leaves), frame.t)
    colour = moved.colour(camera.centre(moved.mean))
    rendered = reference.rasterize(moved.mean, moved.quaternion, moved.scale, moved.opacity, colour, camera)
    total = training_loss(
        rendered.rgb,
        rendered.depth,
        rendered.alpha,
        torch.from_numpy(frame.rgb).double() / 255,
        torch.from_numpy(frame.depth).double(),
        torch.from_numpy(frame.tissue),
        loss,
    ).total
    names = [*leaves, *parameters]
    wanted = dict(zip(names, torch.autograd.grad(total, [*leaves.values(), *parameters.values()]), strict=True))

    model = CpuModel(gaussians, field, WIDTH, HEIGHT)
    take_steps(model, [frame], loss=loss)
    count, arrays = model.count, model.arrays()
    canonical = 10 * arrays["moments.canonical"][0, :, :count].T
    # float32 decides some pixels' alpha cuts and L1 signs the other way: a part in a thousand of the largest.
    assert_close(canonical[:, 0:3], wanted["mean"], relative=2e-3, name="mean")
    assert_close(canonical[:, 3:7], wanted["quaternion"], relative=2e-3, name="quaternion")
    assert_close(canonical[:, 7:10], wanted["log_scale"], relative=2e-3, name="log_scale")
    assert_close(canonical[:, 10:13], wanted["sh"][:, 0], relative=2e-3, name="sh")
    for name in parameters:
        assert_close(10 * arrays[f"motion.moments.{name}"][0], wanted[name], relative=2e-3, name=name)


@pytest.mark.parametrize("moving", [moving_shared, moving_fdm, moving_hexplane])
def test_a_step_on_several_frames_has_the_gradients_of_all_added(moving: Callable[[Gaussians], Deformation]) -> None:
    gaussians, camera = wall(stride=6, sh_degree=1), camera_vector(endoscope())
    frames = [each.seen_from(camera) for each in training_frames(2)]

    def after(seen: list[TrainingFrame]) -> tuple[CpuModel, StepSums]:
        model = CpuModel(gaussians, moving(gaussians), WIDTH, HEIGHT)
        return model, model.step(seen, PAPER, RATES, 1, 1)

    def gradients(model: CpuModel) -> dict[str, Tensor]:
        """Adam's first moments after one step: a tenth of them."""
        arrays = model.arrays()
        found = {name: each[0] for name, each in arrays.items() if "moments." in name}
        return found | {name: each for name, each in arrays.items() if name == "motion.first"}

    (one, one_sums), (other, other_sums), (both, both_sums) = after(frames[:1]), after(frames[1:]), after(frames)
    for name, each in gradients(both).items():
        assert float(each.abs().max()) > 0
        assert_close(each, gradients(one)[name] + gradients(other)[name], relative=1e-5, name=name)
    assert bool((both.gradient_norm == torch.maximum(one.gradient_norm, other.gradient_norm)).all())
    assert bool((both.visible == one.visible | other.visible).all())
    assert both_sums.squared_error == pytest.approx(one_sums.squared_error + other_sums.squared_error)
    assert both_sums.visible == int(both.visible.sum())


def test_a_render_is_the_fused_models_of_the_moved_gaussians() -> None:
    gaussians = wall()
    field = moving_hexplane(gaussians)
    camera = camera_vector(endoscope())
    moved = field.deform(gaussians, 0.6)
    still = dataclasses.replace(moving_shared(gaussians), weight=torch.zeros(len(gaussians), 10, 3))
    wanted = CpuModel(moved, still, WIDTH, HEIGHT).render(camera, 0.6)
    assert_close(CpuModel(gaussians, field, WIDTH, HEIGHT).render(camera, 0.6), wanted)
    assert float((moved.mean - gaussians.mean).abs().max()) > 0.05  # the field does move them


def test_hexplane_learns_a_motion_from_images_alone() -> None:
    gaussians = wall(opacity=0.9)
    pushed = [
        dataclasses.replace(gaussians, mean=gaussians.mean + 2 * k * torch.tensor([1.0, 0.5, -1.0])) for k in (0, 1)
    ]
    frames = [frame_of(each, t) for each, t in zip(pushed, (0.2, 0.7), strict=True)]
    field = HexPlane.initial(torch.stack([gaussians.mean.amin(0), gaussians.mean.amax(0)]), space_cells=(8,))
    model = CpuModel(gaussians, field, WIDTH, HEIGHT)
    only_motion = dataclasses.replace(RATES, mean=0.0, quaternion=0.0, log_scale=0.0, opacity=0.0, colour=0.0)
    depths = dataclasses.replace(PAPER, depth_weight=100.0)
    errors = []
    for epoch in range(40):
        sums = take_steps(model, frames, loss=depths, rates=only_motion, first=1 + 2 * epoch)
        errors.append(sums[1].squared_error)
    assert errors[-1] < 0.2 * errors[0]
    assert bool((model.export()[0].mean == gaussians.mean).all())


def test_it_leaves_the_deformation_it_was_given_alone_and_exports_copies() -> None:
    gaussians = wall()
    field = moving_hexplane(gaussians)
    before = {name: each.clone() for name, each in field.parameters().items()}
    model = CpuModel(gaussians, field, WIDTH, HEIGHT)
    _, exported = model.export()
    take_steps(model, training_frames(1))
    for each in (field, exported):
        assert all(torch.equal(before[name], tensor) for name, tensor in each.parameters().items())
        assert not any(tensor.requires_grad for tensor in each.parameters().values())
    assert not torch.equal(model.export()[1].parameters()["layer.2.weight"], before["layer.2.weight"])


@pytest.mark.parametrize("moving", [moving_hexplane, moving_fdm])
def test_taking_rows_keeps_their_motion_and_moments(moving: Callable[[Gaussians], Deformation]) -> None:
    gaussians = wall()
    model = CpuModel(gaussians, moving(gaussians), WIDTH, HEIGHT)
    take_steps(model, training_frames(2))
    columns = np.array([7, 3, 3, 11, 200])
    fresh = np.array([False, False, True, False, False])
    before = {name: each.numpy().copy() for name, each in model.arrays().items()}
    mean = model.deformed_mean(0.4)
    model.take(columns, fresh)
    assert model.count == 5
    assert_close(model.deformed_mean(0.4), mean[:, columns])
    after = {name: each.numpy() for name, each in model.arrays().items()}
    kept = before["moments.canonical"][:, :, columns] * ~fresh
    assert bool((after["moments.canonical"][:, :, :5] == kept).all())
    for name in (each for each in after if each.startswith("motion.moments.")):
        if moving is moving_hexplane:  # belongs to no Gaussian
            assert bool((after[name] == before[name]).all()), name
        else:
            wanted = before[name][:, columns] * ~fresh[:, None, None]
            assert bool((after[name][:, :5] == wanted).all()), name


def test_a_resumed_model_takes_the_steps_of_an_uninterrupted_one(tmp_path: Path) -> None:
    gaussians = wall()
    frames = training_frames(4)
    whole = CpuModel(gaussians, moving_hexplane(gaussians), WIDTH, HEIGHT)
    take_steps(whole, frames[:2])
    begin_resume(tmp_path, {name: each.contiguous() for name, each in whole.arrays().items()}, {})()
    take_steps(whole, frames[2:], first=3)

    tensors, _ = load_resume(tmp_path)
    resumed = CpuModel(gaussians, moving_hexplane(gaussians), WIDTH, HEIGHT)
    resumed.load_arrays(tensors)
    take_steps(resumed, frames[2:], first=3)
    for name, each in resumed.arrays().items():
        assert bool((each == whole.arrays()[name]).all()), name


def test_a_rate_of_zero_leaves_motion_as_it_is() -> None:
    gaussians = wall()
    model = CpuModel(gaussians, moving_hexplane(gaussians), WIDTH, HEIGHT)
    take_steps(model, training_frames(1), rates=dataclasses.replace(RATES, motion_mean=0.0))
    wanted = moving_hexplane(gaussians).parameters()
    assert all(torch.equal(each, wanted[name]) for name, each in model.export()[1].parameters().items())


@pytest.mark.parametrize(
    ("moving", "trained_by"),
    [(moving_shared, LinearMotion), (moving_fdm, FdmMotion), (moving_hexplane, AutogradMotion)],
)
def test_only_a_motion_without_kernels_is_left_to_torch(
    moving: Callable[[Gaussians], Deformation], trained_by: type
) -> None:
    gaussians = wall()
    deformation = moving(gaussians)
    assert deformation.has_kernels is (trained_by is not AutogradMotion)
    assert type(CpuModel(gaussians, deformation, WIDTH, HEIGHT).motion) is trained_by
