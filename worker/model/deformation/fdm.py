"""Flexible deformation modelling (FDM): Deform3DGS, equations of section "Flexible Deformation Modeling".

Symbols: N Gaussians, C = 10 channels, B bases.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from worker.model.deformation.base import CHANNELS, add_offsets
from worker.model.gaussians import Gaussians

Form = Literal["gaussian", "quartic"]

PAPER_BASES = 17
PAPER_WIDTH = 0.01
"""Share of the clip. Leaves most of the timeline between two bases without any; wider starts cover it."""
MIN_WIDTH = 1e-3
"""Share of the clip. Below it a basis falls between frames and its exponent overflows."""
QUARTIC_FLOOR = 1e-4
"""Added to the squared width by the quartic form, which needs no other lower bound."""


@dataclass(frozen=True, eq=False)
class FlexibleDeformation:
    """Every Gaussian and channel has B bases of its own in time, all of their numbers trained.

    weight [N, 10, B]  w, in the channel's unit
    centre [N, 10, B]  theta, model time
    width  [N, 10, B]  sigma, model time, of either sign
    form               "gaussian", the paper's:  psi(t) = sum_j w_j exp(-(t - theta_j)^2 / (2 sigma_j^2))
                       with |sigma_j| held at 1e-3 where it is smaller (no gradient to sigma there);
                       "quartic", the released code's: psi(t) = sum_j w_j exp(-((t - theta_j)^2 / (sigma_j^2 + 1e-4))^2)
    """

    weight: Tensor
    centre: Tensor
    width: Tensor
    form: Form = "gaussian"

    def __post_init__(self) -> None:
        if self.form not in ("gaussian", "quartic"):
            raise ValueError(f"form must be 'gaussian' or 'quartic', not {self.form!r}")
        shapes = {tuple(each.shape) for each in self.parameters().values()}
        if len(shapes) != 1 or self.weight.ndim != 3 or self.weight.shape[1] != CHANNELS:
            raise ValueError(f"weight, centre and width must share one shape [N, {CHANNELS}, B], not {sorted(shapes)}")

    @classmethod
    def initial(
        cls, count: int, *, bases: int = PAPER_BASES, width: float = PAPER_WIDTH, form: Form = "gaussian"
    ) -> FlexibleDeformation:
        """No motion yet: weights 0, centres spread evenly over [0, 1], one width for all."""
        shape = (count, CHANNELS, bases)
        return cls(
            weight=torch.zeros(shape),
            centre=torch.linspace(0, 1, bases).expand(shape).clone(),
            width=torch.full(shape, width),
            form=form,
        )

    @property
    def kind(self) -> str:
        return f"fdm-{self.form}"

    @property
    def bases(self) -> int:
        return int(self.weight.shape[2])

    @property
    def floats_per_gaussian(self) -> int:
        return 3 * CHANNELS * self.bases

    @property
    def shared_floats(self) -> int:
        return 0

    def basis(self, t: float) -> Tensor:
        """Value of every basis at t: [N, 10, B] in [0, 1]."""
        squared = (t - self.centre) ** 2
        if self.form == "quartic":
            return torch.exp(-((squared / (self.width**2 + QUARTIC_FLOOR)) ** 2))
        variance = torch.clamp(self.width**2, min=MIN_WIDTH**2)
        return torch.exp(-squared / (2 * variance))

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """The Gaussians at time t."""
        return add_offsets(gaussians, (self.weight * self.basis(t)).sum(dim=-1))

    def parameters(self) -> dict[str, Tensor]:
        return {"weight": self.weight, "centre": self.centre, "width": self.width}

    def constants(self) -> dict[str, Tensor]:
        return {}

    def select(self, rows: Tensor) -> FlexibleDeformation:
        return FlexibleDeformation(self.weight[rows], self.centre[rows], self.width[rows], self.form)
