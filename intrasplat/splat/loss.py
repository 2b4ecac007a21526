"""The training loss in plain torch: the definition that the fused kernels are tested against.

Symbols: H W pixels; C [H, W, 3] rendered colour, Z = sum(w z) and A = sum(w) [H, W] of the blend (intrasplat/splat);
M_c tissue pixels, M_d tissue pixels with valid depth d. Depths are in optimiser units (median 60).
Source: Yang et al., Deform3DGS (MICCAI 2024), section "Optimization": masked L1 of colour + of inverse depth, 1 : 1.

    L   = colour_weight L_c + depth_weight L_d
    L_c = 1 / (3 |M_c|) sum_{M_c, RGB} h(C - C_true)
    L_d = 1 / |M_d|     sum_{M_d}      h(D - 1 / d),     D = 1 / Z   ("paper": the sum as blended)
                                                         D = A / Z   (normalised: inverse of the mean depth)

h is |e|, or Huber's loss over its delta > 0: e^2 / (2 delta) for |e| < delta, else |e| - delta / 2. Its slope is
h'(e) = clip(e / delta, -1, 1), or sign(e) for delta = 0. So the gradients that reach the blend are

    dL/dC = colour_weight / (3 |M_c|) h'(C - C_true)                      on M_c, else 0
    dL/dZ = -depth_weight / |M_d| h'(D - 1 / d) D / Z                     on M_d, else 0   (both forms)
    dL/dA =  depth_weight / |M_d| h'(D - 1 / d) / Z                       normalised; 0 for "paper"

A pixel of M_d with A < MIN_COVERAGE has no rendered depth. It adds nothing to L_d but counts in |M_d|, so that the
divisions stay finite and the scale does not depend on how much is covered so far.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from intrasplat.splat.constants import MIN_COVERAGE


@dataclass(frozen=True)
class LossSettings:
    """Weights of the two terms, the form of depth, and where the L1 becomes quadratic.

    normalised_depth   False: 1 / Z, as published; True: A / Z
    colour_huber_delta Huber delta of colour, in [0, 1]; 0: plain L1
    depth_huber_delta  Huber delta of inverse depth, in 1 / units; 0: plain L1
    """

    colour_weight: float = 1.0
    depth_weight: float = 1.0
    normalised_depth: bool = True
    colour_huber_delta: float = 0.0
    depth_huber_delta: float = 0.0

    def __post_init__(self) -> None:
        negative = {name: value for name, value in vars(self).items() if value < 0}
        if negative:
            raise ValueError(f"loss settings must not be negative: {negative}")


@dataclass(frozen=True, eq=False)
class Loss:
    """total = colour_weight colour + depth_weight inverse_depth; each is a scalar tensor."""

    total: Tensor
    colour: Tensor
    inverse_depth: Tensor


def training_loss(
    rgb: Tensor,
    depth: Tensor,
    alpha: Tensor,
    true_rgb: Tensor,
    true_depth: Tensor,
    tissue: Tensor,
    settings: LossSettings,
) -> Loss:
    """The loss of one frame: a reference for tests and benchmarks. Training uses the kernels.

    Args:
        rgb, depth, alpha: [H, W, 3], [H, W], [H, W] as rendered; depth is sum(w z) in units, not divided by alpha.
        true_rgb: [H, W, 3] in [0, 1].
        true_depth: [H, W] in units, 0 = invalid.
        tissue: [H, W] bool.
    """
    colour = colour_loss(rgb, true_rgb, tissue, delta=settings.colour_huber_delta)
    inverse_depth = inverse_depth_loss(
        depth, alpha, true_depth, tissue, normalised=settings.normalised_depth, delta=settings.depth_huber_delta
    )
    return Loss(settings.colour_weight * colour + settings.depth_weight * inverse_depth, colour, inverse_depth)


def colour_loss(rgb: Tensor, true_rgb: Tensor, tissue: Tensor, *, delta: float = 0.0) -> Tensor:
    """L_c: mean over tissue pixels and RGB; 0 without tissue."""
    errors = _h(rgb - true_rgb, delta).sum(dim=-1)
    return torch.where(tissue, errors, 0.0).sum() / (3 * tissue.sum()).clamp(min=1)


def inverse_depth_loss(
    depth: Tensor, alpha: Tensor, true_depth: Tensor, tissue: Tensor, *, normalised: bool, delta: float = 0.0
) -> Tensor:
    """L_d: mean over tissue pixels with valid true depth, in 1 / units; 0 if there is none."""
    valid = tissue & (true_depth > 0)
    usable = valid & (alpha >= MIN_COVERAGE)
    # The inner where keeps 1 / 0 out of the graph: its gradient would be NaN even where it is not used.
    inverse = 1 / torch.where(usable, depth, 1.0)
    if normalised:
        inverse = inverse * alpha
    errors = _h(inverse - 1 / torch.where(valid, true_depth, 1.0), delta)
    return torch.where(usable, errors, 0.0).sum() / valid.sum().clamp(min=1)


def _h(error: Tensor, delta: float) -> Tensor:
    """|e|, or Huber's loss over its delta."""
    size = error.abs()
    if delta == 0:
        return size
    return torch.where(size < delta, error**2 / (2 * delta), size - delta / 2)
