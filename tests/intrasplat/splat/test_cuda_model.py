"""The training step of the CUDA backend: it trains as the CPU's does, whatever room it has, and what it trains is kept.

N Gaussians, H W pixels. Scenes are tiny: without a GPU every kernel runs in Triton's interpreter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")

from intrasplat.methods.method import MAX_FRAMES_A_STEP
from intrasplat.splat.cpu import padded
from intrasplat.splat.cpu.model import CpuModel
from intrasplat.splat.cuda.bins import MAX_FRAMES
from intrasplat.splat.cuda.model import CHECK_EVERY, CudaModel
from intrasplat.splat.deformation import FlexibleDeformation, GaussianFdm, SharedBasis
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import POSE, SIDE
from intrasplat.splat.layout import WIDTH as WIDTH_PLACE
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.step import Target, TrainingFrame, camera_vector
from lab.evaluate.variants.polynomial import PolynomialFourier
from lab.evaluate.variants.quartic import QuarticFdm
from tests.helpers import assert_close
from tests.intrasplat import models
from tests.intrasplat.splat import replays
from tests.intrasplat.splat.scenes import random_scene

WIDTH, HEIGHT, COUNT = 20, 16, 32
Fused = SharedBasis | PolynomialFourier | FlexibleDeformation
LOSS = LossSettings(depth_weight=20.0, colour_huber_delta=0.05, depth_huber_delta=1e-3)
RATES = dataclasses.replace(models.RATES, eps=1e-6)
"""eps is far above rounding, so that gradients that are nothing but rounding do not become whole steps."""
SCENE = random_scene(COUNT, width=WIDTH, height=HEIGHT, seed=50, pixels=2.5)
CAMERA = camera_vector(SCENE.camera)


def gaussians(sh_degree: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(5)
    sh = 0.1 * torch.randn(COUNT, (sh_degree + 1) ** 2, 3, generator=random)
    sh[:, 0] += 0.8
    return Gaussians(
        mean=SCENE.mean.float(),
        quaternion=SCENE.quaternion.float(),
        log_scale=SCENE.scale.log().float(),
        opacity_logit=torch.logit(SCENE.opacity).float(),
        sh=sh,
        gloss=0.2 * torch.randn(COUNT, generator=random),
    )


def deformation(kind: str) -> Fused:
    random = torch.Generator().manual_seed(6)

    def stirred(tensor: Tensor) -> Tensor:
        return tensor + 0.05 * torch.randn(tensor.shape, generator=random)

    if kind.startswith("fdm"):
        form = QuarticFdm if kind == QuarticFdm.kind else GaussianFdm
        fdm = form.initial(COUNT, bases=2, width=0.3)
        weight, centre, width = (stirred(each) for each in fdm.parameters().values())
        return form(weight, centre, width)
    coloured, glossy = kind == "shared with colour", kind == "shared with gloss"
    linear: Fused = SharedBasis.initial(COUNT, bases=4, colour=coloured, gloss=glossy)
    linear = PolynomialFourier.initial(COUNT, weights=4) if kind == "pfs" else linear
    return dataclasses.replace(linear, weight=stirred(linear.weight))


def frames(count: int = 3, width: int = WIDTH, *, glossy: bool = False) -> list[TrainingFrame]:
    """Noise in coarse squares, with holes in tissue and depth; where glossy, of the eyes in turn."""
    random = np.random.default_rng(51)
    made = []
    for k in range(count):
        shape, stride = (HEIGHT, width), padded(width)
        rgb = np.full((3, HEIGHT, stride), 255, np.uint8)
        weight, inverse = np.zeros((HEIGHT, stride), np.uint8), np.full((HEIGHT, stride), 0.5, np.float32)
        rgb[:, :, :width] = (
            random.integers(0, 256, (3, HEIGHT // 4, width // 4 + 1)).repeat(4, 1).repeat(4, 2)[..., :width]
        )
        tissue = random.uniform(size=shape) > 0.15
        measured = tissue & (random.uniform(size=shape) > 0.2)
        weight[:, :width] = tissue * 255
        inverse[:, :width] = np.where(measured, 1 / random.uniform(50, 70, shape), 0)
        camera = CAMERA.copy()
        camera[[WIDTH_PLACE, SIDE]] = width, (0.5 - k % 2) * glossy
        camera[POSE + 3] += 0.1 * k
        target = rgb.ravel(), weight.ravel(), inverse.ravel()
        counts = int(tissue.sum()), int(measured.sum())
        made.append(TrainingFrame(camera, 0.3 + 0.4 * k / count, partial(Target, *target), *counts))
    return made


AnyModel = CudaModel | CpuModel


def model(device: str, kind: str = "shared with colour", sh_degree: int = 0) -> CudaModel:
    return CudaModel(gaussians(sh_degree), deformation(kind), WIDTH, HEIGHT, device)


def train(trained: AnyModel, seen: Sequence[TrainingFrame], sh_degree: int = 0, first: int = 1) -> None:
    for iteration, frame in enumerate(seen, start=first):
        trained.step([frame], LOSS, RATES, iteration, min(sh_degree, iteration - 1))


def stored(trained: AnyModel) -> dict[str, Tensor]:
    return {name: each.cpu().clone() for name, each in trained.arrays().items()}


def assert_same_bits(got: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    assert got.keys() == wanted.keys()
    for name, each in wanted.items():
        assert bool((got[name] == each).all()), name


@pytest.mark.parametrize(
    ("kind", "sh_degree"),
    [
        ("shared", 1),
        ("shared with colour", 0),
        ("shared with gloss", 0),
        ("pfs", 0),
        ("fdm-gaussian", 0),
        ("fdm-quartic", 0),
    ],
)
def test_steps_change_a_model_as_they_do_on_the_cpu(kind: str, sh_degree: int, device: str) -> None:
    cpu = CpuModel(gaussians(sh_degree), deformation(kind), WIDTH, HEIGHT)
    cuda = model(device, kind, sh_degree)
    for trained in (cpu, cuda):
        train(trained, frames(2, glossy=kind == "shared with gloss"), sh_degree)
    before = CpuModel(gaussians(sh_degree), deformation(kind), WIDTH, HEIGHT).parameters()
    wanted = cpu.arrays()
    got = stored(cuda)
    assert got.keys() == wanted.keys()
    for name, each in wanted.items():
        if name in before and each.numel():
            moved = each - before[name]
            assert bool(moved.any()), name
            assert_close(got[name] - before[name].numpy(), moved, relative=1e-3, name=f"step of {name}")
        assert_close(got[name], each, relative=1e-4, absolute=1e-9, name=name)


def test_what_was_trained_on_the_device_renders_on_the_cpu_within_an_8_bit_step(device: str) -> None:
    cuda = model(device)
    train(cuda, frames(1))
    cpu = CpuModel(*cuda.export(), WIDTH, HEIGHT)
    values = np.linspace(0, 1, COUNT, dtype=np.float32)
    image = cuda.render(CAMERA, 0.6, values).copy()
    picture = cuda.projected(CAMERA, 0.6, values)
    cuda.render(CAMERA, 0.1)
    picture.sort()
    np.testing.assert_array_equal(np.concatenate([picture.blend(rows) for rows in picture.bands], axis=1), image)
    wanted = cpu.render(CAMERA, 0.6, values)
    assert_close(image, wanted, relative=0.0, absolute=1 / 255, name="image")
    assert np.abs(image[[0, 1, 2, 4]] - wanted[[0, 1, 2, 4]]).mean() < 1e-5
    planes = np.stack([values[::-1], -values, 2 * values])
    assert_close(cuda.blended(CAMERA, 0.6, planes), cpu.blended(CAMERA, 0.6, planes), absolute=1e-3, name="planes")
    assert_close(cuda.deformed_mean(0.6), cpu.deformed_mean(0.6), relative=1e-6)


def test_several_times_are_rendered_at_once_and_other_sizes_too(device: str) -> None:
    cuda = model(device, sh_degree=1)
    images = cuda.render_times(CAMERA, [0.2, 0.7]).cpu().numpy().copy()
    for image, t in zip(images, (0.2, 0.7), strict=True):
        assert_close(image, cuda.render(CAMERA, t), relative=1e-6, name=f"at {t}")
    other = CAMERA.copy()
    other[:6] *= 0.5
    wanted = CpuModel(gaussians(1), deformation("shared with colour"), 10, 8).render(other, 0.2)
    assert_close(cuda.render(other, 0.2), wanted, relative=1e-3, name="half the size")


def test_the_gradient_of_an_image_is_the_cpus(device: str) -> None:
    cotangents = np.random.default_rng(3).normal(size=(5, HEIGHT, WIDTH)).astype(np.float32)
    cpu = CpuModel(gaussians(1), deformation("shared"), WIDTH, HEIGHT)
    wanted = cpu.image_gradient(CAMERA, 0.4, cotangents)
    got = model(device, "shared", 1).image_gradient(CAMERA, 0.4, cotangents)
    for row in range(14):
        assert_close(got[row], wanted[row], relative=1e-3, name=f"row {row}")


@pytest.fixture(scope="module")
def three_steps(device: str) -> dict[str, Tensor]:
    """What a model is after a step on each of three frames that nothing came between."""
    trained = model(device)
    train(trained, frames())
    return stored(trained)


def test_the_same_steps_give_the_same_bits_also_after_a_resumption(three_steps: dict[str, Tensor], device: str) -> None:
    again, resumed, seen = model(device), model(device), frames()
    train(again, seen[:1])
    kept = stored(again)
    train(again, seen[1:], first=2)
    assert_same_bits(stored(again), three_steps)
    resumed.load_arrays(kept)
    train(resumed, seen[1:], first=2)
    assert_same_bits(stored(resumed), three_steps)


def test_arrays_of_another_size_are_refused_by_name(device: str) -> None:
    arrays = stored(model(device))
    arrays["opacity_logit"] = arrays["opacity_logit"][:-1]
    with pytest.raises(ValueError, match=r"opacity_logit has shape \(31,\), this model needs \(32,\)"):
        model(device).load_arrays(arrays)


def test_a_model_with_too_little_room_ends_as_one_with_ample_room(three_steps: dict[str, Tensor], device: str) -> None:
    tight, seen = model(device), frames()
    train(tight, seen[:1])
    tight.wait()
    tight._training.rasterizer._allocate_slots(8)
    train(tight, seen[1:], first=2)
    assert tight.wait() is not None
    assert tight._training.rasterizer.capacity > 8
    assert_same_bits(stored(tight), three_steps)


def test_steps_are_answered_for_once_and_together(device: str) -> None:
    cpu = CpuModel(gaussians(), deformation("shared"), WIDTH, HEIGHT)
    seen = frames(2)
    answers = [cpu.step([frame], LOSS, RATES, k + 1) for k, frame in enumerate(seen)]
    cuda = model(device, "shared")
    assert cuda.steps_a_report == CHECK_EVERY
    assert [cuda.step([frame], LOSS, RATES, k + 1) for k, frame in enumerate(seen)] == [None] * 2
    answer = cuda.wait()
    assert answer is not None
    for name in ("colour_l1", "depth_l1", "squared_error", "holes"):
        assert getattr(answer, name) == pytest.approx(sum(getattr(each, name) for each in answers), rel=1e-4)
    assert 0 < answer.visible <= min(each.visible for each in answers)
    assert cuda.wait() is None


def test_what_was_learnt_while_waiting_for_something_else_comes_with_the_next_step(device: str) -> None:
    cuda, seen = model(device, "shared"), frames(2)
    assert cuda.step(seen[:1], LOSS, RATES, 1) is None
    assert cuda.visible.shape == (COUNT,)
    answer = cuda.step(seen[1:], LOSS, RATES, 2)
    assert answer is not None
    assert answer.visible == int(cuda.visible.sum())


@pytest.mark.parametrize(("kind", "sh_degree"), [("shared with colour", 0), ("fdm-gaussian", 1)])
def test_steps_on_several_frames_change_a_model_as_they_do_on_the_cpu(kind: str, sh_degree: int, device: str) -> None:
    cpu = CpuModel(gaussians(sh_degree), deformation(kind), WIDTH, HEIGHT)
    cuda, seen = model(device, kind, sh_degree), frames()
    squared_errors = []
    for trained in (cpu, cuda):
        answers = [trained.step(seen[:1], LOSS, RATES, 1), trained.step(seen[1:], LOSS, RATES, 2, sh_degree)]
        squared_errors.append(sum(each.squared_error for each in [*answers, trained.wait()] if each is not None))
    assert squared_errors[1] == pytest.approx(squared_errors[0], rel=1e-4)  # those of no step are lost
    wanted = cpu.arrays()
    for name, each in stored(cuda).items():
        assert_close(each, wanted[name], relative=1e-4, absolute=1e-9, name=name)
    assert_close(cuda.gradient_norm, cpu.gradient_norm, relative=1e-3)


def test_more_frames_than_can_be_drawn_at_once_are_refused_and_no_preset_asks_for_them(device: str) -> None:
    assert MAX_FRAMES_A_STEP == MAX_FRAMES
    for count in (0, MAX_FRAMES + 1):
        with pytest.raises(ValueError, match=f"{count} frames at once"):
            model(device).step(frames(1) * count, LOSS, RATES, 1)


def test_what_is_replayed_ends_as_what_is_launched(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = replays.emulate(monkeypatch) if device == "cpu" else None
    cpu, cuda = CpuModel(gaussians(), deformation("shared with colour"), WIDTH, HEIGHT), model(device)
    cuda._store.row(frames(1)[0])  # else the first step makes room, and the second is the first with these addresses
    columns = np.r_[np.arange(COUNT)[::-1], 5, 7, 7]
    for trained in (cpu, cuda):
        train(trained, frames())
        trained.render(CAMERA, 0.6)
        trained.take(columns, np.arange(len(columns)) >= COUNT)
        train(trained, frames(2), first=4)
    wanted = cpu.arrays()
    for name, each in stored(cuda).items():
        assert_close(each, wanted[name], relative=1e-4, absolute=1e-9, name=name)
    if graph is not None:
        assert (graph.made, graph.replayed) == (2, 3)


def test_gaussians_taken_train_on_as_on_the_cpu(device: str) -> None:
    kind = "fdm-gaussian"
    models = (CpuModel(gaussians(), deformation(kind), WIDTH, HEIGHT), model(device, kind))
    columns = np.r_[np.arange(COUNT)[::-1], 5, 7, 7]
    for trained in models:
        train(trained, frames(2)[:1])
        trained.take(columns, np.arange(len(columns)) >= COUNT)
        train(trained, frames(2)[1:], first=2)
        assert trained.count == COUNT + 3
        assert len(trained.export()[0]) == COUNT + 3
    wanted = models[0].arrays()
    for name, each in stored(models[1]).items():
        assert_close(each, wanted[name], relative=1e-4, absolute=1e-9, name=name)
    assert_close(models[1].gradient_norm, models[0].gradient_norm, relative=1e-3)
    seen = models[1].visible.cpu()
    assert bool(seen[models[0].gradient_norm > 0].all())
    assert not bool((seen & ~models[0].visible).any())  # the CPU culls by a bound, here by the very tiles


def test_parameters_may_be_written_between_two_steps(device: str) -> None:
    written, frame = model(device), frames(1)[0]
    start = stored(written)
    written.step([frame], LOSS, RATES, 1)
    after = stored(written)
    for name, values in written.arrays().items():  # as a trial run is taken back
        values.copy_(start[name])
    written.step([frame], LOSS, RATES, 1)
    assert_same_bits(stored(written), after)


def test_more_frames_than_there_was_room_for_and_frames_of_another_size(
    three_steps: dict[str, Tensor], device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("intrasplat.splat.cuda.frames.FIRST_CAPACITY", 1)
    crowded = model(device)
    train(crowded, frames())
    assert_same_bits(stored(crowded), three_steps)
    with pytest.raises(ValueError, match="a frame of 40 x 16 pixels, the others have 20 x 16"):
        crowded.step(frames(1, width=40), LOSS, RATES, 4)


@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype feature:UserWarning")
def test_steps_between_two_looks_make_the_host_wait_for_nothing(device: str) -> None:
    if device == "cpu":
        pytest.skip("without a GPU there is nothing to wait for; run with --device cuda")
    trained, seen = model(device), frames()
    train(trained, seen)  # compiles, copies the frames, captures
    trained.wait()
    torch.cuda.set_sync_debug_mode("error")
    try:
        train(trained, seen, first=4)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert trained.wait() is not None
