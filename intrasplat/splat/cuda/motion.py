"""The motion on the device, with Adam's moments. Two kinds: linear in bases that all Gaussians share, and FDM.

N Gaussians (padded), F frames per step, B bases, C channels (10, or 13 where colour moves too); rows of N floats.
Which bases are in use at a time, and their step counts, are as in intrasplat/splat/cpu/motion.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from intrasplat.splat.cpu.motion import NEGLIGIBLE
from intrasplat.splat.cuda import motion_kernels as kernels
from intrasplat.splat.cuda.control import ADAM, ControlField
from intrasplat.splat.cuda.update import COLUMNS
from intrasplat.splat.deformation import Deformation, FlexibleDeformation, LinearDeformation
from intrasplat.splat.layout import COLOUR, GLOSS, LOG_SCALE, MEAN, QUATERNION, ROWS
from intrasplat.splat.optimize import StepRates, adam_step


@dataclass(frozen=True)
class TrainedValues:
    """The tensors that a step's last kernel changes beside the motion, and the gradients it reads (see update.py)."""

    values: Tensor
    moments: Tensor
    v_state: Tensor
    v_opacity_logit: Tensor
    v_colour: Tensor
    colour: Tensor
    shine: Tensor
    touched: Tensor
    statistics: Tensor
    ok: Tensor
    report: Tensor

    @property
    def frames(self) -> int:
        """F."""
        return self.v_state.shape[0]

    @property
    def columns(self) -> int:
        """N, padded."""
        return self.values.shape[1]

    @property
    def tiles(self) -> int:
        """The number of tiles of all frames."""
        return self.statistics[..., 0].numel()

    def tensors(self) -> tuple[Tensor, ...]:
        """The tensors in the order of the kernels' arguments; those of the motion come after the second."""
        return tuple(getattr(self, field.name) for field in dataclasses.fields(self))


class Motion(Protocol):
    """A deformation the step can evaluate and train; `control` is the block's fields on the device (control.py)."""

    def fields(self, frames: int) -> dict[str, ControlField]:
        """The fields that it needs in the control block."""

    def write_times(self, row: Mapping[str, np.ndarray], times: Sequence[float]) -> None:
        """Fill the fields that deform reads."""

    def write_rates(self, row: Mapping[str, np.ndarray], times: Sequence[float], rates: StepRates, step: int) -> None:
        """Fill the other fields that update reads, and count the step. step: counted from 1."""

    def deform(self, values: Tensor, control: Mapping[str, Tensor], state: Tensor, colour: Tensor) -> None:
        """state [F, ROWS, N] = values [VALUES, N] + psi(t) at the times, colour [F, 3, N] without other harmonics."""

    def update(self, trained: TrainedValues, control: Mapping[str, Tensor]) -> None:
        """One Adam step of the values and of the weights that reach the times, and its report."""

    def take(self, columns: Tensor, fresh: Tensor) -> None:
        """Keep these columns, in this order; moments start at 0 where fresh."""

    def parameters(self, count: int) -> dict[str, Tensor]:
        """The trained tensors of the first count Gaussians, by name; views."""

    def arrays(self, count: int) -> dict[str, Tensor]:
        """All tensors that must be stored to resume, likewise. motion.steps lies on the host."""

    def export(self, count: int) -> Deformation:
        """The first count Gaussians' deformation as tensors on the CPU (copies)."""


MAX_CACHED_TIMES = 4096
"""Bases are cached for so many times: more than a clip has frames, but bounded for a scene rendered for days."""


def take_moments(moments: Tensor, columns: Tensor, fresh: Tensor) -> Tensor:
    """These columns of Adam's moments, 0 where fresh."""
    return moments.index_select(-1, columns).masked_fill_(fresh, 0.0)


def _grid(columns: int, *frames: int) -> tuple[int, ...]:
    return (columns // COLUMNS, *frames)


class Moments:
    """Adam's two moments of a motion's weights, [2, ...], allocated at first use: a render does not need them."""

    def __init__(self, shape: tuple[int, ...], device: torch.device) -> None:
        self._shape, self._device = shape, device
        self._tensor: Tensor | None = None

    @property
    def both(self) -> tuple[Tensor, Tensor]:
        """The first and the second; zeros at first."""
        if self._tensor is None:
            self._tensor = torch.zeros(2, *self._shape, device=self._device)
        return self._tensor[0], self._tensor[1]

    def arrays(self, count: int) -> dict[str, Tensor]:
        """Both moments of the first count Gaussians, by name; views."""
        first, second = self.both
        return {"motion.first": first[..., :count], "motion.second": second[..., :count]}

    def take(self, columns: Tensor, fresh: Tensor) -> None:
        """Keep these columns, 0 where fresh."""
        self._shape = (*self._shape[:-1], len(columns))
        if self._tensor is not None:
            self._tensor = take_moments(self._tensor, columns, fresh)


class LinearMotion:
    """Bases of t that all Gaussians share. A step reads and writes only the weights of bases alive at its times.

    Adam's moments of a weight advance only in those steps, and each basis counts its own.
    """

    def __init__(self, deformation: LinearDeformation, columns: int, device: torch.device) -> None:
        count, self._channels, self._bases = deformation.weight.shape
        # used for its bases; it has no weights, because a view would keep them in memory
        self._form = dataclasses.replace(deformation, weight=torch.zeros(0, self._channels, self._bases))
        self.weight = torch.zeros(self._bases, self._channels, columns, device=device)
        self.weight[:, :, :count] = deformation.weight.permute(2, 1, 0).to(device)
        self._moments = Moments(tuple(self.weight.shape), device)
        self.steps = torch.zeros(self._bases, dtype=torch.int64)
        self._counts = self.steps.numpy()  # the same memory
        self._found: dict[float, tuple[np.ndarray, int, int]] = {}

    def _alive(self, t: float) -> tuple[np.ndarray, int, int]:
        """The bases' values at t, 0 for those not in use; the first in use, and the one after the last."""
        if t not in self._found:
            if len(self._found) == MAX_CACHED_TIMES:
                self._found.clear()
            values = self._form.basis(t).numpy()
            alive = np.flatnonzero(np.abs(values) >= NEGLIGIBLE)
            first, last = (int(alive[0]), int(alive[-1]) + 1) if alive.size else (0, 0)
            values[:first], values[last:] = 0.0, 0.0
            self._found[t] = values, first, last
        return self._found[t]

    def fields(self, frames: int) -> dict[str, ControlField]:
        bases = self._bases
        return {
            "basis": ControlField((frames, bases)),
            "span": ControlField((frames, 2), "int"),
            "alive": ControlField((1 + bases,), "int"),
            "basis_size": ControlField((bases,)),
            "basis_floor": ControlField((bases,)),
            "channel_rate": ControlField((ROWS,)),
        }

    def write_times(self, row: Mapping[str, np.ndarray], times: Sequence[float]) -> None:
        for frame, t in enumerate(times):
            row["basis"][frame], *row["span"][frame] = self._alive(t)

    def write_rates(self, row: Mapping[str, np.ndarray], times: Sequence[float], rates: StepRates, step: int) -> None:
        spans = [range(*self._alive(t)[1:]) for t in times]
        alive = sorted(set().union(*spans))
        row["alive"][0], row["alive"][1 : 1 + len(alive)] = len(alive), alive
        self._counts[alive] += 1
        for j in alive:
            adam = adam_step(1.0, rates, int(self._counts[j]))
            row["basis_size"][j], row["basis_floor"][j] = adam.size, adam.floor
        channel_rate = row["channel_rate"]
        channel_rate[MEAN], channel_rate[QUATERNION] = rates.motion_mean, rates.motion_quaternion
        channel_rate[LOG_SCALE], channel_rate[COLOUR] = rates.motion_log_scale, rates.motion_colour
        channel_rate[GLOSS] = rates.motion_gloss

    def deform(self, values: Tensor, control: Mapping[str, Tensor], state: Tensor, colour: Tensor) -> None:
        frames, _, columns = state.shape
        kernels.deform_linear[_grid(columns, frames)](
            values, self.weight, control["basis"], control["span"], state, colour, control["shine"], columns,
            self._bases, CHANNELS=self._channels,
        )  # fmt: skip

    def update(self, trained: TrainedValues, control: Mapping[str, Tensor]) -> None:
        tensors = trained.tensors()
        kernels.update_linear[_grid(trained.columns)](
            *tensors[:2], self.weight, *self._moments.both, *tensors[2:], *(control[name] for name in ADAM),
            *(control[name] for name in ("basis", "alive", "basis_size", "basis_floor", "channel_rate")),
            trained.columns, self._bases, trained.tiles, CHANNELS=self._channels, FRAMES=trained.frames,
        )  # fmt: skip

    def take(self, columns: Tensor, fresh: Tensor) -> None:
        self.weight = self.weight.index_select(-1, columns)
        self._moments.take(columns, fresh)

    def parameters(self, count: int) -> dict[str, Tensor]:
        return {"motion.weight": self.weight[..., :count]}

    def arrays(self, count: int) -> dict[str, Tensor]:
        return self.parameters(count) | self._moments.arrays(count) | {"motion.steps": self.steps}

    def export(self, count: int) -> LinearDeformation:
        weight = _host_copy(self.weight[:, :, :count].permute(2, 1, 0))
        return dataclasses.replace(self._form, weight=weight)


class FdmMotion:
    """The paper's FDM: weight, centre and width of every basis learnable per Gaussian and channel; dense Adam."""

    def __init__(self, deformation: FlexibleDeformation, columns: int, device: torch.device) -> None:
        self._form = type(deformation)
        self.weight, self.centre, self.width = (
            _columns_last(tensor, columns, fill, device)
            for tensor, fill in ((deformation.weight, 0.0), (deformation.centre, 0.5), (deformation.width, 1.0))
        )
        self._moments = Moments((3, *self.weight.shape), device)

    def fields(self, frames: int) -> dict[str, ControlField]:
        return {"time": ControlField((frames,)), "motion_size": ControlField((1,))}

    def write_times(self, row: Mapping[str, np.ndarray], times: Sequence[float]) -> None:
        row["time"][:] = times

    def write_rates(self, row: Mapping[str, np.ndarray], times: Sequence[float], rates: StepRates, step: int) -> None:
        row["motion_size"][0] = adam_step(rates.motion_mean, rates, step).size

    def deform(self, values: Tensor, control: Mapping[str, Tensor], state: Tensor, colour: Tensor) -> None:
        frames, _, columns = state.shape
        kernels.deform_fdm[_grid(columns, frames)](
            values, self.weight, self.centre, self.width, control["time"], state, colour, control["shine"],
            columns, self.weight.shape[1], QUARTIC=self._form.quartic,
        )  # fmt: skip

    def update(self, trained: TrainedValues, control: Mapping[str, Tensor]) -> None:
        tensors = trained.tensors()
        kernels.update_fdm[_grid(trained.columns)](
            *tensors[:2], self.weight, self.centre, self.width, *self._moments.both, *tensors[2:],
            *(control[name] for name in ADAM), control["time"], control["motion_size"],
            trained.columns, self.weight.shape[1], trained.tiles,
            QUARTIC=self._form.quartic, FRAMES=trained.frames,
        )  # fmt: skip

    def take(self, columns: Tensor, fresh: Tensor) -> None:
        for name in ("weight", "centre", "width"):
            setattr(self, name, getattr(self, name).index_select(-1, columns))
        self._moments.take(columns, fresh)

    def parameters(self, count: int) -> dict[str, Tensor]:
        return {f"motion.{name}": getattr(self, name)[..., :count] for name in ("weight", "centre", "width")}

    def arrays(self, count: int) -> dict[str, Tensor]:
        return self.parameters(count) | self._moments.arrays(count)

    def export(self, count: int) -> FlexibleDeformation:
        weight, centre, width = (
            _host_copy(each[..., :count].permute(2, 0, 1)) for each in (self.weight, self.centre, self.width)
        )
        return self._form(weight, centre, width)


def _host_copy(tensor: Tensor) -> Tensor:
    return tensor.cpu().clone(memory_format=torch.contiguous_format)


def _columns_last(tensor: Tensor, columns: int, fill: float, device: torch.device) -> Tensor:
    """[N, 10, B] tensor as [10, B, columns] rows."""
    rows = torch.full((*tensor.shape[1:], columns), fill, device=device)
    rows[..., : tensor.shape[0]] = tensor.permute(1, 2, 0).to(device)
    return rows


def motion_of(deformation: Deformation, columns: int, device: torch.device) -> LinearMotion | FdmMotion:
    """The trainable form of a deformation, padded to columns Gaussians; ValueError if it has none."""
    if isinstance(deformation, FlexibleDeformation):
        return FdmMotion(deformation, columns, device)
    if isinstance(deformation, LinearDeformation):
        return LinearMotion(deformation, columns, device)
    raise ValueError(f"deformation {deformation.kind!r} has no kernels: it trains on the CPU")
