"""What the CUDA backend's rasteriser has beyond the contract: buffers, room, several frames at once, the built-in loss.

Runs in Triton's interpreter, or on a GPU with --device cuda. N Gaussians, F frames, H W pixels.
"""

from __future__ import annotations

import dataclasses
import importlib
import itertools
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")

from intrasplat.splat import cpu, reference
from intrasplat.splat.camera import Camera
from intrasplat.splat.cpu import padded
from intrasplat.splat.cuda import rasterize
from intrasplat.splat.cuda.bins import MAX_FRAMES
from intrasplat.splat.cuda.rasterizer import CudaRasterizer, Gradients
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.step import camera_vector
from tests.helpers import assert_close
from tests.intrasplat.splat.scenes import INTERPRETED, SplatScene, pixels_near_a_cut, random_scene, unproject
from tests.intrasplat.splat.test_backends import random_cotangent, values_and_gradients
from tests.intrasplat.splat.test_cpu import LOSSES, NORMALISED, RawFrame, random_frame

WIDTH, HEIGHT = 11, 7
"""Two tiles, neither of them whole: enough where tiles themselves are not the matter."""


@dataclasses.dataclass
class SceneFrames:
    """Scenes of equal size, one a frame, as the rasteriser reads them."""

    scenes: list[SplatScene]
    device: str

    def arguments(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """camera, state, opacity_logit, colour; the scenes share their opacities."""
        cameras = np.stack([camera_vector(each.camera) for each in self.scenes])
        states = [torch.cat([each.mean, each.quaternion, each.scale.log()], dim=1).T for each in self.scenes]
        logit = torch.logit(self.scenes[0].opacity).float()
        colours = torch.stack([each.colour.T for each in self.scenes])
        given = (torch.from_numpy(cameras), torch.stack(states).float(), logit, colours.float())
        return tuple(each.contiguous().to(self.device) for each in given)  # type: ignore[return-value]

    def rasterizer(self) -> CudaRasterizer:
        view = self.scenes[0].camera
        return CudaRasterizer(view.width, view.height, self.device, frames=len(self.scenes))


@pytest.fixture
def memory(device: str) -> str:
    """Where tensors lie: the interpreter takes the host's."""
    return device


def scene_of(count: int = 40, seed: int = 30, **options: float) -> SplatScene:
    return random_scene(count, width=WIDTH, height=HEIGHT, seed=seed, **options).to(torch.float32)  # type: ignore[arg-type]


def clip_of(frames: list[RawFrame], device: str) -> tuple[Tensor, Tensor, Tensor]:
    """rgb, weight and inverse depth of frames, on the device."""
    rgb = np.stack([each.rgb.transpose(2, 0, 1) for each in frames])
    weight = np.stack([each.tissue * np.uint8(255) for each in frames])
    depth = np.stack([each.depth for each in frames])
    inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0).astype(np.float32)
    return tuple(torch.from_numpy(each).contiguous().to(device) for each in (rgb, weight, inverse))  # type: ignore[return-value]


def loss_of(rasterizer: CudaRasterizer, frames: list[RawFrame], settings: LossSettings, order: list[int]) -> Gradients:
    """loss_backward of frames, given as a clip in another order."""
    device = str(rasterizer.device)
    clip = clip_of([frames[order.index(k)] for k in range(len(frames))], device)
    rows = torch.from_numpy(np.stack([each.kernel_settings(settings) for each in frames])).to(device)
    chosen = torch.tensor(order, dtype=torch.int32, device=device)
    return rasterizer.loss_backward(*clip, rows, chosen, pose=True)


def outcome(view: SceneFrames, rasterizer: CudaRasterizer, frames: list[RawFrame]) -> list[Tensor]:
    """Copies of everything a render and a loss leave behind for the caller."""
    rasterizer.project_and_sort(*view.arguments())
    image = rasterizer.render().clone()
    gradients = loss_of(rasterizer, frames, NORMALISED, list(range(len(frames))))
    parts = [getattr(gradients, field.name) for field in dataclasses.fields(gradients)]
    return [image, *(each.clone() for each in (rasterizer.statistics, rasterizer.count, *parts))]


def poison(rasterizer: CudaRasterizer) -> None:
    """Fills every buffer with what no computation may read: NaN, and the largest integer."""
    kept = {id(rasterizer.ok), id(rasterizer.needed), id(rasterizer._borders)}
    buffers = [each for each in vars(rasterizer).values() if isinstance(each, Tensor) and id(each) not in kept]
    buffers += [getattr(rasterizer.gradients, field.name) for field in dataclasses.fields(rasterizer.gradients)]
    for each in buffers:
        each.fill_(float("nan") if each.is_floating_point() else torch.iinfo(each.dtype).max)


def assert_same_bits(actual: list[Tensor], expected: list[Tensor]) -> None:
    for got, wanted in zip(actual, expected, strict=True):
        assert torch.equal(got, wanted)


@pytest.mark.parametrize("options", [{}, {"pixels": 9.0, "opacities": (0.9,)}], ids=["open", "opaque"])
def test_what_the_buffers_held_before_changes_nothing(options: dict[str, float], memory: str) -> None:
    view = SceneFrames([scene_of(**options)], memory)
    frames = [random_frame(view.scenes[0].camera, np.zeros((HEIGHT, WIDTH), bool))]
    expected = outcome(view, view.rasterizer(), frames)
    used = view.rasterizer()
    used.project_and_sort(*view.arguments())
    poison(used)
    assert_same_bits(outcome(view, used, frames), expected)


def test_a_rasterizer_that_saw_other_scenes_gives_the_same_bits(memory: str) -> None:
    view, other = SceneFrames([scene_of()], memory), SceneFrames([scene_of(150, seed=31, pixels=3.0)], memory)
    frames = [random_frame(view.scenes[0].camera, np.zeros((HEIGHT, WIDTH), bool))]
    used = other.rasterizer()
    used.project_and_sort(*other.arguments())
    used.grown()
    assert_same_bits(outcome(view, used, frames), outcome(view, view.rasterizer(), frames))


def test_several_frames_at_once_are_each_what_it_is_alone(memory: str) -> None:
    first = scene_of()
    turned = dataclasses.replace(first.camera, camera_from_world=np.asarray(first.camera.camera_from_world).copy())
    turned.camera_from_world[0, 3] += 4.0
    shifted = dataclasses.replace(first, mean=first.mean + 1.5, camera=turned)
    scenes = [first, shifted]
    frames = [random_frame(first.camera, np.zeros((HEIGHT, WIDTH), bool)) for _ in scenes]
    frames[1] = dataclasses.replace(frames[1], tissue=~frames[1].tissue)
    together = SceneFrames(scenes, memory).rasterizer()
    together.project_and_sort(*SceneFrames(scenes, memory).arguments())
    image = together.render().clone()
    got = loss_of(together, frames, NORMALISED, [1, 0])
    for f, scene in enumerate(scenes):
        alone = SceneFrames([scene], memory).rasterizer()
        alone.project_and_sort(*SceneFrames([scene], memory).arguments())
        assert torch.equal(alone.render()[0], image[f])
        wanted = loss_of(alone, [frames[f]], NORMALISED, [0])
        for name in ("state", "opacity_logit", "colour", "mean2d_norm"):
            assert torch.equal(getattr(wanted, name)[0], getattr(got, name)[f]), name
        assert torch.equal(wanted.pose.sum(0)[0], got.pose.sum(0)[f])
        assert torch.equal(alone.statistics[0], together.statistics[f])
        assert torch.equal(alone.count[0], together.count[f])


@pytest.mark.parametrize("settings", LOSSES.values(), ids=LOSSES.keys())
def test_the_built_in_loss_has_the_gradients_of_the_loss(settings: LossSettings, memory: str) -> None:
    scene = scene_of(90, seed=34)
    frame = random_frame(scene.camera, pixels_near_a_cut(scene))
    rasterizer = SceneFrames([scene], memory).rasterizer()
    rasterizer.project_and_sort(*SceneFrames([scene], memory).arguments())
    got = loss_of(rasterizer, [frame], settings, [0])

    live = scene.to(torch.float64).differentiable()
    leaves = live.leaves()
    gradients = torch.autograd.grad(frame.loss(live, settings), list(leaves.values()))
    wanted = dict(zip(leaves, gradients, strict=True))
    opacity, scale = live.opacity.detach(), live.scale.detach()
    assert_close(got.state[0, 0:3].T, wanted["mean"], name="mean")
    assert_close(got.state[0, 3:7].T, wanted["quaternion"], name="quaternion")
    assert_close(got.state[0, 7:10].T, wanted["scale"] * scale, name="log_scale")
    assert_close(got.opacity_logit[0], wanted["opacity"] * opacity * (1 - opacity), name="opacity_logit")
    assert_close(got.colour[0].T, wanted["colour"], name="colour")
    assert_close(got.pose.sum((0, 1)).reshape(3, 4), wanted["camera_from_world"][:3], name="camera_from_world")

    rendered = scene.to(torch.float64).render()
    error = (rendered.rgb.detach().numpy() - frame.rgb / 255.0) * frame.tissue[..., None]
    holes = (1 - rendered.alpha.detach().numpy()) * frame.tissue
    sums = rasterizer.statistics.double().sum((0, 1))[[0, 2, 3]]
    assert_close(sums, np.array([np.abs(error).sum(), (error**2).sum(), holes.sum()]), relative=1e-5)


def test_a_depth_of_half_precision_is_read_as_such(memory: str) -> None:
    scene = scene_of()
    frame = random_frame(scene.camera, np.zeros((HEIGHT, WIDTH), bool))
    rgb, weight, inverse_depth = clip_of([frame], memory)
    halved = inverse_depth.half()
    rest = (
        torch.from_numpy(frame.kernel_settings(NORMALISED))[None].to(memory),
        torch.zeros(1, dtype=torch.int32, device=memory),
    )
    rasterizer = SceneFrames([scene], memory).rasterizer()
    rasterizer.project_and_sort(*SceneFrames([scene], memory).arguments())
    wanted = rasterizer.loss_backward(rgb, weight, halved.float(), *rest).state.clone()
    assert torch.equal(rasterizer.loss_backward(rgb, weight, halved, *rest).state, wanted)


def test_what_the_kernels_would_misread_is_refused(memory: str) -> None:
    view = SceneFrames([scene_of()], memory)
    camera, state, logit, colour = view.arguments()
    rasterizer = view.rasterizer()
    with pytest.raises(ValueError, match=r"camera is contiguous torch.float32 \[1, 26\], not .* torch.float64"):
        rasterizer.project_and_sort(camera.float(), state, logit, colour)
    with pytest.raises(ValueError, match=r"state is strided"):
        rasterizer.project_and_sort(camera, state.transpose(1, 2).contiguous().transpose(1, 2), logit, colour)
    with pytest.raises(ValueError, match=r"colour is contiguous torch.float32 \[1, 4, 40\], not .* \[1, 3, 40\]"):
        rasterizer.project_and_sort(camera, state, logit, state[:, :4].contiguous())
    with pytest.raises(ValueError, match="cotangents is"):
        rasterizer.cotangent_backward(rasterizer.render().double())


def test_a_value_is_blended_as_colour_is_and_leaves_the_rest_as_it_was(memory: str) -> None:
    scene = scene_of()
    values = torch.rand(len(scene.mean), generator=torch.Generator().manual_seed(0))
    grey = dataclasses.replace(scene, colour=values[:, None].repeat(1, 3))
    rasterizer = SceneFrames([scene], memory).rasterizer()
    rasterizer.project_and_sort(*SceneFrames([scene], memory).arguments())
    without = rasterizer.render().clone()
    with_values = rasterizer.render(values.to(memory)).clone()
    rasterizer.project_and_sort(*SceneFrames([grey], memory).arguments())
    assert torch.equal(with_values[:, :5], without)
    assert_close(with_values[:, 5], rasterizer.render()[:, 0], relative=1e-6)


def test_too_little_room_is_noticed_kept_in_mind_and_mended(memory: str) -> None:
    view = SceneFrames([scene_of(80, pixels=6.0)], memory)
    enough = view.rasterizer()
    enough.project_and_sort(*view.arguments())
    assert not enough.grown()
    expected = enough.render().clone()
    touched = int(enough.count.sum())

    small = view.rasterizer()
    small.reserve(80, touched - 1)
    small.project_and_sort(*view.arguments())
    loss_of(small, [random_frame(view.scenes[0].camera, np.zeros((HEIGHT, WIDTH), bool))], NORMALISED, [0])
    assert int(small.ok) == 0
    assert int(small.needed) == touched
    empty = dataclasses.replace(view.scenes[0], opacity=torch.full((80,), 1e-4))
    small.project_and_sort(*SceneFrames([empty], memory).arguments())
    assert int(small.ok) == 0, "a later projection that fits does not undo it"
    assert small.grown()
    assert small.capacity >= touched
    small.project_and_sort(*view.arguments())
    assert not small.grown()
    assert torch.equal(small.render(), expected)


def test_what_fits_exactly_fits(memory: str) -> None:
    view = SceneFrames([scene_of()], memory)
    enough = view.rasterizer()
    enough.project_and_sort(*view.arguments())
    exact = view.rasterizer()
    exact.reserve(40, int(enough.count.sum()))
    exact.project_and_sort(*view.arguments())
    assert not exact.grown()
    assert torch.equal(exact.render(), enough.render())


def needle(view: Camera, scale: tuple[float, float, float], turn: float) -> SplatScene:
    """One Gaussian in the middle of the image, turned in its plane."""
    pose = dataclasses.replace(view, camera_from_world=np.eye(4))
    middle = unproject(pose, np.array([view.width / 2]), np.array([view.height / 2]), np.array([50.0]))
    return SplatScene(
        mean=torch.tensor(middle, dtype=torch.float32),
        quaternion=torch.tensor([[np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)]], dtype=torch.float32),
        scale=torch.tensor([scale]),
        opacity=torch.tensor([0.7]),
        colour=torch.tensor([[0.3, 0.6, 0.9]]),
        camera=pose,
    )


@pytest.mark.parametrize("turn", [0.0, 0.5, np.pi / 4, 1.3, 2.6])
@pytest.mark.parametrize("scale", [(30.0, 0.05, 0.05), (3.0, 1.0, 1.0), (500.0, 500.0, 500.0)])
def test_every_tile_with_a_pixel_of_a_splat_has_it_and_few_others(
    scale: tuple[float, float, float], turn: float, memory: str
) -> None:
    view = random_scene(1, width=21, height=18).camera
    scene = needle(view, scale, turn)
    rasterizer = SceneFrames([scene], memory).rasterizer()
    rasterizer.project_and_sort(*SceneFrames([scene], memory).arguments())
    drawn = scene.to(torch.float64).render().alpha > 0
    whole = torch.zeros(24, 24, dtype=torch.bool)
    whole[: view.height, : view.width] = drawn
    touched = whole.reshape(3, 8, 3, 8).any(3).any(1)
    chosen = int(rasterizer.count)
    assert int(touched.sum()) <= chosen <= int(touched.sum()) + 1
    starts = rasterizer._tile_start.cpu().diff().reshape(touched.shape) > 0
    assert bool((starts | ~touched).all())


def test_parameters_beyond_all_training_give_what_they_give_on_the_cpu(memory: str) -> None:
    size = 10
    view = camera_vector(Camera(30.0, 30.0, 5.0, 5.0, size, size, np.eye(4)))
    far = [-np.inf, -3e38, -150.0, -104.0, -88.0, -20.0, -1.0, 2.0, 20.0, 88.0, 150.0, 3e38, np.inf]
    needles = list(itertools.product((-3e38, -20.0, 0.0, 9.0, 16.0, 90.0, 1e4), (0.0, 16.0)))
    count = padded(len(far) + len(needles))
    state = np.zeros((10, count), np.float32)
    state[0], state[2] = np.linspace(-8, 8, count), np.linspace(50, 70, count)
    state[3:7] = np.array([[0.7], [0.2], [-0.4], [0.1]])
    state[7:9, len(far) : len(far) + len(needles)] = np.array(needles).T
    logit = np.full(count, -30.0, np.float32)
    logit[: len(far)], logit[len(far) : len(far) + len(needles)] = far, 2.0
    random = np.random.default_rng(0)
    colour = random.uniform(size=(3, count)).astype(np.float32)
    cotangents = random.normal(size=(5, size, size)).astype(np.float32)
    there = cpu.Rasterizer(size, size)
    there.project_and_sort(view, state, logit, colour)
    here = CudaRasterizer(size, size, memory)
    given = [torch.from_numpy(each).to(memory) for each in (view[None], state[None], logit, colour[None])]
    here.project_and_sort(*given)
    assert not here.grown()
    assert_close(here.render()[0], there.render(), name="image")
    got = here.cotangent_backward(torch.from_numpy(cotangents)[None].to(memory))
    wanted = there.cotangent_backward(cotangents)
    assert_close(got.state[0], wanted.state[:10], name="state")
    for name in ("opacity_logit", "colour", "mean2d_norm"):
        assert_close(getattr(got, name)[0], getattr(wanted, name), name=name)


@pytest.mark.parametrize("row", [0, 2, 4, 8, "opacity"])
def test_a_gaussian_with_a_parameter_that_is_no_number_is_not_drawn(row: int | str, memory: str) -> None:
    view = SceneFrames([scene_of(12, pixels=3.0)], memory)
    camera, state, logit, colour = view.arguments()
    without = view.rasterizer()
    without.project_and_sort(camera, state, torch.where(torch.arange(12, device=memory) == 5, -30.0, logit), colour)
    state, logit = state.clone(), logit.clone()
    if isinstance(row, int):
        state[0, row, 5] = float("nan")
    else:
        logit[5] = float("nan")
    rasterizer = view.rasterizer()
    rasterizer.project_and_sort(camera, state, logit, colour)
    assert int(rasterizer.count[0, 5]) == 0
    assert torch.equal(rasterizer.render(), without.render())


def test_more_tiles_than_16_bits_can_number_are_sorted_with_32(memory: str) -> None:
    width, frames = 8 * 2100, MAX_FRAMES
    scene = random_scene(3, width=width, height=1, seed=3, pixels=4.0).to(torch.float32)
    rasterizer = CudaRasterizer(width, 1, memory, frames=frames)
    rasterizer.project_and_sort(*SceneFrames([scene] * frames, memory).arguments())
    of_frame = rasterizer._tile_start[:-1].reshape(frames, 2100).diff(dim=0)
    touched = int(rasterizer.count[0].sum())
    assert touched > 0
    assert bool((of_frame == touched).all())
    assert int(rasterizer._tile_start[-1]) == frames * touched


def test_more_frames_than_can_be_sorted_are_refused(memory: str) -> None:
    with pytest.raises(ValueError, match=f"{MAX_FRAMES + 1} frames at once"):
        CudaRasterizer(WIDTH, HEIGHT, memory, frames=MAX_FRAMES + 1)


@pytest.mark.parametrize("size", [(0, 5), (5, 0)])
def test_an_image_without_pixels_is_refused(size: tuple[int, int], memory: str) -> None:
    with pytest.raises(ValueError, match="no image of"):
        CudaRasterizer(*size, memory)


@pytest.mark.parametrize("gaussians", [200_000_000, 40_000_000])
def test_more_than_32_bits_can_number_is_refused(gaussians: int, memory: str) -> None:
    rasterizer = CudaRasterizer(WIDTH, HEIGHT, memory, frames=MAX_FRAMES)
    with pytest.raises(ValueError, match=f"{gaussians} Gaussians"):
        rasterizer.reserve(gaussians)


def test_no_gaussians_leave_the_tissue_a_hole(memory: str) -> None:
    full = scene_of()
    scene = full.rows(torch.zeros(0, dtype=torch.long))
    frame = random_frame(scene.camera, np.zeros((HEIGHT, WIDTH), bool))
    rasterizer = SceneFrames([full], memory).rasterizer()
    rasterizer.project_and_sort(*SceneFrames([full], memory).arguments())
    rasterizer.project_and_sort(*SceneFrames([scene], memory).arguments())
    gradients = loss_of(rasterizer, [frame], NORMALISED, [0])
    assert not rasterizer.render().any()
    assert gradients.state.shape == (1, 10, 0)
    assert float(rasterizer.statistics[..., 3].sum()) == pytest.approx(float(frame.tissue.sum()), rel=1e-6)


@pytest.mark.skipif(not INTERPRETED, reason="a GPU's matrix unit needs no imitation")
def test_gradients_survive_a_matrix_unit_that_keeps_ten_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter multiplies matrices in full; here it cuts their entries as a tensor core does with TF32."""
    builder = importlib.import_module("triton.runtime.interpreter").InterpreterBuilder
    exact_product, used = builder.create_dot, []

    def cut(handle: Any) -> Any:
        bits = np.ascontiguousarray(handle.data).view(np.int32) & np.int32(-(1 << 13))
        return type(handle)(bits.view(np.float32), handle.dtype)

    def product(self: Any, a: Any, b: Any, total: Any, precision: Any, *rest: Any) -> Any:
        used.append(precision)
        return exact_product(self, cut(a), cut(b), total, precision, *rest)

    monkeypatch.setattr(builder, "create_dot", product)
    scene = random_scene(60, width=WIDTH, height=HEIGHT, seed=6).to(torch.float32)
    cotangent = random_cotangent(scene, pixels_near_a_cut(scene))
    _, wanted = values_and_gradients(scene.to(torch.float64), reference.rasterize, cotangent)
    _, got = values_and_gradients(scene, rasterize, cotangent)
    assert used
    for name, gradient in wanted.items():
        assert_close(got[name], gradient, relative=1e-5, name=f"gradient of {name}")
