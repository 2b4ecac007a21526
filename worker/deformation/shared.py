"""FDM with one set of bases for all Gaussians: a third of the numbers, and linear in them.

Symbols: N Gaussians, C = 10 channels, B bases.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from worker.deformation.base import CHANNELS, add_offsets
from worker.gaussians import Gaussians

DEFAULT_BASES = 9
WIDTH_IN_SPACINGS = 0.6
"""Neighbouring bases of this width cross at 0.7, so that no time is left without one."""


@dataclass(frozen=True, eq=False)
class SharedBasis:
    """psi(t) = sum_j w_j exp(-(t - theta_j)^2 / (2 sigma_j^2)) with theta, sigma common to all and fixed.

    weight [N, 10, B]  trained, in the channel's unit
    centre [B]         theta, model time
    width  [B]         sigma > 0, model time
    """

    weight: Tensor
    centre: Tensor
    width: Tensor

    def __post_init__(self) -> None:
        bases = self.centre.shape[0]
        if self.weight.ndim != 3 or self.weight.shape[1:] != (CHANNELS, bases) or self.width.shape != (bases,):
            raise ValueError(
                f"weight must be [N, {CHANNELS}, B] with centre and width [B], not {tuple(self.weight.shape)}, "
                f"{tuple(self.centre.shape)} and {tuple(self.width.shape)}"
            )
        if not bool((self.width > 0).all()):
            raise ValueError(f"width must be positive, its least is {float(self.width.min())}")

    @classmethod
    def initial(cls, count: int, *, bases: int = DEFAULT_BASES, width: float | None = None) -> SharedBasis:
        """No motion yet: weights 0, centres even over [0, 1], width 0.6 of their spacing unless given."""
        spacing = 1 / max(bases - 1, 1)
        return cls(
            weight=torch.zeros(count, CHANNELS, bases),
            centre=torch.linspace(0, 1, bases),
            width=torch.full((bases,), WIDTH_IN_SPACINGS * spacing if width is None else width),
        )

    @property
    def kind(self) -> str:
        return "shared"

    @property
    def floats_per_gaussian(self) -> int:
        return CHANNELS * int(self.centre.shape[0])

    @property
    def shared_floats(self) -> int:
        return 2 * int(self.centre.shape[0])

    def basis(self, t: float) -> Tensor:
        """Value of every basis at t: [B] in [0, 1]."""
        return torch.exp(-((t - self.centre) ** 2) / (2 * self.width**2))

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """The Gaussians at time t."""
        return add_offsets(gaussians, self.weight @ self.basis(t))

    def parameters(self) -> dict[str, Tensor]:
        return {"weight": self.weight}

    def constants(self) -> dict[str, Tensor]:
        return {"centre": self.centre, "width": self.width}

    def select(self, rows: Tensor) -> SharedBasis:
        return SharedBasis(self.weight[rows], self.centre, self.width)
