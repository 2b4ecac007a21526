"""The planes and small networks by which `endogaussian` moves its Gaussians.

Symbols: N Gaussians. A deformed Gaussian has DEFORMED columns: MEAN, QUATERNION, LOG_SCALE, OPACITY.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lab.rivals.planes import Planes

MEAN, QUATERNION, LOG_SCALE, OPACITY = slice(0, 3), slice(3, 7), slice(7, 10), 10
WIDTHS = (3, 4, 3, 1)
"""The numbers of columns of mean, quaternion, log-scale and opacity; each has its own decoder."""
DEFORMED = sum(WIDTHS)


class Displacement(nn.Module):
    """By how much Gaussians at places [N, 3] have changed at a time: [N, DEFORMED], nothing at the start.

    low, high [3]: the box of the places at the start, which is [-1, 1]^3 of the planes
    """

    low: Tensor
    high: Tensor

    def __init__(self, cells: Sequence[int], time_cells: int, features: int, hidden: int, places: Tensor) -> None:
        super().__init__()
        self.planes = Planes(cells, time_cells, features)
        self.decode = nn.ModuleList(_decoder(self.planes.size, hidden, width) for width in WIDTHS)
        self.register_buffer("low", places.amin(0))
        self.register_buffer("high", places.amax(0))

    def forward(self, place: Tensor, t: float) -> Tensor:
        inside = 2 * (place - self.low) / (self.high - self.low).clamp(min=1e-6) - 1
        features = self.planes(inside, torch.full_like(inside[:, 0], t))
        return torch.cat([decode(features) for decode in self.decode], 1)


def _decoder(features: int, hidden: int, width: int) -> nn.Sequential:
    last = nn.Linear(hidden, width)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(features, hidden), nn.ReLU(), last)
