"""What all deformation models share: the channels they move and the promises they keep.

Symbols: N Gaussians, B bases or weights a channel, C = 10 channels, t model time in [0, 1).
Channels: mean 0:3, quaternion 3:7, log-scale 7:10. Opacity never deforms; colour does
where a model has channels 10:13 for it (shared.py).
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

from torch import Tensor

from worker.model.gaussians import Gaussians

CHANNELS = 10
MEAN = slice(0, 3)
QUATERNION = slice(3, 7)
LOG_SCALE = slice(7, 10)


class Deformation(Protocol):
    """A motion model: what it adds to the canonical Gaussians at time t.

    Attributes:
        kind: its name in a checkpoint (deformation.restore).
        bases: B, of every channel; 0 where there is no such number.
        floats_per_gaussian: trained numbers each Gaussian adds.
        shared_floats: numbers, trained or fixed, that all Gaussians share.
    """

    @property
    def kind(self) -> str: ...

    @property
    def bases(self) -> int: ...

    @property
    def floats_per_gaussian(self) -> int: ...

    @property
    def shared_floats(self) -> int: ...

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """The Gaussians at time t: pure, differentiable in every parameter and in the canonical state."""
        ...

    def parameters(self) -> dict[str, Tensor]:
        """The tensors to train, by name."""
        ...

    def constants(self) -> dict[str, Tensor]:
        """The tensors that stay as they are, by name; with parameters() they are the whole state."""
        ...

    def select(self, rows: Tensor) -> Deformation:
        """The model of the Gaussians rows ([M] indices, repeats allowed, or [N] bool); shared tensors stay shared."""
        ...


def add_offsets(gaussians: Gaussians, offsets: Tensor) -> Gaussians:
    """Adds offsets [N, 10] to the canonical state. The quaternion stays unnormalised: projection normalises it."""
    if offsets.shape != (len(gaussians), CHANNELS):
        raise ValueError(f"offsets have shape {tuple(offsets.shape)}, {len(gaussians)} Gaussians need [N, {CHANNELS}]")
    return dataclasses.replace(
        gaussians,
        mean=gaussians.mean + offsets[:, MEAN],
        quaternion=gaussians.quaternion + offsets[:, QUATERNION],
        log_scale=gaussians.log_scale + offsets[:, LOG_SCALE],
    )
