"""Training with a deformation that has no kernels of its own (`hexplane`): torch moves the Gaussians, autograd answers.

The blend, its loss and the canonical parameters' Adam are those of the fused step, so that two deformations compared
with each other differ in nothing else. Only the time a step takes is not comparable: tables of speed must say so.

Symbols: N Gaussians (padded to whole vectors), rows of N floats, F frames a step; canonical and state [13, N] as in
raster/cpu/update.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from contract.wire.errors import TrainingDiverged
from worker.model.deformation import LOG_SCALE, MEAN, QUATERNION, Deformation, restore
from worker.model.gaussians import Gaussians
from worker.model.optimize import AdamStep, StepRates, adam_step
from worker.raster.cpu.model import FusedModel
from worker.raster.cpu.motion import Motion
from worker.raster.cpu.rasterizer import Floats

COLOUR = slice(10, 13)
"""Rows of the constant harmonic."""


class UnfusedModel(FusedModel):
    """A model of any deformation, with the surface of FusedModel."""

    def _motion_of(self, deformation: Deformation, columns: int) -> Motion:
        return AutogradMotion(deformation, self.count, columns)

    def render(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> Floats:
        """R G B Z A, [5, H, W]; with values [N], blended as colour is, [6, H, W]. A view the next render overwrites."""
        with torch.no_grad():  # no step follows: keep no graph
            return super().render(camera, t, values)

    def image_gradient(self, camera: NDArray[np.float64], t: float, cotangents: Floats) -> Floats:
        """Gradient of sum(cotangents * render(camera, t)) to the Gaussians as they are at t, [14, N]."""
        with torch.no_grad():
            return super().image_gradient(camera, t, cotangents)

    def deformed_mean(self, t: float) -> Floats:
        """Centres at time t, [3, N] in units, as a copy."""
        with torch.no_grad():
            return super().deformed_mean(t)


class AutogradMotion:
    """Any deformation as a Motion: its offsets by torch, its gradients by autograd, dense Adam on all its parameters.

    Every parameter has the rate motion_mean: a network's weights belong to no kind of channel.
    """

    def __init__(self, deformation: Deformation, count: int, columns: int) -> None:
        padding = torch.zeros(columns - count, dtype=torch.int64)  # whose motion it is does not matter: never drawn
        self._adopt(deformation.select(torch.cat([torch.arange(count), padding])))
        self._moments = {name: torch.zeros(2, *each.shape) for name, each in self._parameters.items()}
        self._graphs: list[tuple[Tensor, Tensor]] = []  # a step's canonical states, and what became of each

    def _adopt(self, deformation: Deformation) -> None:
        """Train copies of this deformation's parameters from here on."""
        self._parameters = {name: each.detach().clone() for name, each in deformation.parameters().items()}
        for each in self._parameters.values():
            each.requires_grad_()
        self._deformation = restore(deformation.kind, self._parameters | deformation.constants())

    def deform(self, canonical: Floats, t: float, state: Floats) -> None:
        """state = canonical + offsets at t; keeps the graph for update unless gradients are switched off.

        Raises:
            TrainingDiverged: a mean is not finite. Torch would look it up outside the planes' memory and crash.
        """
        if not np.isfinite(canonical[MEAN]).all():
            raise TrainingDiverged("A Gaussian's place is no longer a number.")
        rows = torch.from_numpy(canonical.T.copy()).requires_grad_()
        moved = _deformed(self._deformation, rows, t)
        if torch.is_grad_enabled():
            self._graphs.append((rows, moved))
        state[:] = moved.detach().T.numpy()

    def update(self, v_state: Floats, times: Sequence[float], rates: StepRates, iteration: int) -> None:
        """One Adam step, given dL/dstate [F, 13, N] at the times deformed to since the last; turns it into
        dL/dcanonical.

        The two differ where offsets depend on the canonical state: a field of offsets is sampled at the mean.
        """
        starts, moved = zip(*self._graphs, strict=True)
        self._graphs.clear()
        cotangents = [torch.from_numpy(each.T.copy()) for each in v_state]
        found = torch.autograd.grad(moved, [*starts, *self._parameters.values()], cotangents)
        of_starts, gradients = found[: len(starts)], found[len(starts) :]
        for each, v_canonical in zip(v_state, of_starts, strict=True):
            each[:] = v_canonical.T.numpy()
        if rates.motion_mean == 0.0:
            return
        adam = adam_step(rates.motion_mean, rates, iteration)
        for name, gradient in zip(self._parameters, gradients, strict=True):
            _adam(self._parameters[name].detach(), gradient, self._moments[name], adam)

    def take(self, columns: np.ndarray, fresh: np.ndarray) -> None:
        """Keep these columns, in this order; moments start at 0 where fresh. Shared parameters keep theirs."""
        rows = torch.from_numpy(columns)
        self._adopt(self._deformation.select(rows))
        if self._deformation.floats_per_gaussian == 0:
            return
        for name, moments in self._moments.items():
            taken = moments[:, rows]
            taken[:, torch.from_numpy(fresh)] = 0.0
            self._moments[name] = taken

    def parameters(self, count: int) -> dict[str, Tensor]:
        """What is trained, by name; views. The Gaussians that only fill the last vector are among them, if any are."""
        return {f"motion.{name}": each.detach() for name, each in self._parameters.items()}

    def arrays(self, count: int) -> dict[str, Tensor]:
        """Parameters and moments by name; views."""
        return self.parameters(count) | {f"motion.moments.{name}": each for name, each in self._moments.items()}

    def export(self, count: int) -> Deformation:
        """The first count Gaussians' deformation as torch tensors (copies)."""
        copies = {name: each.detach().clone() for name, each in self._parameters.items()}
        deformation = restore(self._deformation.kind, copies | self._deformation.constants())
        return deformation.select(torch.arange(count))


def _deformed(deformation: Deformation, canonical: Tensor, t: float) -> Tensor:
    """Canonical rows [N, 13] at time t. Opacity and the other harmonics do not move and are not asked for."""
    gaussians = Gaussians(
        mean=canonical[:, MEAN],
        quaternion=canonical[:, QUATERNION],
        log_scale=canonical[:, LOG_SCALE],
        opacity_logit=canonical.new_zeros(len(canonical)),
        sh=canonical[:, None, COLOUR],
    )
    moved = deformation.deform(gaussians, t)
    return torch.cat([moved.mean, moved.quaternion, moved.log_scale, moved.sh[:, 0]], dim=1)


def _adam(value: Tensor, gradient: Tensor, moments: Tensor, adam: AdamStep) -> None:
    """One step of Adam in place; moments [2, ...]."""
    first, second = moments
    first.lerp_(gradient, 1 - adam.beta1)
    second.mul_(adam.beta2).addcmul_(gradient, gradient, value=1 - adam.beta2)
    value.addcdiv_(first, second.sqrt().add_(adam.floor), value=-adam.size)
