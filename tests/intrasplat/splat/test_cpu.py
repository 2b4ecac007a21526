"""What the CPU backend has beyond the contract: reused buffers, the built-in loss, the fused training step, Adam.

The gradients of a step are read from Adam's first moments, which after one step from zero are 0.1 of them.
"""

# long: one table of motions, and what each kernel must do with every one of them

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from intrasplat.splat.camera import Camera
from intrasplat.splat.cpu import Rasterizer, padded
from intrasplat.splat.cpu.model import CpuModel
from intrasplat.splat.cpu.motion import NEGLIGIBLE, FdmMotion, LinearMotion, motion_of
from intrasplat.splat.deformation import FlexibleDeformation, GaussianFdm, SharedBasis, restore
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import COLOUR_CHANNELS, ROWS
from intrasplat.splat.loss import LossSettings, training_loss
from intrasplat.splat.optimize import StepRates
from intrasplat.splat.step import Target, TrainingFrame, camera_vector
from lab.evaluate.variants.polynomial import PolynomialFourier
from lab.evaluate.variants.quartic import QuarticFdm
from tests.helpers import assert_close
from tests.intrasplat.splat.scenes import SplatScene, opaque_wall, pixels_near_a_cut, random_scene

LOSSES = {
    "summed depth": LossSettings(2e3, 4e4, normalised_depth=False, colour_huber_delta=0.05, depth_huber_delta=1e-3),
    "normalised depth": LossSettings(2e3, 4e4, normalised_depth=True, colour_huber_delta=0.05, depth_huber_delta=1e-3),
}
"""Weights near the number of pixels, so that gradients are near 1 and the absolute tolerance plays no part."""
NORMALISED = LOSSES["normalised depth"]
Fused = SharedBasis | PolynomialFourier | FlexibleDeformation
KINDS = ["shared", "shared with colour", "shared with gloss", "pfs", "fdm-gaussian", "fdm-quartic"]
"""Deformations with kernels of their own; colour moves in one of them, colour and gloss in another."""
SEEN_GLOSS = {"side": 0.4, "dim": 0.15}
"""Of a camera that sees some of it."""
RATES = StepRates(
    mean=1e-3,
    quaternion=2e-3,
    log_scale=3e-3,
    opacity=4e-3,
    colour=5e-3,
    gloss=11e-3,
    sh_rest=6e-3,
    motion_mean=7e-3,
    motion_quaternion=8e-3,
    motion_log_scale=9e-3,
    motion_colour=10e-3,
    motion_gloss=12e-3,
    eps=1e-15,
)


@dataclass(frozen=True)
class RawFrame:
    """One training frame, unpadded: rgb [H, W, 3] uint8, tissue [H, W] bool, depth [H, W] in units, 0 = invalid."""

    rgb: NDArray[np.uint8]
    tissue: NDArray[np.bool_]
    depth: NDArray[np.float32]

    def target(self, rasterizer: Rasterizer) -> Target:
        """Padded to whole tiles; the padding holds values that would show if they were read."""
        height, width = self.tissue.shape
        shape = (height, rasterizer.stride)
        rgb = np.full((3, *shape), 255, np.uint8)
        weight = np.full(shape, 255, np.uint8)
        inverse_depth = np.full(shape, 0.5, np.float32)
        rgb[:, :, :width] = self.rgb.transpose(2, 0, 1)
        weight[:, :width] = self.tissue * 255
        weight[:, width:] = 0
        inverse_depth[:, :width] = np.where(self.depth > 0, 1 / np.where(self.depth > 0, self.depth, 1), 0)
        return Target(rgb.ravel(), weight.ravel(), inverse_depth.ravel())

    def kernel_settings(self, settings: LossSettings) -> NDArray[np.float32]:
        """The kernel's loss is a sum over pixels: intrasplat.splat.loss's means need this frame's counts."""
        with_depth = int((self.tissue & (self.depth > 0)).sum())
        return np.array(
            [
                settings.colour_weight / (3 * int(self.tissue.sum())),
                settings.depth_weight / with_depth,
                1 / settings.colour_huber_delta,
                1 / settings.depth_huber_delta,
                settings.normalised_depth,
            ],
            np.float32,
        )

    def seen_from(self, camera: Camera, t: float, rasterizer: Rasterizer) -> TrainingFrame:
        """As a step takes it."""
        counts = int(self.tissue.sum()), int((self.tissue & (self.depth > 0)).sum())
        return TrainingFrame(camera_vector(camera), t, partial(self.target, rasterizer), *counts)

    def loss(self, scene: SplatScene, settings: LossSettings) -> Tensor:
        """intrasplat.splat.loss on the reference's render."""
        rendered = scene.render()
        true_rgb = torch.from_numpy(self.rgb).double() / 255
        true_depth, tissue = torch.from_numpy(self.depth).double(), torch.from_numpy(self.tissue)
        return training_loss(rendered.rgb, rendered.depth, rendered.alpha, true_rgb, true_depth, tissue, settings).total


def random_frame(camera: Camera, left_out: NDArray[np.bool_]) -> RawFrame:
    random = np.random.default_rng(21)
    shape = (camera.height, camera.width)
    depth = random.uniform(40, 90, shape) * (random.uniform(size=shape) > 0.2)
    return RawFrame(
        rgb=random.integers(0, 256, (*shape, 3), dtype=np.uint8),
        tissue=(random.uniform(size=shape) > 0.15) & ~left_out,
        depth=depth.astype(np.float32),
    )


def project_with(rasterizer: Rasterizer, scene: SplatScene) -> None:
    """The scene's Gaussians onto its camera, as rows of padded columns."""
    count = padded(len(scene.mean))

    def rows(values: Tensor, fill: float) -> NDArray[np.float32]:
        filled = np.full((values.shape[1], count), fill, np.float32)
        filled[:, : len(values)] = values.T.numpy()
        return filled

    state = np.concatenate([rows(scene.mean, 0.0), rows(scene.quaternion, 1.0), rows(scene.scale.log(), 0.0)])
    logit = rows(torch.logit(scene.opacity)[:, None], -30.0)[0]
    rasterizer.project_and_sort(camera_vector(scene.camera), state, logit, rows(scene.colour, 0.0))


def outcome(rasterizer: Rasterizer, scene: SplatScene, frame: RawFrame) -> list[NDArray[np.float32]]:
    """Copies of everything a render and a loss leave behind for the caller."""
    project_with(rasterizer, scene)
    image = rasterizer.render().copy()
    gradients = rasterizer.loss_backward(frame.target(rasterizer), frame.kernel_settings(NORMALISED))
    parts = [getattr(gradients, field.name).copy() for field in dataclasses.fields(gradients)]
    parts[0] = parts[0][:10]  # the rest of the state's rows are the caller's to fill
    return [image, rasterizer.statistics.copy(), *parts]


def assert_same_bits(actual: list[NDArray[np.float32]], expected: list[NDArray[np.float32]]) -> None:
    for got, wanted in zip(actual, expected, strict=True):
        assert got.shape == wanted.shape
        assert bool((got == wanted).all()), f"{int((got != wanted).sum())} of {got.size} differ"


def poison(rasterizer: Rasterizer) -> None:
    """Fills every buffer with what no computation may read: NaN, and the largest integer."""
    buffers = [each for each in vars(rasterizer).values() if isinstance(each, np.ndarray)]
    buffers += [getattr(rasterizer.gradients, field.name) for field in dataclasses.fields(rasterizer.gradients)]
    for each in buffers:
        each.fill(np.nan if each.dtype.kind == "f" else np.iinfo(each.dtype).max)


@pytest.mark.parametrize(
    "make_scene", [lambda: random_scene(180, width=45, height=37, seed=30), opaque_wall], ids=["open", "opaque"]
)
def test_what_the_buffers_held_before_changes_nothing(make_scene: Callable[[], SplatScene]) -> None:
    scene = make_scene()
    width, height = scene.camera.width, scene.camera.height
    frame = random_frame(scene.camera, np.zeros((height, width), bool))
    expected = outcome(Rasterizer(width, height), scene, frame)
    used = Rasterizer(width, height)
    outcome(used, scene, frame)
    poison(used)
    assert_same_bits(outcome(used, scene, frame), expected)


def test_a_rasterizer_that_saw_other_scenes_gives_the_same_bits() -> None:
    scene = random_scene(60, width=45, height=37, seed=31)
    larger = random_scene(500, width=45, height=37, seed=32, pixels=3.0)
    frame = random_frame(scene.camera, np.zeros((37, 45), bool))
    used = Rasterizer(45, 37)
    outcome(used, larger, frame)
    assert_same_bits(outcome(used, scene, frame), outcome(Rasterizer(45, 37), scene, frame))


@pytest.mark.parametrize("settings", LOSSES.values(), ids=LOSSES.keys())
def test_the_built_in_loss_has_the_gradients_of_the_loss(settings: LossSettings) -> None:
    scene = random_scene(220, width=45, height=37, seed=33).to(torch.float32)
    left_out = pixels_near_a_cut(scene)
    frame = random_frame(scene.camera, left_out)
    rasterizer = Rasterizer(45, 37)
    project_with(rasterizer, scene)
    got = rasterizer.loss_backward(frame.target(rasterizer), frame.kernel_settings(settings))

    live = scene.to(torch.float64).differentiable()
    leaves = live.leaves()
    gradients = torch.autograd.grad(frame.loss(live, settings), list(leaves.values()))
    wanted = dict(zip(leaves, gradients, strict=True))
    opacity, scale = live.opacity.detach(), live.scale.detach()
    assert_close(got.state[0:3, :220].T, wanted["mean"], name="mean")
    assert_close(got.state[3:7, :220].T, wanted["quaternion"], name="quaternion")
    assert_close(got.state[7:10, :220].T, wanted["scale"] * scale, name="log_scale")
    assert_close(got.opacity_logit[:220], wanted["opacity"] * opacity * (1 - opacity), name="opacity_logit")
    assert_close(got.colour[:, :220].T, wanted["colour"], name="colour")
    assert_close(got.pose.sum(0).reshape(3, 4), wanted["camera_from_world"][:3], name="camera_from_world")


def test_the_loss_reports_its_sums_over_tissue() -> None:
    scene = random_scene(220, width=45, height=37, seed=33).to(torch.float32)
    frame = random_frame(scene.camera, pixels_near_a_cut(scene))
    rasterizer = Rasterizer(45, 37)
    project_with(rasterizer, scene)
    rasterizer.loss_backward(frame.target(rasterizer), frame.kernel_settings(NORMALISED))
    rendered = scene.to(torch.float64).render()
    error = (rendered.rgb.numpy() - frame.rgb / 255.0) * frame.tissue[..., None]
    holes = (1 - rendered.alpha.numpy()) * frame.tissue
    sums = rasterizer.statistics.sum(0, dtype=np.float64)
    assert_close(sums[[0, 2, 3]], np.array([np.abs(error).sum(), (error**2).sum(), holes.sum()]), relative=1e-5)


def moving_gaussians(kind: str, sh_degree: int) -> tuple[Gaussians, Fused, Camera]:
    """A scene of 90 Gaussians as the optimiser holds it, float32, every basis well alive at t = 0.4."""
    scene = random_scene(90, width=37, height=33, seed=35)
    random = torch.Generator().manual_seed(5)
    sh = 0.1 * torch.randn(90, (sh_degree + 1) ** 2, 3, generator=random)
    sh[:, 0] += 0.8
    gaussians = Gaussians(
        mean=scene.mean.float(),
        quaternion=scene.quaternion.float(),
        log_scale=scene.scale.log().float(),
        opacity_logit=torch.logit(scene.opacity).float(),
        sh=sh,
    )
    if kind in ("shared", "shared with colour", "shared with gloss", "pfs"):
        coloured, glossy = kind == "shared with colour", kind == "shared with gloss"
        linear: Fused = SharedBasis.initial(90, bases=4, colour=coloured, gloss=glossy)
        linear = PolynomialFourier.initial(90, weights=6) if kind == "pfs" else linear
        camera = dataclasses.replace(scene.camera, **SEEN_GLOSS) if glossy else scene.camera
        shine = 0.2 * torch.randn(90, generator=random) if glossy else torch.zeros(90)
        gaussians = dataclasses.replace(gaussians, gloss=shine)
        return gaussians, dataclasses.replace(linear, weight=_stirred(linear.weight, 0.05, random)), camera
    form = QuarticFdm if kind == QuarticFdm.kind else GaussianFdm
    fdm = form.initial(90, bases=5, width=0.2)
    moved = {name: _stirred(each, 0.05, random) for name, each in fdm.parameters().items()}
    # Alive at t = 0.4 and narrower than the floor: no gradient to the width in the paper's form.
    moved["width"][0, 0, 2], moved["centre"][0, 0, 2] = 1e-4, 0.4005
    moved["width"][1, 0, 2] *= -1
    return gaussians, form(**moved), scene.camera


def _stirred(tensor: Tensor, amount: float, random: torch.Generator) -> Tensor:
    return tensor + amount * torch.randn(tensor.shape, generator=random)


@pytest.mark.parametrize(
    ("kind", "sh_degree"),
    [
        ("shared", 0),
        ("shared with colour", 0),
        ("shared with colour", 3),
        ("shared with gloss", 0),
        ("pfs", 0),
        ("fdm-gaussian", 0),
        ("fdm-quartic", 1),
    ],
)
def test_a_fused_step_has_the_gradients_of_the_stages_one_by_one(kind: str, sh_degree: int) -> None:
    t = 0.4
    gaussians, deformation, camera = moving_gaussians(kind, sh_degree)
    leaves = {name: each.double().requires_grad_() for name, each in gaussians.tensors().items()}
    motion = {name: each.double().requires_grad_() for name, each in deformation.parameters().items()}
    constants = {name: each.double() for name, each in deformation.constants().items()}
    moved = restore(deformation.kind, motion | constants).deform(Gaussians(**leaves), t)
    scene = _scene_of(moved, camera)
    frame = random_frame(camera, pixels_near_a_cut(scene))
    everything = [*leaves.values(), *motion.values()]
    gradients = torch.autograd.grad(
        frame.loss(scene, NORMALISED), everything, allow_unused=True, materialize_grads=True
    )
    wanted = dict(zip([*leaves, *motion], gradients, strict=True))

    model = CpuModel(gaussians, deformation, camera.width, camera.height)
    model.step([frame.seen_from(camera, t, model.rasterizer)], NORMALISED, RATES, 1, sh_degree)
    stored = {name: 10 * np.asarray(each) for name, each in model.arrays().items()}

    names = ("mean", "quaternion", "log_scale")
    canonical = torch.cat([*(wanted[name] for name in names), wanted["sh"][:, 0], wanted["gloss"][:, None]], dim=1)
    assert_close(stored["moments.canonical"][0, :, :90].T, canonical, name="canonical")
    assert_close(stored["moments.opacity_logit"][0, :90], wanted["opacity_logit"], name="opacity_logit")
    assert_close(stored["moments.sh_rest"][0, :, :, :90], wanted["sh"][:, 1:].permute(1, 2, 0), name="sh_rest")
    if not isinstance(deformation, FlexibleDeformation):
        assert_close(stored["motion.first"][:, :, :90], wanted["weight"].permute(2, 1, 0), name="weight")
    else:
        for row, name in enumerate(("weight", "centre", "width")):
            assert_close(stored["motion.first"][row, ..., :90], wanted[name].permute(1, 2, 0), name=name)


def test_without_a_first_moment_a_step_follows_the_gradient_and_leaves_the_moment_alone() -> None:
    gaussians, deformation, camera = moving_gaussians("shared with gloss", 0)
    everywhere = random_frame(camera, np.zeros((camera.height, camera.width), bool))

    def after(beta1: float) -> dict[str, Tensor]:
        model = CpuModel(gaussians, deformation, camera.width, camera.height)
        rates = dataclasses.replace(RATES, beta1=beta1)
        for iteration, t in enumerate((0.4, 0.6, 0.45), start=1):
            model.step([everywhere.seen_from(camera, t, model.rasterizer)], NORMALISED, rates, iteration)
        return model.arrays()

    without, nearly = after(0.0), after(1e-12)
    assert not without["motion.first"].any()
    assert nearly["motion.first"].any()
    for name in ("motion.weight", "motion.second", "canonical"):
        assert_close(without[name], nearly[name], relative=1e-5, name=name)


@pytest.mark.parametrize("yaw_deg", [0, 4], ids=["one depth axis", "two depth axes"])
@pytest.mark.parametrize(
    ("kind", "sh_degree"), [("shared with gloss", 0), ("shared with colour", 3), ("fdm-quartic", 0)]
)
def test_a_step_on_both_eyes_has_the_gradients_of_each_added(kind: str, sh_degree: int, yaw_deg: float) -> None:
    gaussians, deformation, left = moving_gaussians(kind, sh_degree)
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix()
    moved[0, 3] = -9.0  # so far that either eye sees some Gaussians alone
    right = dataclasses.replace(left, camera_from_world=moved @ left.camera_from_world, side=-0.3)
    everywhere = random_frame(left, np.zeros((left.height, left.width), bool))
    padding = Rasterizer(left.width, left.height)
    eyes = [everywhere.seen_from(camera, t, padding) for t, camera in [(0.4, left), (0.4, right), (0.6, right)]]

    def after(frames: list[TrainingFrame]) -> CpuModel:
        model = CpuModel(gaussians, deformation, left.width, left.height)
        model.step(frames, NORMALISED, RATES, 1, sh_degree)
        return model

    together, apart = after(eyes), [after([each]) for each in eyes]
    for name, stored in together.arrays().items():
        if "moments." in name or name == "motion.first":
            first = 0 if "moments." in name else slice(None)
            wanted = sum(each.arrays()[name][first] for each in apart)
            assert_close(stored[first], wanted, relative=1e-5, name=name)
    assert not bool((apart[0].visible == apart[1].visible).all())
    assert bool((together.visible == apart[0].visible | apart[1].visible | apart[2].visible).all())
    norms = torch.stack([each.gradient_norm for each in apart])
    assert bool((together.gradient_norm == norms.amax(0)).all())


def _scene_of(gaussians: Gaussians, camera: Camera) -> SplatScene:
    return SplatScene(
        mean=gaussians.mean,
        quaternion=gaussians.quaternion,
        scale=gaussians.scale,
        opacity=gaussians.opacity,
        colour=gaussians.colour(camera.centre(gaussians.mean), camera.side, camera.dim),
        camera=camera,
    )


@pytest.mark.parametrize("kind", KINDS)
def test_a_fused_render_is_the_reference_of_the_deformed_gaussians(kind: str) -> None:
    gaussians, deformation, camera = moving_gaussians(kind, 0 if kind == "shared with gloss" else 1)
    scene = _scene_of(deformation.deform(gaussians, 0.4), camera)
    kept = ~pixels_near_a_cut(scene)
    wanted = scene.to(torch.float64).render()
    red, green, blue, depth, alpha = CpuModel(gaussians, deformation, camera.width, camera.height).render(
        camera_vector(camera), 0.4
    )
    assert_close(np.stack([red, green, blue], axis=-1), wanted.rgb, where=kept, name="rgb")
    assert_close(depth, wanted.depth, where=kept, name="depth")
    assert_close(alpha, wanted.alpha, where=kept, name="alpha")


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_exports_what_it_was_made_of(kind: str) -> None:
    gaussians, deformation, camera = moving_gaussians(kind, 2)
    exported, motion = CpuModel(gaussians, deformation, camera.width, camera.height).export()
    assert motion.kind == deformation.kind
    given = gaussians.tensors() | deformation.parameters() | deformation.constants()
    for name, each in (exported.tensors() | motion.parameters() | motion.constants()).items():
        assert bool((each == given[name]).all()), name


@pytest.mark.parametrize("kind", KINDS)
def test_motion_takes_the_steps_of_torchs_adam(kind: str) -> None:
    gaussians, deformation, _ = moving_gaussians(kind, 0)
    count, columns = 90, padded(90)
    motion = motion_of(deformation, count, columns)
    leaves = {name: each.double().requires_grad_() for name, each in deformation.parameters().items()}
    constants = {name: each.double() for name, each in deformation.constants().items()}
    canonical = Gaussians(**{name: each.double() for name, each in gaussians.tensors().items()})
    optimiser = torch.optim.Adam(leaves.values(), lr=RATES.motion_mean, eps=RATES.eps)
    same = {f"motion_{channels}": RATES.motion_mean for channels in ("quaternion", "log_scale", "colour", "gloss")}
    rates = dataclasses.replace(RATES, **same)
    random = np.random.default_rng(6)
    for iteration, times in enumerate([[0.4], [0.45, 0.35], [0.35, 0.4, 0.45]], start=1):
        cotangents = random.normal(size=(len(times), ROWS, columns)).astype(np.float32)
        motion.update(cotangents, times, rates, iteration)
        optimiser.zero_grad()
        for cotangent, t in zip(cotangents, times, strict=True):
            moved = restore(deformation.kind, leaves | constants).deform(canonical, t)
            of_colour = (moved.sh[:, 0], moved.gloss[:, None])
            channels = torch.cat([moved.mean, moved.quaternion, moved.log_scale, *of_colour], dim=1)
            to_sum = channels * torch.from_numpy(cotangent[:, :count].T).double()
            to_sum.sum().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    for name, each in motion.export(count).parameters().items():
        assert_close(each, leaves[name], name=name)


def test_bases_that_are_negligible_are_left_out_of_deformation_and_training() -> None:
    shared = SharedBasis.initial(16, bases=9, colour=True)
    weight = torch.randn(shared.weight.shape, generator=torch.Generator().manual_seed(8))
    deformation = dataclasses.replace(shared, weight=weight)
    motion = LinearMotion(deformation, 16)
    state = np.empty((ROWS, 16), np.float32)
    motion.deform(np.zeros((ROWS, 16), np.float32), 0.26, state)
    bound = NEGLIGIBLE * float(weight.abs().sum(-1).max())
    assert_close(state[COLOUR_CHANNELS:], np.zeros((1, 16)))
    assert_close(state[:COLOUR_CHANNELS].T, weight @ deformation.basis(0.26), relative=0.0, absolute=bound)
    motion.update(np.ones((1, ROWS, 16), np.float32), [0.26], RATES, 1)
    changed = (motion.export(16).weight != weight).any(dim=0).any(dim=0)
    alive = deformation.basis(0.26) >= NEGLIGIBLE
    assert 0 < int(alive.sum()) < 9
    assert changed.tolist() == alive.tolist()


def test_beyond_six_widths_the_kernels_of_fdm_give_the_canonical_state() -> None:
    fdm = GaussianFdm.initial(16, bases=3, width=0.01)
    fdm = dataclasses.replace(fdm, weight=torch.ones_like(fdm.weight))
    canonical = np.random.default_rng(0).normal(size=(ROWS, 16)).astype(np.float32)
    state = np.full((ROWS, 16), np.nan, np.float32)
    FdmMotion(fdm, 16).deform(canonical, 0.25, state)  # 25 widths from the nearest centre
    assert bool((state == canonical).all())


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_that_took_some_of_its_gaussians_trains_on_as_they_did(kind: str) -> None:
    gaussians, deformation, camera = moving_gaussians(kind, 1)
    frame = random_frame(camera, np.zeros((camera.height, camera.width), bool))
    models = [CpuModel(gaussians, deformation, camera.width, camera.height) for _ in range(2)]
    order = np.random.default_rng(3).permutation(90)
    for iteration in (1, 2, 3):
        for model in models:
            model.step([frame.seen_from(camera, 0.4, model.rasterizer)], NORMALISED, RATES, iteration, 1)
        if iteration == 1:
            models[1].take(order, np.zeros(90, np.bool_))
    kept, permuted = ((exported.tensors(), motion.parameters()) for exported, motion in (m.export() for m in models))
    for given, taken in zip(kept, permuted, strict=True):
        for name, each in given.items():
            assert_close(taken[name], each[torch.from_numpy(order)], relative=1e-6, name=name)


def test_gaussians_taken_afresh_start_with_no_moments() -> None:
    gaussians, deformation, camera = moving_gaussians("shared with colour", 0)
    frame = random_frame(camera, np.zeros((camera.height, camera.width), bool))
    model = CpuModel(gaussians, deformation, camera.width, camera.height)
    model.step([frame.seen_from(camera, 0.4, model.rasterizer)], NORMALISED, RATES, 1)
    model.take(np.array([5, 5, 7]), np.array([False, True, True]))
    moments = [each for name, each in model.arrays().items() if name.startswith("moments.") or name[7:] == "first"]
    assert all(not each[..., 1:].any() for each in moments)
    assert model.arrays()["moments.canonical"][..., 0].any()
    assert model.count == 3
    assert len(model.export()[0]) == 3
