"""The CUDA backend's kernels beside the rasteriser: motion, harmonics and Adam, against torch and the CPU's kernels.

N Gaussians, F frames a step. Buffers hold NaN before anything is written to them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")

from intrasplat.splat.constants import SH_C0
from intrasplat.splat.cpu.motion import NEGLIGIBLE
from intrasplat.splat.cpu.motion import motion_of as cpu_motion_of
from intrasplat.splat.cuda import harmonics
from intrasplat.splat.cuda.control import Control, ControlField, adam_fields, write_adam
from intrasplat.splat.cuda.motion import LinearMotion, Motion, TrainedValues, motion_of
from intrasplat.splat.cuda.update import MADE, SEEN, SUMS, padded
from intrasplat.splat.deformation import GaussianFdm, SharedBasis, restore
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import COLOUR, COLOUR_CHANNELS, GLOSS, ROWS, VALUES
from intrasplat.splat.optimize import StepRates
from tests.helpers import assert_close
from tests.intrasplat.splat.test_cpu import KINDS, RATES, Fused, moving_gaussians

COUNT = 30
SIDES = (-0.5, 0.5)
"""What the frames' cameras see of the gloss."""
TIMES = (0.4, 0.55)
SAME_RATE = dataclasses.replace(
    RATES, motion_quaternion=7e-3, motion_log_scale=7e-3, motion_colour=7e-3, motion_gloss=7e-3
)
"""One rate for all motion, as FDM needs."""

RATED = [field.name for field in dataclasses.fields(RATES) if field.name not in ("eps", "beta1", "beta2")]


@dataclass
class MotionBench:
    """A motion on the device with all that its kernels read and write."""

    gaussians: Gaussians
    deformation: Fused
    motion: Motion
    control: Control
    trained: TrainedValues
    state: Tensor
    times: tuple[float, ...]

    def wait(self) -> None:
        """The row must not be written before it was sent."""
        if self.state.is_cuda:
            torch.cuda.synchronize()

    def deform(self) -> None:
        self.wait()
        self.motion.write_times(self.control.rows[0], self.times)
        self._see_gloss()
        self.control.send(0)
        self.motion.deform(self.trained.values, self.control.values, self.state, self.trained.colour)

    def update(self, rates: StepRates, iteration: int) -> None:
        """Adam with the gradients that lie in `trained`."""
        self.wait()
        self.motion.write_times(self.control.rows[0], self.times)
        self.motion.write_rates(self.control.rows[0], self.times, rates, iteration)
        write_adam(self.control.rows[0], 0, rates, iteration)
        self._see_gloss()
        self.control.send(0)
        self.motion.update(self.trained, self.control.values)

    def _see_gloss(self) -> None:
        self.control.rows[0]["shine"][:, 0] = SIDES[: len(self.times)]

    def draw_gradients(self, random: np.random.Generator) -> None:
        """Random ones, but none for the columns that only fill the rows."""
        for each in (self.trained.v_state, self.trained.v_opacity_logit, self.trained.v_colour):
            drawn = random.normal(size=each.shape).astype(np.float32)
            drawn[..., COUNT:] = 0.0
            each.copy_(torch.from_numpy(drawn))


def bench(kind: str, device: str, times: tuple[float, ...] = TIMES) -> MotionBench:
    gaussians, deformation = some_gaussians(kind, 0)
    columns, frames = padded(COUNT), len(times)
    motion = motion_of(deformation, columns, torch.device(device))
    control = Control(
        adam_fields() | {"shine": ControlField((frames, 2))} | motion.fields(frames), 1, torch.device(device)
    )
    values = torch.zeros(VALUES, columns, device=device)
    values[:, :COUNT] = torch.cat([canonical_rows(gaussians), gaussians.opacity_logit[None]]).to(device)

    def poisoned(*shape: int) -> Tensor:
        return torch.full(shape, float("nan"), device=device)

    trained = TrainedValues(
        values, torch.zeros(2, *values.shape, device=device),
        poisoned(frames, 10, columns), poisoned(frames, columns), poisoned(frames, 3, columns),
        poisoned(frames, 3, columns), control.values["shine"],
        torch.zeros(frames, columns, dtype=torch.int32, device=device),
        torch.rand(frames, 300, 4, generator=torch.Generator().manual_seed(1)).to(device),
        torch.ones(1, dtype=torch.int32, device=device), torch.zeros(SEEN + 1, dtype=torch.int32, device=device),
    )  # fmt: skip
    return MotionBench(gaussians, deformation, motion, control, trained, poisoned(frames, ROWS, columns), times)


def some_gaussians(kind: str, degree: int) -> tuple[Gaussians, Fused]:
    """The first COUNT of more."""
    gaussians, deformation, _ = moving_gaussians(kind, degree)
    fewer = Gaussians(**{name: each[:COUNT] for name, each in gaussians.tensors().items()})
    return fewer, deformation.select(torch.arange(COUNT))


def canonical_rows(gaussians: Gaussians) -> Tensor:
    """[ROWS, N]."""
    of_colour = (gaussians.sh[:, 0], gaussians.gloss[:, None])
    return torch.cat([gaussians.mean, gaussians.quaternion, gaussians.log_scale, *of_colour], 1).T


def exact(gaussians: Gaussians) -> Gaussians:
    return Gaussians(**{name: each.double() for name, each in gaussians.tensors().items()})


def differentiable(deformation: Fused) -> tuple[Fused, dict[str, Tensor]]:
    """In float64, and its leaves."""
    leaves = {name: each.double().requires_grad_() for name, each in deformation.parameters().items()}
    constants = {name: each.double() for name, each in deformation.constants().items()}
    return restore(deformation.kind, leaves | constants), leaves  # type: ignore[return-value]


@pytest.mark.parametrize("kind", KINDS)
def test_the_state_at_several_times_is_that_of_the_deformation(kind: str, device: str) -> None:
    made = bench(kind, device)
    made.deform()
    deformation, _ = differentiable(made.deformation)
    for frame, t in enumerate(TIMES):
        wanted = canonical_rows(deformation.deform(exact(made.gaussians), t)).detach()
        assert_close(made.state[frame, :, :COUNT], wanted, relative=1e-5, name="state")
        colour = torch.clamp(0.5 + SH_C0 * wanted[COLOUR] + SIDES[frame] * wanted[GLOSS], min=0.0)
        assert_close(made.trained.colour[frame, :, :COUNT], colour, relative=1e-5, name="colour")


@pytest.mark.parametrize("kind", KINDS)
def test_one_frame_moves_and_trains_as_on_the_cpu(kind: str, device: str) -> None:
    made, random = bench(kind, device, (0.4,)), np.random.default_rng(5)
    cpu = cpu_motion_of(made.deformation, COUNT, padded(COUNT))
    canonical = made.trained.values[:ROWS].cpu().numpy().copy()
    for iteration, t in enumerate((0.4, 0.52, 0.31), start=1):
        made.times = (t,)
        made.deform()
        state = np.empty_like(canonical)
        cpu.deform(canonical, t, state)
        assert_close(made.state[0], state, relative=1e-5, name="state")
        made.draw_gradients(random)
        v_shown = made.trained.v_colour[0] * (made.trained.colour[0] > 0)
        v_gloss = SIDES[0] * v_shown.sum(0, keepdim=True)
        v_state = torch.cat([made.trained.v_state[0], v_shown * SH_C0, v_gloss]).cpu().numpy()
        no_canonical = dataclasses.replace(SAME_RATE, mean=0, quaternion=0, log_scale=0, opacity=0, colour=0, gloss=0)
        made.update(no_canonical, iteration)
        cpu.update(v_state[None], (t,), SAME_RATE, iteration)
    assert bool((made.trained.values[:ROWS].cpu() == torch.from_numpy(canonical)).all())
    stored = made.motion.arrays(COUNT)
    for name, wanted in cpu.arrays(COUNT).items():
        assert_close(stored[name], wanted, relative=1e-5, absolute=1e-9, name=name)


@pytest.mark.parametrize("kind", KINDS)
def test_several_frames_take_the_step_of_torchs_adam_on_their_sum(kind: str, device: str) -> None:
    made, random = bench(kind, device), np.random.default_rng(6)
    deformation, leaves = differentiable(made.deformation)
    gaussians = {name: each.double().requires_grad_() for name, each in made.gaussians.tensors().items()}
    rates = {"mean": RATES.mean, "quaternion": RATES.quaternion, "log_scale": RATES.log_scale}
    rates |= {"opacity_logit": RATES.opacity, "sh": RATES.colour, "gloss": RATES.gloss}
    groups = [{"params": [gaussians[name]], "lr": rate} for name, rate in rates.items()]
    groups += [{"params": list(leaves.values()), "lr": SAME_RATE.motion_mean}]
    optimiser = torch.optim.Adam(groups, eps=RATES.eps)
    for iteration, times in enumerate([(0.4, 0.55), (0.45, 0.4), (0.35, 0.5)], start=1):
        made.times = times
        made.deform()
        made.draw_gradients(random)
        loss = torch.zeros((), dtype=torch.float64)
        for frame, t in enumerate(times):
            moved = deformation.deform(Gaussians(**gaussians), t)
            colour = moved.colour(torch.zeros(3), SIDES[frame])
            v_state, v_colour = made.trained.v_state[frame].cpu(), made.trained.v_colour[frame].cpu()
            loss = loss + (canonical_rows(moved)[:10] * v_state[:10, :COUNT]).sum()
            loss = loss + (colour.T * v_colour[:, :COUNT]).sum()
            loss = loss + (gaussians["opacity_logit"] * made.trained.v_opacity_logit[frame, :COUNT].cpu()).sum()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        made.update(SAME_RATE, iteration)
    wanted = canonical_rows(Gaussians(**gaussians)).detach()
    assert_close(made.trained.values[:ROWS, :COUNT], wanted, relative=1e-5, name="canonical")
    assert_close(made.trained.values[ROWS, :COUNT], gaussians["opacity_logit"].detach(), relative=1e-5)
    for name, each in made.motion.export(COUNT).parameters().items():
        assert_close(each, leaves[name].detach(), relative=1e-5, name=name)


def test_bases_negligible_in_every_frame_are_neither_evaluated_nor_trained(device: str) -> None:
    shared = SharedBasis.initial(16, bases=9, colour=True)
    weight = torch.randn(shared.weight.shape, generator=torch.Generator().manual_seed(8))
    motion = LinearMotion(dataclasses.replace(shared, weight=weight), padded(16), torch.device(device))
    times = (0.12, 0.26)
    row = {name: np.zeros(field.shape, np.int64) for name, field in motion.fields(2).items()}
    motion.write_rates(row, times, RATES, 1)
    alive = [np.flatnonzero(shared.basis(t).numpy() >= NEGLIGIBLE) for t in times]
    union = sorted({*alive[0], *alive[1]})
    assert len(alive[0]) < len(union) < 9
    assert row["alive"][: 1 + len(union)].tolist() == [len(union), *union]
    assert np.flatnonzero(motion.steps.numpy()).tolist() == union


@pytest.mark.parametrize("kind", ["shared with colour", "fdm-gaussian"])
def test_a_rate_of_nothing_and_a_step_that_must_not_be_made_change_no_bit(kind: str, device: str) -> None:
    made = bench(kind, device)
    made.deform()
    made.draw_gradients(np.random.default_rng(7))

    def everything() -> list[Tensor]:
        motion = {name: each for name, each in made.motion.arrays(COUNT).items() if name != "motion.steps"}
        return [each.clone() for each in (*made.trained.tensors()[:2], *motion.values())]

    before = everything()
    made.trained.ok.fill_(0)
    made.update(RATES, 1)
    assert not made.trained.report.any()
    made.trained.ok.fill_(1)
    made.update(dataclasses.replace(RATES, **dict.fromkeys(RATED, 0.0)), 1)
    assert made.trained.report[MADE] == 1
    assert all(bool((now == then).all()) for now, then in zip(everything(), before, strict=True))


@pytest.mark.parametrize("kind", ["shared with colour", "fdm-gaussian"])
def test_every_row_has_its_own_rate(kind: str, device: str) -> None:
    made = bench(kind, device)
    made.deform()
    made.draw_gradients(np.random.default_rng(7))
    still = [name for name in RATED if name not in ("mean", "motion_mean")]
    made.update(dataclasses.replace(RATES, **dict.fromkeys(still, 0.0)), 1)
    changed = (made.trained.moments[0] != 0).any(1).tolist()
    assert changed == [True] * 3 + [False] * (VALUES - 3)
    if kind == "shared with colour":
        assert (made.motion.arrays(COUNT)["motion.first"] != 0).any(2).any(0).tolist() == changed[:COLOUR_CHANNELS]


def test_beyond_six_widths_fdm_gives_the_canonical_state(device: str) -> None:
    made = bench("fdm-gaussian", device)
    fdm = GaussianFdm.initial(COUNT, bases=3, width=0.01)
    fdm = dataclasses.replace(fdm, weight=torch.ones_like(fdm.weight))
    made.motion, made.times = motion_of(fdm, padded(COUNT), torch.device(device)), (0.25, 0.75)  # 25 widths away
    made.deform()
    assert bool((made.state == made.trained.values[:ROWS]).all())


def sh_scene(degree: int) -> tuple[Gaussians, Tensor]:
    """Gaussians around the cameras' centres [F, 3]."""
    random = torch.Generator().manual_seed(9)
    gaussians, _ = some_gaussians("shared", degree)
    sh = 0.4 * torch.randn(gaussians.sh.shape, generator=random)
    return dataclasses.replace(gaussians, sh=sh), 20.0 * torch.randn(2, 3, generator=random)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_and_their_step_are_those_of_torch(degree: int, device: str) -> None:
    gaussians, centre = sh_scene(degree)
    columns, terms = padded(COUNT), (degree + 1) ** 2
    state = torch.zeros(2, ROWS, columns)
    state[:, :, :COUNT] = canonical_rows(gaussians)
    rest = torch.zeros(terms - 1, 3, columns)
    rest[:, :, :COUNT] = gaussians.sh[:, 1:].permute(1, 2, 0)
    state, rest, centre = state.to(device), rest.to(device), centre.to(device)
    colour = torch.full((2, 3, columns), float("nan"), device=device)
    harmonics.evaluate(rest, state, centre, colour, degree)

    sh, mean = gaussians.sh.double().requires_grad_(), gaussians.mean.double().requires_grad_()
    moved = dataclasses.replace(exact(gaussians), sh=sh, mean=mean)
    wanted = torch.stack([moved.colour(each).T for each in centre.cpu().double()])
    assert_close(colour[..., :COUNT], wanted.detach(), relative=1e-5, name="colour")
    assert bool((wanted == 0).any())
    assert bool((wanted > 0).any())

    cotangent = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(10))
    v_colour = torch.zeros_like(colour)
    v_colour[..., :COUNT] = cotangent.to(device)
    v_state = torch.ones(2, 10, columns, device=device)
    control = Control(adam_fields(), 1, torch.device(device))
    write_adam(control.rows[0], 0, RATES, 1)
    control.send(0)
    moments, ok = torch.zeros(2, *rest.shape, device=device), torch.ones(1, dtype=torch.int32, device=device)
    harmonics.evaluate_backward(rest, state, centre, colour, v_colour, v_state, degree)
    harmonics.update(rest, moments, state, centre, colour, v_colour, ok, control.values, degree)

    (wanted * cotangent.double()).sum().backward()  # type: ignore[no-untyped-call]
    assert sh.grad is not None
    assert mean.grad is not None
    assert_close(v_state.sum(0)[:3, :COUNT] - 2.0, mean.grad.T, relative=1e-5, name="mean")
    assert bool((v_state[:, 3:10] == 1.0).all())
    assert_close(10 * moments[0, ..., :COUNT], sh.grad[:, 1:].permute(1, 2, 0), relative=1e-5, name="sh_rest")
    moved_by = rest[..., :COUNT].cpu() - gaussians.sh[:, 1:].permute(1, 2, 0)
    assert_close(moved_by, -RATES.sh_rest * torch.sign(sh.grad[:, 1:]).permute(1, 2, 0), relative=1e-3)


def test_a_step_reports_its_sums_and_how_many_gaussians_were_in_view(device: str) -> None:
    made = bench("shared", device)
    made.deform()
    made.draw_gradients(np.random.default_rng(7))
    made.trained.touched[0, 3:20] = 2
    made.trained.touched[1, 18:31] = 1
    for iteration in (1, 2):
        made.update(RATES, iteration)
    report = made.trained.report.cpu()
    assert report[MADE:].tolist() == [2, 2 * 28]  # both steps used one place
    wanted = 2 * made.trained.statistics.double().sum((0, 1))
    assert_close(report[:SUMS].view(torch.float32), wanted, relative=1e-6)
