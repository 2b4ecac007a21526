"""`endonerf`: a canonical radiance field and a network that displaces into it (Wang et al., MICCAI 2022; own text).

Symbols: M rays, S samples a ray, H W pixels. docs/rivals.md lists what differs from the paper, and why.

A place x at time t looks up colour and density at x + G(x, t). Rays are drawn where there is tissue, more of them where
instruments often hide it; samples of a ray lie about the measured depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from intrasplat.camera import Intrinsics
from intrasplat.stereo.right_eye import nearest_known
from intrasplat.train.hooks import RenderedFrame
from lab.evaluate.thinned import dense_camera, lattice
from lab.rivals.fields import SOLID, Box, Shown, cumulated, drawn_pixels, picture, pose_tensor, rays, weights_along
from lab.rivals.rival import Rival, Seen, decayed, seeded

GUIDES = 8
"""Training frames nearest in time whose depth guides the rays of a render."""

CPU_RAYS = 128
"""Rays per step on a processor, where 2048 leave time for few steps (docs/rivals.md)."""


@dataclass(frozen=True)
class EndoNerfSettings:
    """Published values, but the octaves are D-NeRF's, and spread, last_rate and the unit s are ours (docs/rivals.md).

    spread         standard deviation of the samples about the depth, in s
    space_octaves, time_octaves, view_octaves  of the positional encodings
    rate           of Adam; it falls exponentially to last_rate
    depth_weight   of |depth error|, in s, beside the squared colour error
    refined_from   progress from which the depth of the refined_share of a batch's rays that fit worst is replaced
    """

    rays: int = 2048
    samples: int = 64
    layers: int = 8
    width: int = 256
    spread: float = 0.02
    space_octaves: int = 10
    time_octaves: int = 4
    view_octaves: int = 4
    rate: float = 5e-4
    last_rate: float = 5e-5
    depth_weight: float = 1.0
    refined_from: float = 0.04
    refined_share: float = 0.01

    @classmethod
    def on(cls, device: torch.device) -> EndoNerfSettings:
        """As published on a GPU; with a smaller batch on a processor."""
        return cls(rays=CPU_RAYS) if device.type == "cpu" else cls()


class EndoNerf(Rival):
    """A training EndoNeRF."""

    not_measured = "motion: it maps each moment to the canonical one, not back; confidence: it has none"
    published_steps = 100_000

    def __init__(self, seen: Seen, seed: int, settings: EndoNerfSettings | None = None) -> None:
        self.seed, self.settings = seed, settings or EndoNerfSettings.on(seen.rgb.device)
        self._seen, self._box = seen, Box.of(seen)
        hidden = (~seen.tissue).sum(0).to(seen.rgb)
        self._importance = 1 + hidden / hidden.norm().clamp(min=1e-9)
        self._guide_share = self._box.share_of(seen.depth_mm.clamp(min=1e-3))
        self._has_depth = seen.depth_mm > 0
        self._refinable = int(self.settings.refined_share * self._has_depth.sum())
        self._with_tissue = seen.with_tissue
        with seeded(seed):
            self.field = _CanonicalField(self.settings).to(seen.rgb)
        self.optimizer = torch.optim.Adam(self.field.parameters(), fused=True)

    def rates(self, progress: float) -> Sequence[float]:
        return [decayed((self.settings.rate, self.settings.last_rate), progress)]

    def loss(self, iteration: int, progress: float) -> Tensor:
        """The loss of rays of one frame: mean squared colour error, and mean depth error where depth is known."""
        seen, random = self._seen, self.generator(iteration)
        frame = self._with_tissue[int(torch.randint(len(self._with_tissue), (), generator=random))]
        drawn = drawn_pixels(cumulated(self._importance * seen.tissue[frame]), self.settings.rays, random)
        width = seen.intrinsics.width
        row, column = drawn // width, drawn % width
        origin, direction = rays(seen.intrinsics, row, column, seen.world_from_camera[frame])
        known = self._has_depth[frame, row, column]
        guide_share = self._guide_share[frame, row, column]
        evenly = torch.rand(len(row), self.settings.samples, generator=random)
        noise = torch.randn(evenly.shape, generator=random).to(guide_share)
        guided = (guide_share[:, None] + self.settings.spread * noise).clamp(0, 1)
        s = torch.where(known[:, None], guided, evenly.to(guide_share)).sort(-1).values
        rgb, depth_share, _ = self._shown(origin, direction, s, float(seen.t[frame]))
        colour = (rgb - seen.rgb[frame, row, column]).square().mean()
        error = torch.where(known, (depth_share - guide_share).abs(), 0.0)
        if progress >= self.settings.refined_from and self._refinable:
            self._refine(frame, row, column, depth_share.detach(), error.detach())
        return colour + self.settings.depth_weight * error.sum() / known.sum().clamp(min=1)

    @torch.no_grad()
    def render(self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics) -> RenderedFrame:
        """As lab/rivals/rival.py says. Samples lie about the depth of the frames nearest in time."""
        pose = pose_tensor(world_from_camera, self._seen.rgb)
        guide_share = self._box.share_of(self._guide_mm(t, pose, intrinsics)).flatten()
        quantiles = (torch.arange(self.settings.samples).to(guide_share) + 0.5) / self.settings.samples
        offsets = self.settings.spread * math.sqrt(2) * torch.erfinv(2 * quantiles - 1)

        def show(part: slice, origin: Tensor, direction: Tensor) -> Shown:
            return self._shown(origin, direction, (guide_share[part, None] + offsets).clamp(0, 1), t)

        return picture(self._box, intrinsics, pose, show, self.settings.samples)

    def _shown(self, origin: Tensor, direction: Tensor, s: Tensor, t: float) -> Shown:
        """What is shown by rays whose samples lie at ascending s [M, S]."""
        points_mm = origin[:, None] + self._box.depth_mm(s)[..., None] * direction[:, None]
        view = torch.nn.functional.normalize(direction, dim=-1)[:, None].expand_as(points_mm)
        density, rgb = self.field(self._box.place(points_mm).flatten(0, 1), t, view.flatten(0, 1))
        length = torch.cat([s[:, 1:] - s[:, :-1], torch.full_like(s[:, :1], SOLID)], 1)
        weight = weights_along(density.reshape(s.shape), length / self.settings.spread)
        return (weight[..., None] * rgb.reshape(*s.shape, 3)).sum(1), (weight * s).sum(1), weight.sum(1)

    def _refine(self, frame: int, row: Tensor, column: Tensor, depth_share: Tensor, error: Tensor) -> None:
        """Replace depth by the field's at the share of these rays that differ most, until _refinable is used up."""
        worst = torch.nonzero(error > torch.quantile(error, 1 - self.settings.refined_share))[: self._refinable, 0]
        self._refinable -= len(worst)
        self._guide_share[frame, row[worst], column[worst]] = depth_share[worst].clamp(0, 1)

    def _guide_mm(self, t: float, pose: Tensor, camera: Intrinsics) -> Tensor:
        """[H, W] depth of the training frames nearest in time, seen from the pose; gaps take a neighbour's. A camera
        thinned to a lattice gets the guide that the full camera has at those pixels."""
        seen = self._seen
        step_px = max(1, round(seen.intrinsics.fx / camera.fx))
        camera = dense_camera(camera, step_px)
        found = np.zeros((camera.height, camera.width), np.float32)
        camera_from_world = torch.linalg.inv(pose.double())
        order = torch.argsort((seen.t - t).abs(), stable=True).tolist()
        for frame in order[:GUIDES]:
            row, column = torch.nonzero(self._has_depth[frame], as_tuple=True)
            origin, direction = rays(seen.intrinsics, row, column, seen.world_from_camera[frame])
            depth_mm = self._box.depth_mm(self._guide_share[frame, row, column])
            points_mm = (origin + depth_mm[:, None] * direction).double()
            x, y, z = (points_mm @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]).cpu().numpy().T
            ahead = z > 1.0
            z, x, y = z[ahead], x[ahead] / z[ahead], y[ahead] / z[ahead]
            i, j = np.floor(camera.fy * y + camera.cy).astype(int), np.floor(camera.fx * x + camera.cx).astype(int)
            inside = (i >= 0) & (i < camera.height) & (j >= 0) & (j < camera.width)
            nearest = np.full(found.shape, np.inf, np.float32)
            np.minimum.at(nearest, (i[inside], j[inside]), z[inside].astype(np.float32))
            found = np.where((found == 0) & np.isfinite(nearest), nearest, found)
        filled = nearest_known(found, found > 0)
        return torch.from_numpy(np.where(filled > 0, filled, self._box.far_mm)[lattice(step_px)]).to(seen.rgb)


class _Trunk(nn.Module):
    """Linear layers with ReLU; the input joins the output of the fifth of eight again, as in NeRF."""

    def __init__(self, size: int, layers: int, width: int) -> None:
        super().__init__()
        self.again = layers // 2 + 1
        ins = [size if k == 0 else width + size * (k == self.again) for k in range(layers)]
        self.layers = nn.ModuleList([nn.Linear(each, width) for each in ins])

    def forward(self, given: Tensor) -> Tensor:
        value = given
        for k, layer in enumerate(self.layers):
            value = torch.relu_(layer(torch.cat([value, given], 1) if k == self.again else value))
        return value


class _CanonicalField(nn.Module):
    """Places [M, 3] at a time, seen along view [M, 3]: densities [M], colours [M, 3]."""

    def __init__(self, settings: EndoNerfSettings) -> None:
        super().__init__()
        self.settings, width = settings, settings.width
        space, time = 3 * (1 + 2 * settings.space_octaves), 1 + 2 * settings.time_octaves
        self.displace = _Trunk(space + time, settings.layers, width)
        self.displacement = nn.Linear(width, 3)
        nn.init.zeros_(self.displacement.weight)  # else the first displacements scramble the encoded places
        nn.init.zeros_(self.displacement.bias)
        self.trunk = _Trunk(space, settings.layers, width)
        self.density, self.feature = nn.Linear(width, 1), nn.Linear(width, width)
        self.branch = nn.Linear(width + 3 * (1 + 2 * settings.view_octaves), width // 2)
        self.colour = nn.Linear(width // 2, 3)

    def forward(self, place: Tensor, t: float, view: Tensor) -> tuple[Tensor, Tensor]:
        octaves = self.settings.space_octaves
        if t > 0:  # the moment t = 0 is the canonical one, as in D-NeRF
            time = _encoded(torch.full_like(place[:, :1], 2 * t - 1), self.settings.time_octaves)
            place = place + self.displacement(self.displace(torch.cat([_encoded(place, octaves), time], 1)))
        known = self.trunk(_encoded(place, octaves))
        branch = self.branch(torch.cat([self.feature(known), _encoded(view, self.settings.view_octaves)], 1))
        return torch.nn.functional.softplus(self.density(known))[:, 0], torch.sigmoid(self.colour(torch.relu_(branch)))


def _encoded(value: Tensor, octaves: int) -> Tensor:
    """[M, D] with sines and cosines of value 2^k, k < octaves: [M, D (1 + 2 octaves)]."""
    angle = torch.cat([value * 2.0**k for k in range(octaves)], 1)
    return torch.cat([value, torch.sin(angle), torch.cos(angle)], 1)
