"""Where the samples of a ray lie: in intervals that a coarser field proposes, round after round, for `lerplane`.

Symbols: M rays, K intervals a ray, S of them in the last round. Edges are s in [0, 1] of
lab/rivals/fields.py. The method is that of Mip-NeRF 360 (Barron et al., 2022); own text.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lab.rivals.fields import SOLID

PADDING = 0.01
"""Weight that each interval has besides its own when the next samples are placed, as in Nerfacto."""


def drawn_edges(edges: Tensor, weight: Tensor, count: int, random: torch.Generator | None) -> Tensor:
    """[M, count + 1] edges of intervals that each hold as much of the weight [M, K] between the edges [M, K + 1], after
    PADDING is added to it.

    random: draws the jitter of each edge, at most half an interval; None: no jitter.
    """
    weight = weight + PADDING
    share = torch.cumsum(weight / weight.sum(-1, keepdim=True), -1)
    share = torch.cat([torch.zeros_like(share[:, :1]), share[:, :-1], torch.ones_like(share[:, :1])], -1)
    wanted = torch.linspace(0, 1, count + 1).to(edges).expand(len(edges), -1)
    if random is not None:
        jitter = (torch.rand(len(edges), count + 1, generator=random).to(edges) - 0.5) / count
        wanted = (wanted + jitter).clamp(0, 1)
    above = torch.searchsorted(share, wanted.contiguous(), right=True).clamp(1, share.shape[1] - 1)
    low, high = (share.gather(1, each) for each in (above - 1, above))
    inside = ((wanted - low) / (high - low).clamp(min=1e-9)).clamp(0, 1)
    start, end = (edges.gather(1, each) for each in (above - 1, above))
    return start + inside * (end - start)


def lengths(edges: Tensor) -> Tensor:
    """Lengths [M, K] in s of the intervals between the edges [M, K + 1]; the last one makes its interval opaque."""
    return torch.cat([edges.diff(dim=-1)[:, :-1], torch.full_like(edges[:, :1], SOLID)], 1)


def middles(edges: Tensor) -> Tensor:
    """Middles [M, K] of the intervals between the edges [M, K + 1]."""
    return (edges[:, 1:] + edges[:, :-1]) / 2


def interlevel_loss(edges: Tensor, weight: Tensor, proposed_edges: Tensor, proposed: Tensor) -> Tensor:
    """How far weights [M, S] exceed the sum of the overlapping proposals [M, K], as a mean over samples (Barron et al.,
    2022)."""
    total = torch.cat([torch.zeros_like(proposed[:, :1]), torch.cumsum(proposed, -1)], -1)
    most = proposed.shape[1]
    at = proposed_edges.contiguous()
    first = (torch.searchsorted(at, edges[:, :-1].contiguous(), right=True) - 1).clamp(0, most)
    last = torch.searchsorted(at, edges[:, 1:].contiguous()).clamp(0, most)
    bound = total.gather(1, last) - total.gather(1, first)
    return ((weight - bound).clamp(min=0).square() / (weight + 1e-7)).mean()


def annealed(done: float) -> float:
    """The exponent of the proposals' weights: 0 at first, 1 from done = 1 on."""
    done = min(done, 1.0)
    return 10 * done / (9 * done + 1)
