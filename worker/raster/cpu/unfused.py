"""The motion of a deformation without kernels of its own: torch moves the Gaussians and differentiates.

The rest of a step is that of every motion, so two deformations compared with each other differ in nothing else. Only
the time of a step is not comparable: tables of speed must say so.

Symbols: N Gaussians (padded to whole vectors), rows of N floats, F frames per step; canonical and state [ROWS, N].
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from contract.wire.errors import TrainingDiverged
from worker.model.deformation import Deformation
from worker.model.gaussians import Gaussians
from worker.model.layout import COLOUR, GLOSS_ROW, LOG_SCALE, MEAN, QUATERNION
from worker.model.optimize import AdamStep, StepRates, adam_step
from worker.raster.cpu.rasterizer import Floats


class AutogradMotion:
    """Any deformation as a Motion: its offsets by torch, its gradients by autograd, dense Adam on all its parameters.

    Every parameter has the rate motion_mean: a network's weights belong to no kind of channel.
    """

    def __init__(self, deformation: Deformation, count: int, columns: int) -> None:
        padding = torch.zeros(columns - count, dtype=torch.int64)  # copies of the first Gaussian; never drawn
        self._adopt(deformation.select(torch.cat([torch.arange(count), padding])))
        self._moments = {name: torch.zeros(2, *each.shape) for name, each in self._parameters.items()}
        self._graphs: list[tuple[Tensor, Tensor]] = []  # a step's canonical states, and what became of each

    def _adopt(self, deformation: Deformation) -> None:
        """Train copies of this deformation's parameters from here on."""
        self._parameters = {name: each.detach().clone() for name, each in deformation.parameters().items()}
        for each in self._parameters.values():
            each.requires_grad_()
        self._deformation = deformation.from_tensors(self._parameters | deformation.constants())

    def deform(self, canonical: Floats, t: float, state: Floats, *, trains: bool = False) -> None:
        """state = canonical + offsets at t; where trains, keeps the graph for update.

        Raises:
            TrainingDiverged: a mean is not finite. Torch would look it up outside the planes' memory and crash.
        """
        if not np.isfinite(canonical[MEAN]).all():
            raise TrainingDiverged("A Gaussian's place is no longer a number.")
        rows = torch.from_numpy(canonical.T.copy()).requires_grad_(trains)
        with torch.set_grad_enabled(trains):
            moved = _deformed(self._deformation, rows, t)
        if trains:
            self._graphs.append((rows, moved))
        state[:] = moved.detach().T.numpy()

    def update(self, v_state: Floats, times: Sequence[float], rates: StepRates, iteration: int) -> None:
        """One Adam step, given dL/dstate [F, ROWS, N] at the times deformed to since the last; turns it into
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
        rows, before = torch.from_numpy(columns), self._parameters
        taken = self._deformation.select(rows)
        for name, parameter in taken.parameters().items():
            if parameter is not before[name]:
                self._moments[name] = self._moments[name][:, rows]
                self._moments[name][:, torch.from_numpy(fresh)] = 0.0
        self._adopt(taken)

    def parameters(self, count: int) -> dict[str, Tensor]:
        """What is trained, by name; views. The Gaussians that only fill the last vector are among them, if any are."""
        return {f"motion.{name}": each.detach() for name, each in self._parameters.items()}

    def arrays(self, count: int) -> dict[str, Tensor]:
        """Parameters and moments by name; views."""
        return self.parameters(count) | {f"motion.moments.{name}": each for name, each in self._moments.items()}

    def export(self, count: int, *, as_it_lies: bool = False) -> Deformation:
        """The first count Gaussians' deformation as torch tensors (copies)."""
        del as_it_lies
        copies = {name: each.detach().clone() for name, each in self._parameters.items()}
        deformation = self._deformation.from_tensors(copies | self._deformation.constants())
        return deformation.select(torch.arange(count))


def _deformed(deformation: Deformation, canonical: Tensor, t: float) -> Tensor:
    """Canonical rows [N, ROWS] at time t. Opacity and the other harmonics do not move and are not asked for."""
    gaussians = Gaussians(
        mean=canonical[:, MEAN],
        quaternion=canonical[:, QUATERNION],
        log_scale=canonical[:, LOG_SCALE],
        opacity_logit=canonical.new_zeros(len(canonical)),
        sh=canonical[:, None, COLOUR],
        gloss=canonical[:, GLOSS_ROW],
    )
    moved = deformation.deform(gaussians, t)
    return torch.cat([moved.mean, moved.quaternion, moved.log_scale, moved.sh[:, 0], moved.gloss[:, None]], dim=1)


def _adam(value: Tensor, gradient: Tensor, moments: Tensor, adam: AdamStep) -> None:
    """One step of Adam in place; moments [2, ...]."""
    first, second = moments
    first.lerp_(gradient, 1 - adam.beta1)
    second.mul_(adam.beta2).addcmul_(gradient, gradient, value=1 - adam.beta2)
    value.addcdiv_(first, second.sqrt().add_(adam.floor), value=-adam.size)
