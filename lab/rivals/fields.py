"""What radiance fields share: the box that the clip shows, rays, and what a ray gathers.

Symbols: M points or rays, S samples a ray.

A place in the box is [-1, 1]^3: x / z and y / z of the first camera from least to greatest, and 1 / z without the
outermost 0.1 % at either end, each with 5 % of its range beyond. Pixels of an endoscope at rest are columns of it, as
in the normalised device coordinates of the papers. A place on a ray is its share s in [0, 1] of the ray, even in 1 / z
of the ray's own camera: from the nearest depth of the training frames to the farthest, without the outermost 0.1 % at
either end and with 5 % of that range beyond it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.camera import Intrinsics
from intrasplat.train.hooks import RenderedFrame
from intrasplat.train.targets import solid_depth_mm
from lab.rivals.rival import Seen

MARGIN = 0.05
"""Margin on each side, as a share of the box's size."""
SOLID = 1e10
"""Length of a ray's last sample: whatever is dense there ends the ray."""
OUTLIERS = 0.001
"""Share of the depths beyond each end of the box."""
RENDERED_SAMPLES = {"cpu": 1 << 16, "gpu": 1 << 20}
"""At a time: a processor's caches hold what few samples need, a GPU wants many."""
MAX_SAMPLED = 1 << 20
"""Pixels that decide the box: torch.quantile takes no more than 2^24."""


@dataclass(frozen=True, eq=False)
class Box:
    """low, high [3]: x / z, y / z, 1 / z (1 / mm) at -1 and 1; near_mm and far_mm: depths of a ray at s = 0 and 1."""

    low: Tensor
    high: Tensor
    near_mm: float
    far_mm: float

    @classmethod
    def of(cls, seen: Seen) -> Box:
        """The box of what is measured in the training frames, without OUTLIERS in depth, with a MARGIN."""
        frame, row, column = torch.nonzero(seen.depth_mm > 0, as_tuple=True)
        some = torch.arange(0, len(frame), 1 + len(frame) // MAX_SAMPLED, device=frame.device)
        frame, row, column = frame[some], row[some], column[some]
        origin, direction = rays(seen.intrinsics, row, column, seen.world_from_camera[frame])
        depth_mm = seen.depth_mm[frame, row, column]
        place = _projected(origin + depth_mm[:, None] * direction)
        ends = place.new_tensor([OUTLIERS, 1 - OUTLIERS])
        inverse_farthest, inverse_nearest = torch.quantile(place[:, 2], ends).unbind()
        low = torch.stack([*place[:, :2].amin(0).unbind(), inverse_farthest])
        high = torch.stack([*place[:, :2].amax(0).unbind(), inverse_nearest])
        room = MARGIN * (high - low).clamp(min=1e-6)
        inverse_far, inverse_near = torch.quantile(1 / depth_mm, ends).tolist()
        beyond = MARGIN * max(inverse_near - inverse_far, 0.01 * inverse_near)  # one depth alone needs a range, too
        far_mm = 1 / max(inverse_far - beyond, 0.1 * inverse_far)  # never beyond infinity
        return cls(low - room, high + room, 1 / (inverse_near + beyond), far_mm)

    def place(self, points_mm: Tensor) -> Tensor:
        """World points [..., 3] in the box, beyond [-1, 1] where they lie outside."""
        return 2 * (_projected(points_mm) - self.low) / (self.high - self.low) - 1

    def depth_mm(self, s: Tensor) -> Tensor:
        """Camera z at s."""
        return 1 / (1 / self.near_mm + s * (1 / self.far_mm - 1 / self.near_mm))

    def share_of(self, depth_mm: Tensor) -> Tensor:
        """s in [0, 1] of a camera z."""
        return ((1 / depth_mm - 1 / self.near_mm) / (1 / self.far_mm - 1 / self.near_mm)).clamp(0, 1)


def _projected(points_mm: Tensor) -> Tensor:
    """x / z, y / z, 1 / z; z is at least 1 mm."""
    inverse = 1 / points_mm[..., 2:].clamp(min=1.0)
    return torch.cat([points_mm[..., :2] * inverse, inverse], -1)


def rays(camera: Intrinsics, row: Tensor, column: Tensor, world_from_camera: Tensor) -> tuple[Tensor, Tensor]:
    """Origins and directions [M, 3] of pixels [M], in the world; a direction is as long as one mm of depth.

    world_from_camera is [M, 4, 4] or [4, 4].
    """
    x = (column.to(world_from_camera) + 0.5 - camera.cx) / camera.fx
    y = (row.to(world_from_camera) + 0.5 - camera.cy) / camera.fy
    local = torch.stack([x, y, torch.ones_like(x)], -1)
    direction = (world_from_camera[..., :3, :3] @ local[..., None])[..., 0]
    return world_from_camera[..., :3, 3].expand_as(direction), direction


def weights_along(density: Tensor, length: Tensor) -> Tensor:
    """[M, S] share of each sample in what a ray shows, from densities and the lengths, in any unit, they hold for."""
    alpha = 1 - torch.exp(-density * length)
    through = torch.cumprod(1 - alpha + 1e-10, -1)
    return alpha * torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], -1)


def cumulated(weight: Tensor) -> Tensor:
    """The cumulative sum of weights of any shape, for drawn_pixels."""
    return torch.cumsum(weight.flatten().double(), 0)


def drawn_pixels(total: Tensor, count: int, random: torch.Generator) -> Tensor:
    """[count] indices of the flat weights that were cumulated(), drawn with probabilities in proportion to them."""
    drawn = torch.rand(count, generator=random, dtype=torch.float64).to(total.device) * total[-1]
    return torch.searchsorted(total, drawn, right=True).clamp(max=total.numel() - 1)


Shown = tuple[Tensor, Tensor, Tensor]
"""What rays show: colour [M, 3], sum(w s) [M] and sum(w) [M]."""


def picture(
    box: Box, camera: Intrinsics, pose: Tensor, show: Callable[[slice, Tensor, Tensor], Shown], samples: int
) -> RenderedFrame:
    """The picture of a camera at world_from_camera [4, 4].

    show: what rays show, given which of all pixels (row by row) they belong to, their origins and their directions.
    samples: a ray has at most; they decide how many rays are shown at a time.
    """
    at_a_time = max(1, RENDERED_SAMPLES["cpu" if pose.device.type == "cpu" else "gpu"] // samples)
    pixel = torch.arange(camera.height * camera.width, device=pose.device)
    origin, direction = rays(camera, pixel // camera.width, pixel % camera.width, pose)
    parts = []
    for first in range(0, len(pixel), at_a_time):
        part = slice(first, first + at_a_time)
        rgb, depth_share, alpha = show(part, origin[part], direction[part])
        depth_mm = box.depth_mm(depth_share / alpha.clamp(min=1e-6)) * alpha
        parts.append(torch.cat([rgb, depth_mm[:, None], alpha[:, None]], 1))
    image = torch.cat(parts).float().cpu().numpy().reshape(camera.height, camera.width, 5)
    return RenderedFrame(image[..., :3], solid_depth_mm(image[..., 3], image[..., 4], 1.0), image[..., 4])


def pose_tensor(world_from_camera: NDArray[np.float64], like: Tensor) -> Tensor:
    """[4, 4] as a tensor of like's dtype and device."""
    return torch.from_numpy(np.ascontiguousarray(world_from_camera)).to(like)
