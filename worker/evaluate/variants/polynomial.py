"""`pfs`: polynomial plus Fourier series, without local bases (an ablation of Deform3DGS; the form of Gaussian-Flow).

Symbols: N Gaussians, C = 10 channels, B weights per channel, P of them polynomial, 2 H of H harmonics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from worker.model.deformation.base import AtRest, LinearDeformation
from worker.model.gaussians import Gaussians
from worker.model.layout import CHANNELS

DEFAULT_WEIGHTS = 17
"""As many weights per channel as the paper's FDM has bases."""


@dataclass(frozen=True, eq=False)
class PolynomialFourier(LinearDeformation):
    """psi(t) = sum_p a_p T_p(2t - 1) + sum_h b_h cos(2 pi h t) + c_h sin(2 pi h t), p = 1..P, h = 1..H.

    weight [N, 10, B]  [a | b | c], trained, in the channel's unit; H = (B - 1) // 3, P = B - 2H

    T_p are Chebyshev polynomials: with the canonical state as constant they span what the powers of t span, but Adam
    treats every weight alike, and the powers of t in [0, 1] are nearly parallel.
    """

    kind = "pfs"

    def __post_init__(self) -> None:
        if self.weight.ndim != 3 or self.weight.shape[1] != CHANNELS or self.weight.shape[2] < 1:
            raise ValueError(f"weight must be [N, {CHANNELS}, B >= 1], not {tuple(self.weight.shape)}")

    @classmethod
    def initial(cls, count: int, *, weights: int = DEFAULT_WEIGHTS) -> PolynomialFourier:
        """No motion yet: all weights 0."""
        return cls(torch.zeros(count, CHANNELS, weights))

    @classmethod
    def at_rest(cls, gaussians: Gaussians, start: AtRest) -> PolynomialFourier:
        """Initial with as many weights as the preset has bases."""
        return cls.initial(len(gaussians), weights=DEFAULT_WEIGHTS if start.bases is None else start.bases)

    def basis(self, t: float) -> Tensor:
        """Value of every function at t: [B] in [-1, 1]."""
        harmonics = (self.bases - 1) // 3
        powers = self.bases - 2 * harmonics
        chebyshev = [1.0, 2 * t - 1]
        while len(chebyshev) <= powers:
            chebyshev.append(2 * (2 * t - 1) * chebyshev[-1] - chebyshev[-2])
        angles = [2 * math.pi * h * t for h in range(1, harmonics + 1)]
        values = chebyshev[1:] + [math.cos(angle) for angle in angles] + [math.sin(angle) for angle in angles]
        return self.weight.new_tensor(values)
