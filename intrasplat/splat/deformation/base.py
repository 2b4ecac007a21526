"""The interface of all motions.

Symbols: N Gaussians, B bases or weights per channel, C = 10 channels, t model time in [0, 1).
The channels are the rows of a state (intrasplat/splat/layout.py). Opacity never changes over time. Colour does if a
motion has channels 10:13, and gloss if it has channel 13.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import CHANNELS, COLOUR, COLOUR_CHANNELS, GLOSS_ROW, LOG_SCALE, MEAN, QUATERNION


@dataclass(frozen=True)
class AtRest:
    """The arguments that a preset and a clip give to an untrained motion.

    bases  B; None: the motion chooses
    width  width of a basis, model time; None: the motion chooses
    times  model times of the training frames
    seed   seed of random numbers
    gloss  whether two eyes are trained on, so that there is gloss to move
    """

    bases: int | None
    width: float | None
    times: Sequence[float]
    seed: int
    gloss: bool = False


class Deformation(ABC):
    """A motion: the canonical Gaussians as a function of time t.

    A subclass is a frozen dataclass whose fields are its tensors, or defines from_tensors.

    Attributes:
        kind: its name in the registry, in presets and in stored scenes.
        has_kernels: whether the CPU and GPU kernels train it (intrasplat/splat/); otherwise torch does, on the CPU.
        min_bases: the fewest bases it can have.
    """

    kind: ClassVar[str]
    has_kernels: ClassVar[bool] = False
    min_bases: ClassVar[int] = 1

    @classmethod
    @abstractmethod
    def at_rest(cls, gaussians: Gaussians, start: AtRest) -> Self:
        """The motion of these Gaussians before training, in which nothing moves."""

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> Self:
        """The motion with these parameters() and constants()."""
        return cls(**tensors)

    @property
    def bases(self) -> int:
        """B of every channel; 0 if the motion has no bases."""
        return 0

    @abstractmethod
    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """The Gaussians at time t: pure, differentiable in every parameter and in the canonical state."""

    @abstractmethod
    def parameters(self) -> dict[str, Tensor]:
        """The tensors to train, by name."""

    def constants(self) -> dict[str, Tensor]:
        """The tensors that are not trained, by name; with parameters() they are the whole state."""
        return {}

    @abstractmethod
    def select(self, rows: Tensor | slice) -> Self:
        """The motion of these Gaussians: [M] indices, repeats allowed, [N] bool or a slice. Shared tensors stay so."""


@dataclass(frozen=True, eq=False)
class LinearDeformation(Deformation):
    """psi(t) = weight basis(t): each Gaussian and channel has weights for bases that all of them share.

    A subclass implements basis(t); the kernels then train it.

    weight [N, C, B]  trained, in the channel's unit; C = 10, 13 where channels 10:13 add to the colour's harmonic 0, or
                      14 where channel 13 adds to the gloss, too
    """

    weight: Tensor

    has_kernels: ClassVar[bool] = True

    @abstractmethod
    def basis(self, t: float) -> Tensor:
        """[B] values at t."""

    @property
    def bases(self) -> int:
        return int(self.weight.shape[2])

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """The Gaussians at time t."""
        offsets = self.weight @ self.basis(t)
        moved = add_offsets(gaussians, offsets[:, :CHANNELS])
        if offsets.shape[1] > CHANNELS:
            constant = moved.sh[:, :1] + offsets[:, None, COLOUR]
            moved = dataclasses.replace(moved, sh=torch.cat([constant, moved.sh[:, 1:]], 1))
        if offsets.shape[1] > COLOUR_CHANNELS:
            moved = dataclasses.replace(moved, gloss=moved.gloss + offsets[:, GLOSS_ROW])
        return moved

    def parameters(self) -> dict[str, Tensor]:
        return {"weight": self.weight}

    def select(self, rows: Tensor | slice) -> Self:
        return dataclasses.replace(self, weight=self.weight[rows])


def add_offsets(gaussians: Gaussians, offsets: Tensor) -> Gaussians:
    """The Gaussians with offsets [N, 10] added. The quaternion is not normalised here: projection does that."""
    if offsets.shape != (len(gaussians), CHANNELS):
        raise ValueError(f"offsets have shape {tuple(offsets.shape)}, {len(gaussians)} Gaussians need [N, {CHANNELS}]")
    return dataclasses.replace(
        gaussians,
        mean=gaussians.mean + offsets[:, MEAN],
        quaternion=gaussians.quaternion + offsets[:, QUATERNION],
        log_scale=gaussians.log_scale + offsets[:, LOG_SCALE],
    )
