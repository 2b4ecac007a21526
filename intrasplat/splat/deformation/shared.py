"""FDM with one set of bases for all Gaussians: a third of the numbers, linear in its weights; colour may move too.

Symbols: N Gaussians, C = 10 channels, 13 with the colour's constant harmonic, 14 with the gloss too, B bases, T
training frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from intrasplat.splat.constants import MIN_WIDTH
from intrasplat.splat.deformation.base import AtRest, LinearDeformation
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import CHANNELS, COLOUR_CHANNELS, ROWS

DEFAULT_BASES = 9
WIDTH_IN_SPACINGS = 0.6
"""Width of a basis over the larger gap next to it. Neighbours then cross at 0.7, so that every time is covered."""


@dataclass(frozen=True, eq=False)
class SharedBasis(LinearDeformation):
    """psi(t) = sum_j w_j phi_j(t), phi_j = b_j / sum_k b_k, b_j(t) = exp(-(t - theta_j)^2 / (2 sigma_j^2)).

    theta and sigma are the same for all Gaussians and fixed.

    Because they are divided by their sum, the bases interpolate motion over times without frames (an instrument in the
    way) from both sides. Without the division the motion would return to the canonical state there.

    weight [N, C, B]  trained, in the channel's unit; channels 10:13, if there are any, add to the colour's harmonic 0,
                      channel 13 to the gloss
    centre [B]        theta, model time
    width  [B]        sigma > 0, model time
    """

    centre: Tensor
    width: Tensor

    kind = "shared"

    def __post_init__(self) -> None:
        bases, channels = self.centre.shape[0], (CHANNELS, COLOUR_CHANNELS, ROWS)
        shape = tuple(self.weight.shape)
        if len(shape) != 3 or shape[1] not in channels or shape[2] != bases or self.width.shape != (bases,):
            raise ValueError(
                f"weight must be [N, {CHANNELS}, {COLOUR_CHANNELS} or {ROWS}, B] with centre and width [B], "
                f"not {shape}, {tuple(self.centre.shape)} and {tuple(self.width.shape)}"
            )
        if not bool((self.width > 0).all()):
            raise ValueError(f"width must be positive, its least is {float(self.width.min())}")

    @classmethod
    def initial(
        cls,
        count: int,
        *,
        bases: int = DEFAULT_BASES,
        colour: bool = False,
        gloss: bool = False,
        times: Sequence[float] | None = None,
    ) -> SharedBasis:
        """No motion yet: weights 0. Each basis is 0.6 times as wide as the larger gap next to it.

        Args:
            colour: whether the colour's constant harmonic moves too: 13 channels instead of 10.
            gloss: whether colour and gloss move too: 14 channels.
            times: model times of the training frames; centres are their even quantiles. None: evenly over [0, 1].

        Raises:
            ValueError: bases < 1.
        """
        if bases < 1:
            raise ValueError(f"bases must be at least 1, not {bases}")
        quantiles = np.linspace(0, 1, bases) if bases > 1 else np.array([0.5])
        centre = np.quantile(np.asarray(times, np.float64), quantiles) if times is not None else quantiles
        gaps = np.diff(centre) if bases > 1 else np.ones(1)
        width = WIDTH_IN_SPACINGS * np.maximum(np.r_[gaps[:1], gaps], np.r_[gaps, gaps[-1:]])[:bases]
        return cls(
            weight=torch.zeros(count, ROWS if gloss else COLOUR_CHANNELS if colour else CHANNELS, bases),
            centre=torch.from_numpy(centre).float(),
            width=torch.from_numpy(np.maximum(width, MIN_WIDTH)).float(),  # equal quantiles of few frames have width 0
        )

    @classmethod
    def at_rest(cls, gaussians: Gaussians, start: AtRest) -> SharedBasis:
        """No motion, with channels for colour, and with no more bases than training frames."""
        bases = DEFAULT_BASES if start.bases is None else start.bases
        count, bases = len(gaussians), min(len(start.times), bases)
        return cls.initial(count, bases=bases, colour=True, gloss=start.gloss, times=start.times)

    def basis(self, t: float) -> Tensor:
        """phi at t: [B] in [0, 1], summing to 1."""
        return torch.softmax(-((t - self.centre) ** 2) / (2 * self.width**2), 0)

    def constants(self) -> dict[str, Tensor]:
        return {"centre": self.centre, "width": self.width}
