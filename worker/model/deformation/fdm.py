"""Flexible deformation modelling (FDM): Deform3DGS, equations of section "Flexible Deformation Modeling".

Symbols: N Gaussians, C = 10 channels, B bases.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from worker.model.constants import MIN_WIDTH
from worker.model.deformation.base import AtRest, Deformation, add_offsets
from worker.model.gaussians import Gaussians
from worker.model.layout import CHANNELS

PAPER_BASES = 17
PAPER_WIDTH = 0.01
"""Share of the clip. Leaves most of the timeline between two bases without any; wider starts cover it."""


@dataclass(frozen=True, eq=False)
class FlexibleDeformation(Deformation):
    """psi(t) = sum_j w_j b_j(t): every Gaussian and channel has B bases of its own, all of their numbers trained.

    weight [N, 10, B]  w, in the channel's unit
    centre [N, 10, B]  theta, model time
    width  [N, 10, B]  sigma, model time, of either sign
    """

    weight: Tensor
    centre: Tensor
    width: Tensor

    has_kernels: ClassVar[bool] = True
    quartic: ClassVar[bool]
    """Which form of b_j the kernels compute; the quartic one is that of the released code (docs/deformation.md)."""

    def __post_init__(self) -> None:
        shapes = {tuple(each.shape) for each in self.parameters().values()}
        if len(shapes) != 1 or self.weight.ndim != 3 or self.weight.shape[1] != CHANNELS:
            raise ValueError(f"weight, centre and width must share one shape [N, {CHANNELS}, B], not {sorted(shapes)}")

    @classmethod
    def initial(cls, count: int, *, bases: int = PAPER_BASES, width: float = PAPER_WIDTH) -> Self:
        """No motion yet: weights 0, centres spread evenly over [0, 1], one width for all."""
        shape = (count, CHANNELS, bases)
        return cls(
            weight=torch.zeros(shape),
            centre=torch.linspace(0, 1, bases).expand(shape).clone(),
            width=torch.full(shape, width),
        )

    @classmethod
    def at_rest(cls, gaussians: Gaussians, start: AtRest) -> Self:
        """Initial with the bases and the width of the preset, else those of the paper."""
        bases = PAPER_BASES if start.bases is None else start.bases
        return cls.initial(len(gaussians), bases=bases, width=PAPER_WIDTH if start.width is None else start.width)

    @property
    def bases(self) -> int:
        return int(self.weight.shape[2])

    @abstractmethod
    def basis(self, t: float) -> Tensor:
        """Value of every b_j at t: [N, 10, B] in [0, 1]."""

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """The Gaussians at time t."""
        return add_offsets(gaussians, (self.weight * self.basis(t)).sum(dim=-1))

    def parameters(self) -> dict[str, Tensor]:
        return {"weight": self.weight, "centre": self.centre, "width": self.width}

    def select(self, rows: Tensor | slice) -> Self:
        return type(self)(self.weight[rows], self.centre[rows], self.width[rows])


class GaussianFdm(FlexibleDeformation):
    """The paper's form: b_j(t) = exp(-(t - theta_j)^2 / (2 sigma_j^2)).

    |sigma_j| is held at MIN_WIDTH where it is smaller, and gets no gradient there.
    """

    kind = "fdm-gaussian"
    quartic = False

    def basis(self, t: float) -> Tensor:
        variance = torch.clamp(self.width**2, min=MIN_WIDTH**2)
        return torch.exp(-((t - self.centre) ** 2) / (2 * variance))
