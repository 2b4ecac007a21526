"""`hexplane`: motion from six feature planes and a small network (Cao and Johnson, HexPlane, CVPR 2023; own text).

Symbols: N Gaussians, F features a plane, R resolutions, S cells a spatial axis, Q cells of time.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, linear, relu

from worker.model.deformation.base import AtRest, Deformation, add_offsets
from worker.model.gaussians import Gaussians
from worker.model.layout import CHANNELS

AXES = "xyzt"
PLANE_PAIRS = (("xy", "zt"), ("xz", "yt"), ("yz", "xt"))
"""A plane of space and the complementary plane of time: their features are multiplied."""
SPACE_CELLS = (64, 128)
TIME_CELLS = 50
FEATURES = 16
HIDDEN = 64


@dataclass(frozen=True, eq=False)
class HexPlane(Deformation):
    """offsets(x, t) = MLP(concatenation over resolutions and pairs of plane_ab(x) * plane_cd(x, t)).

    planes  [R] dicts of "xy" .. "zt" -> [F, cells of the second axis, cells of the first axis]
    layers  (weight, bias) of three linear layers, ReLU between them, the last gives the 10 channels
    bounds  [2, 3] least and greatest canonical position; positions outside read the border
    """

    planes: tuple[dict[str, Tensor], ...]
    layers: tuple[tuple[Tensor, Tensor], ...]
    bounds: Tensor

    kind = "hexplane"
    min_bases = 0

    @classmethod
    def at_rest(cls, gaussians: Gaussians, start: AtRest) -> HexPlane:
        """Initial in the box of the canonical means."""
        return cls.initial(torch.stack([gaussians.mean.amin(0), gaussians.mean.amax(0)]), seed=start.seed)

    @classmethod
    def initial(
        cls,
        bounds: Tensor,
        *,
        seed: int = 0,
        space_cells: tuple[int, ...] = SPACE_CELLS,
        time_cells: int = TIME_CELLS,
        features: int = FEATURES,
    ) -> HexPlane:
        """No motion yet: the last layer is 0; planes of time are 1, so that space is learnt first.

        Args:
            bounds: [2, 3] box of the canonical means in units.
        """
        random = torch.Generator().manual_seed(seed)
        planes = []
        for cells in space_cells:
            size = {"x": cells, "y": cells, "z": cells, "t": time_cells}
            level: dict[str, Tensor] = {}
            for space, time in PLANE_PAIRS:
                shape = (features, size[space[1]], size[space[0]])
                level[space] = torch.empty(shape).uniform_(0.1, 0.5, generator=random)
                level[time] = torch.ones(features, size[time[1]], size[time[0]])
            planes.append(level)
        widths = (len(space_cells) * len(PLANE_PAIRS) * features, HIDDEN, HIDDEN, CHANNELS)
        layers = [_layer(fan_in, fan_out, random) for fan_in, fan_out in pairwise(widths)]
        layers[-1][0].zero_()
        return cls(planes=tuple(planes), layers=tuple(layers), bounds=bounds)

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> HexPlane:
        """From parameters() and constants() in one dict."""
        levels = 1 + max(int(name.split(".")[1]) for name in tensors if name.startswith("plane."))
        names = [axes for pair in PLANE_PAIRS for axes in pair]
        depth = sum(name.startswith("layer.") for name in tensors) // 2
        return cls(
            planes=tuple({axes: tensors[f"plane.{level}.{axes}"] for axes in names} for level in range(levels)),
            layers=tuple((tensors[f"layer.{i}.weight"], tensors[f"layer.{i}.bias"]) for i in range(depth)),
            bounds=tensors["bounds"],
        )

    def features(self, position: Tensor, t: float) -> Tensor:
        """[N, 3] canonical positions -> [N, R * 3 * F] features at time t."""
        low, high = self.bounds
        unit = 2 * (position - low) / (high - low).clamp(min=1e-6) - 1  # a flat box still has a middle
        place = torch.cat([unit, torch.full_like(unit[:, :1], 2 * t - 1)], dim=1)
        return torch.cat(
            [
                _sample(level[space], space, place) * _sample(level[time], time, place)
                for level in self.planes
                for space, time in PLANE_PAIRS
            ],
            dim=1,
        )

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """The Gaussians at time t."""
        value = self.features(gaussians.mean, t)
        for weight, bias in self.layers[:-1]:
            value = relu(linear(value, weight, bias))
        weight, bias = self.layers[-1]
        return add_offsets(gaussians, linear(value, weight, bias))

    def parameters(self) -> dict[str, Tensor]:
        named = {f"plane.{i}.{axes}": plane for i, level in enumerate(self.planes) for axes, plane in level.items()}
        for i, (weight, bias) in enumerate(self.layers):
            named |= {f"layer.{i}.weight": weight, f"layer.{i}.bias": bias}
        return named

    def constants(self) -> dict[str, Tensor]:
        return {"bounds": self.bounds}

    def select(self, rows: Tensor | slice) -> HexPlane:
        del rows  # nothing here belongs to one Gaussian
        return self


def _layer(fan_in: int, fan_out: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """He's start for a layer before a ReLU."""
    return torch.randn(fan_out, fan_in, generator=random) * (2 / fan_in) ** 0.5, torch.zeros(fan_out)


def _sample(plane: Tensor, axes: str, place: Tensor) -> Tensor:
    """Bilinear value of a plane [F, rows, columns] at place [N, 4] in [-1, 1]^4: [N, F]."""
    at = place[:, [AXES.index(axes[0]), AXES.index(axes[1])]]
    sampled = grid_sample(plane[None], at[None, :, None], mode="bilinear", padding_mode="border", align_corners=True)
    return sampled[0, :, :, 0].T
