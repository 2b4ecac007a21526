"""Factor planes: features of a place and a time, which `lerplane` and `endogaussian` share.

Symbols: M points, R cells of a spatial axis, Q cells of time, C features a plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn.functional import grid_sample

SPACE_PAIRS, TIME_PAIRS = ((0, 1), (0, 2), (1, 2)), ((0, 3), (1, 3), (2, 3))


@dataclass(frozen=True)
class Smoothness:
    """Weights of what is to be small in the planes; each is the mean over the three planes of a resolution.

    space, time   squared differences of neighbouring cells of the planes of space and of those of time
    time_l1       distance of the planes of time from 1, where they change nothing
    acceleration  squared second differences in time of the planes of time
    """

    space: float
    time: float
    time_l1: float
    acceleration: float


class Planes(nn.Module):
    """Features of (x, y, z, t), each in [-1, 1]: at each resolution the product of six planes' bilinear values.

    space  by resolution [3, C, R, R]: xy, xz, yz, which do not change in time
    time   by resolution [3, C, Q, R]: xt, yt, zt, 1 at the start, so that space is learnt first
    """

    def __init__(self, cells: Sequence[int], time_cells: int, features: int) -> None:
        super().__init__()
        spaces = [torch.empty(3, features, each, each).uniform_(0.1, 0.5) for each in cells]
        self.space = nn.ParameterList(spaces)
        self.time = nn.ParameterList([torch.ones(3, features, time_cells, each) for each in cells])
        self.size = len(cells) * features

    def forward(self, place: Tensor, t: Tensor) -> Tensor:
        """place [M, 3] and model times [M] in [0, 1]: features [M, size]."""
        at = torch.cat([place, 2 * t[:, None] - 1], 1)
        spaces, times = (torch.stack([at[:, pair] for pair in pairs])[:, None] for pairs in (SPACE_PAIRS, TIME_PAIRS))
        found = [
            _sampled(s, spaces).prod(0) * _sampled(q, times).prod(0) for s, q in zip(self.space, self.time, strict=True)
        ]
        return torch.cat(found).T

    def roughness(self, weights: Smoothness) -> Tensor:
        """The weighted sum, of all resolutions. Second differences count where there are three cells of time."""
        total = torch.zeros((), dtype=self.time[0].dtype, device=self.time[0].device)
        for space, time in zip(self.space, self.time, strict=True):
            total = total + weights.space * sum(mean_squared_difference(space, axis, 1) for axis in (2, 3))
            total = total + weights.time_l1 * (1 - time).abs().mean()
            if weights.time:
                total = total + weights.time * sum(mean_squared_difference(time, axis, 1) for axis in (2, 3))
            if time.shape[2] > 2:
                total = total + weights.acceleration * mean_squared_difference(time, 2, 2)
        return total


class _MeanSquaredDifference(Function):
    """Its gradient is written down: autograd fills and adds whole planes for each slice of a difference."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, axis: int, order: int) -> Tensor:
        difference = values.diff(order, axis)
        ctx.save_for_backward(difference)
        ctx.axis, ctx.order = axis, order
        return difference.square().mean()

    @staticmethod
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor, None, None]:
        (difference,) = ctx.saved_tensors
        length, axis = difference.shape[ctx.axis], ctx.axis
        share = difference * (2 * given[0] / difference.numel())
        shape = list(difference.shape)
        shape[axis] += ctx.order
        found = difference.new_zeros(shape)
        for place in range(ctx.order + 1):
            sign = (-1) ** (ctx.order - place) * math.comb(ctx.order, place)
            found.narrow(axis, place, length).add_(share, alpha=sign)
        return found, None, None


def mean_squared_difference(values: Tensor, axis: int, order: int) -> Tensor:
    """The mean squared difference of neighbours along an axis (order 1), or of their differences (order 2)."""
    found: Tensor = _MeanSquaredDifference.apply(values, axis, order)  # type: ignore[no-untyped-call]
    return found


def _sampled(planes: Tensor, at: Tensor) -> Tensor:
    """Planes [3, C, rows, columns] at [3, 1, M, 2]: [3, C, M]."""
    found: Tensor = grid_sample(planes, at, mode="bilinear", padding_mode="border", align_corners=True)
    return found[:, :, 0]
