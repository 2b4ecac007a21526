"""A deformation in the form that a training step uses, with Adam's moments: linear, FDM, or by autograd (unfused.py).

N Gaussians (padded), F frames per step, B bases, C channels (10, 13 or 14), rows of N floats.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from intrasplat.splat.cpu import update
from intrasplat.splat.cpu.rasterizer import Floats
from intrasplat.splat.cpu.threads import flushing, run
from intrasplat.splat.cpu.unfused import AutogradMotion
from intrasplat.splat.deformation import Deformation, FlexibleDeformation, LinearDeformation
from intrasplat.splat.optimize import StepRates, adam_step

NEGLIGIBLE = 1e-3
"""A shared basis below this at t is neither evaluated nor trained in that step."""


class Motion(Protocol):
    """A deformation that a step can evaluate and train."""

    def deform(self, canonical: Floats, t: float, state: Floats, *, trains: bool = False) -> None:
        """state [ROWS, N] = canonical + psi(t). trains: whether update() follows."""

    def update(self, v_state: Floats, times: Sequence[float], rates: StepRates, iteration: int) -> None:
        """One Adam step, iteration counted from 1, given dL/dstate [F, ROWS, N] at the F times of the last deforms.

        Replaces v_state by dL/dcanonical, frame by frame. A motion may train only the weights in use at these times.
        """

    def take(self, columns: np.ndarray, fresh: np.ndarray) -> None:
        """Keep these columns, in this order; moments start at 0 where fresh."""

    def parameters(self, count: int) -> dict[str, Tensor]:
        """The trained tensors of the first count Gaussians, by name; views."""

    def arrays(self, count: int) -> dict[str, Tensor]:
        """All tensors that must be stored to resume, of the first count Gaussians, by name; views."""

    def export(self, count: int, *, as_it_lies: bool = False) -> Deformation:
        """The first count Gaussians' deformation as torch tensors (copies); as_it_lies as in Model.export."""


def take_moments(moments: Floats, columns: np.ndarray, fresh: np.ndarray) -> Floats:
    """These columns of Adam's moments, 0 where fresh. Contiguous by rows, which indexing alone is not."""
    if fresh.all():  # zeros that are never written take no memory
        return np.zeros((*moments.shape[:-1], len(columns)), np.float32)
    kept = np.take(moments, columns, axis=-1)
    kept[..., fresh] = 0
    return kept


def _channel_rates(rates: StepRates) -> Floats:
    groups = [
        rates.motion_mean,
        rates.motion_quaternion,
        rates.motion_log_scale,
        rates.motion_colour,
        rates.motion_gloss,
    ]
    return np.repeat(np.array(groups, np.float32), [3, 4, 3, 3, 1])


class LinearMotion:
    """Bases of t that all Gaussians share. A step reads and writes only the weights of bases alive at its times.

    Adam's moments of a weight advance only in those steps, and each basis counts its own.
    """

    def __init__(self, deformation: LinearDeformation, columns: int) -> None:
        count, channels, bases = deformation.weight.shape
        # used for its bases; it has no weights
        self._form = dataclasses.replace(deformation, weight=torch.zeros(0, channels, bases))
        self.weight = np.zeros((bases, channels, columns), np.float32)
        self.weight[:, :, :count] = deformation.weight.permute(2, 1, 0).numpy()
        # zeros, not zeros_like: in a model that is only rendered these are never written, so they take no memory
        self.first, self.second = (np.zeros(self.weight.shape, np.float32) for _ in range(2))
        self.steps = np.zeros(bases, np.int64)

    def _alive(self, t: float) -> tuple[Floats, int, int]:
        values = self._form.basis(t).numpy()
        alive = np.flatnonzero(np.abs(values) >= NEGLIGIBLE)
        return (values, int(alive[0]), int(alive[-1]) + 1) if alive.size else (values, 0, 0)

    def deform(self, canonical: Floats, t: float, state: Floats, *, trains: bool = False) -> None:
        values, first, last = self._alive(t)
        run(update.deform_shared, canonical, self.weight, values, first, last, state)

    def update(self, v_state: Floats, times: Sequence[float], rates: StepRates, iteration: int) -> None:
        channel_rates = _channel_rates(rates)
        bases, channels, _ = self.weight.shape
        values, reached = np.zeros((len(times), bases), np.float32), np.zeros(bases, np.bool_)
        for frame, t in enumerate(times):
            at_t, first, last = self._alive(t)
            values[frame, first:last], reached[first:last] = at_t[first:last], True
        alive = np.flatnonzero(reached)
        self.steps[alive] += 1
        rate, eps = np.zeros((2, bases, channels), np.float32)
        for j in alive:
            adam = adam_step(1.0, rates, int(self.steps[j]))
            rate[j], eps[j] = channel_rates[:channels] * adam.size, adam.floor
        run(
            flushing(update.update_shared), self.weight, self.first, self.second, v_state, values, alive, rate, eps,
            np.float32(rates.beta1), np.float32(rates.beta2),
        )  # fmt: skip

    def take(self, columns: np.ndarray, fresh: np.ndarray) -> None:
        # one after the other, so that old and new arrays are in memory for one of the three at a time
        self.first = take_moments(self.first, columns, fresh)
        self.second = take_moments(self.second, columns, fresh)
        self.weight = np.take(self.weight, columns, axis=-1)

    def parameters(self, count: int) -> dict[str, Tensor]:
        return _views(self, ("weight",), count)

    def arrays(self, count: int) -> dict[str, Tensor]:
        return _views(self, ("weight", "first", "second"), count) | {"motion.steps": torch.from_numpy(self.steps)}

    def export(self, count: int, *, as_it_lies: bool = False) -> LinearDeformation:
        weight = _copied(self.weight[:, :, :count], (2, 1, 0), as_it_lies=as_it_lies)
        return dataclasses.replace(self._form, weight=weight)


class FdmMotion:
    """The paper's FDM: weight, centre and width of every basis learnable per Gaussian and channel; dense Adam."""

    def __init__(self, deformation: FlexibleDeformation, columns: int) -> None:
        self._form = type(deformation)
        self.weight, self.centre, self.width = (
            _columns_last(tensor, columns, fill)
            for tensor, fill in ((deformation.weight, 0.0), (deformation.centre, 0.5), (deformation.width, 1.0))
        )
        self.first = np.zeros((3, *self.weight.shape), np.float32)
        self.second = np.zeros(self.first.shape, np.float32)

    def deform(self, canonical: Floats, t: float, state: Floats, *, trains: bool = False) -> None:
        run(
            update.deform_fdm, canonical, self.weight, self.centre, self.width, np.float32(t), self._form.quartic, state
        )  # fmt: skip

    def update(self, v_state: Floats, times: Sequence[float], rates: StepRates, iteration: int) -> None:
        adam = adam_step(rates.motion_mean, rates, iteration)
        run(
            flushing(update.update_fdm), self.weight, self.centre, self.width, self.first, self.second, v_state,
            np.array(times, np.float32), self._form.quartic, *map(np.float32, dataclasses.astuple(adam)),
        )  # fmt: skip

    def take(self, columns: np.ndarray, fresh: np.ndarray) -> None:
        for name in ("weight", "centre", "width"):
            setattr(self, name, np.take(getattr(self, name), columns, axis=-1))
        self.first = take_moments(self.first, columns, fresh)
        self.second = take_moments(self.second, columns, fresh)

    def parameters(self, count: int) -> dict[str, Tensor]:
        return _views(self, ("weight", "centre", "width"), count)

    def arrays(self, count: int) -> dict[str, Tensor]:
        return _views(self, ("weight", "centre", "width", "first", "second"), count)

    def export(self, count: int, *, as_it_lies: bool = False) -> FlexibleDeformation:
        weight, centre, width = (
            _copied(each[..., :count], (2, 0, 1), as_it_lies=as_it_lies)
            for each in (self.weight, self.centre, self.width)
        )
        return self._form(weight, centre, width)


def _views(motion: LinearMotion | FdmMotion, names: Sequence[str], count: int) -> dict[str, Tensor]:
    """Arrays of a motion by name, without the padding columns."""
    return {f"motion.{name}": torch.from_numpy(getattr(motion, name))[..., :count] for name in names}


def _copied(values: Floats, axes: tuple[int, int, int], *, as_it_lies: bool) -> Tensor:
    """A copy with its axes permuted: contiguous, or with as_it_lies a view of a plain copy, which is faster."""
    if as_it_lies:
        return torch.from_numpy(values.copy()).permute(axes)
    return torch.from_numpy(np.ascontiguousarray(values.transpose(axes)))


def _columns_last(tensor: torch.Tensor, columns: int, fill: float) -> Floats:
    """[N, 10, B] tensor as [10, B, columns] rows."""
    rows = np.full((*tensor.shape[1:], columns), fill, np.float32)
    rows[..., : tensor.shape[0]] = tensor.permute(1, 2, 0).numpy()
    return rows


def motion_of(deformation: Deformation, count: int, columns: int) -> Motion:
    """The trainable form of the deformation of count Gaussians, padded to columns."""
    if isinstance(deformation, FlexibleDeformation):
        return FdmMotion(deformation, columns)
    if isinstance(deformation, LinearDeformation):
        return LinearMotion(deformation, columns)
    return AutogradMotion(deformation, count, columns)
