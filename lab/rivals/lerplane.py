"""`lerplane`: a radiance field factored into planes of space and of time (Yang et al., MICCAI 2023; own text).

Symbols: M rays, S samples a ray, K intervals a ray, F training frames, H W pixels. docs/rivals.md lists what
differs from the paper, and why.

All moments share the planes of space; features of the planes of time multiply theirs. A small network decodes features,
place and time into density and colour. Two coarser fields of their own propose, one after the other, where a ray's
samples lie. Rays are drawn from all frames at once, more of them where the picture changes and where instruments often
hide the tissue.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import huber_loss

from intrasplat.camera import Intrinsics
from intrasplat.train.hooks import RenderedFrame
from lab.rivals.fields import Box, Shown, cumulated, drawn_pixels, picture, pose_tensor, rays, weights_along
from lab.rivals.planes import Planes, Smoothness
from lab.rivals.proposals import annealed, drawn_edges, interlevel_loss, lengths, middles
from lab.rivals.rival import Rival, Seen, seeded

MAX_LOG_DENSITY = 15.0
WINDOW = 2
"""Frames before and after with which a frame is compared, for the importance of its pixels."""

HUBER_DELTA = 0.2
"""The depth error in s above which its loss is linear."""

HANDED_ON = 15
"""Number of features from which colour is decoded, besides density."""

CPU_RAYS = 512
"""Rays per step on a processor, where 2048 leave time for few steps (docs/rivals.md)."""


@dataclass(frozen=True)
class LerPlaneSettings:
    """As published, or as the authors' BSD-licensed configuration says. warm_up, sharpened_by, least, most, WINDOW and
    HUBER_DELTA are ours; so is what the weights of smoothness are multiplied by (docs/rivals.md).

    cells, features     of the planes, by resolution; time_cells is their most cells of time
    proposal_samples    intervals that each proposal network looks at, one network a round
    proposal_cells, proposal_features  of the planes of each of these networks
    bins                of the one-blob encoding of place and time
    rate                of Adam: it rises for the share warm_up of the training, then falls like a cosine
    least, most         limits of a pixel's change, for its importance
    sharpened_by        share of the training in which the proposals sharpen
    """

    rays: int = 2048
    samples: int = 64
    cells: tuple[int, ...] = (64, 128, 256, 512)
    features: int = 16
    time_cells: int = 150
    proposal_samples: tuple[int, ...] = (256, 128)
    proposal_cells: tuple[int, ...] = (128,)
    proposal_features: int = 8
    hidden: int = 64
    bins: int = 4
    rate: float = 1e-2
    warm_up: float = 0.05
    sharpened_by: float = 0.1
    least: float = 0.01
    most: float = 0.1
    depth_weight: float = 1.0
    proposal_depth_weight: float = 1.0
    proposal_weight: float = 1.0
    smoothness: Smoothness = field(default=Smoothness(space=1.2e-2, time=6e-3, time_l1=3e-3, acceleration=0.15))
    proposal_smoothness: Smoothness = field(
        default=Smoothness(space=1.2e-3, time=6e-4, time_l1=3e-4, acceleration=3e-4)
    )

    @classmethod
    def on(cls, device: torch.device) -> LerPlaneSettings:
        """As published on a GPU; with a smaller batch on a processor."""
        return cls(rays=CPU_RAYS) if device.type == "cpu" else cls()


class LerPlane(Rival):
    """A training LerPlane."""

    not_measured = "motion: it has a field for each moment and no points that move; confidence: it has none"
    published_steps = 32_000

    def __init__(self, seen: Seen, seed: int, settings: LerPlaneSettings | None = None) -> None:
        self.seed, self.settings = seed, settings or LerPlaneSettings.on(seen.rgb.device)
        self._seen, self._box = seen, Box.of(seen)
        self._cumulated = cumulated(importance(seen, self.settings.least, self.settings.most))
        with seeded(seed):
            time_cells = max(2, min(self.settings.time_cells, len(seen)))
            self.field = _PlaneField(self.settings, time_cells).to(seen.rgb)
            rounds = self.settings.proposal_samples
            self.proposals = [_Proposal(self.settings, time_cells).to(seen.rgb) for _ in rounds]
        every = [each for net in (self.field, *self.proposals) for each in net.parameters()]
        self.optimizer = torch.optim.Adam(every, eps=1e-15, fused=True)  # a cell of a fine plane has tiny gradients

    def rates(self, progress: float) -> Sequence[float]:
        warm_up = self.settings.warm_up
        if progress < warm_up:
            return [self.settings.rate * (0.01 + 0.99 * progress / warm_up)]
        return [self.settings.rate * 0.5 * (1 + math.cos(math.pi * (progress - warm_up) / (1 - warm_up)))]

    def loss(self, iteration: int, progress: float) -> Tensor:
        """Colour, depth, proposals, and how rough the planes are."""
        seen, chosen, random = self._seen, self.settings, self.generator(iteration)
        drawn = drawn_pixels(self._cumulated, chosen.rays, random)
        height, width = seen.tissue.shape[1:]
        frame, row, column = drawn // (height * width), drawn // width % height, drawn % width
        origin, direction = rays(seen.intrinsics, row, column, seen.world_from_camera[frame])
        sharpness = annealed(progress / chosen.sharpened_by)
        (rgb, _, _), rounds = self._shown(origin, direction, seen.t[frame], sharpness, random)
        depth_mm = seen.depth_mm[frame, row, column]
        known, true_share = depth_mm > 0, self._box.share_of(depth_mm.clamp(min=1e-3))
        loss = (rgb - seen.rgb[frame, row, column]).square().mean()
        depth_weights = [chosen.proposal_depth_weight] * len(self.proposals) + [chosen.depth_weight]
        for (edges, weight), of_depth in zip(rounds, depth_weights, strict=True):
            error = huber_loss((weight * middles(edges)).sum(1), true_share, reduction="none", delta=HUBER_DELTA)
            loss = loss + of_depth * torch.where(known, error, 0.0).sum() / known.sum().clamp(min=1)
        *proposed, (edges, weight) = rounds
        for each in proposed:
            loss = loss + chosen.proposal_weight * interlevel_loss(edges, weight.detach(), *each)
        return loss + self._roughness()

    @torch.no_grad()
    def render(self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics) -> RenderedFrame:
        pose = pose_tensor(world_from_camera, self._seen.rgb)

        def show(part: slice, origin: Tensor, direction: Tensor) -> Shown:
            del part
            return self._shown(origin, direction, torch.full_like(origin[:, 0], t), 1.0, None)[0]

        most = max(self.settings.samples, *self.settings.proposal_samples)
        return picture(self._box, intrinsics, pose, show, most)

    def _shown(
        self, origin: Tensor, direction: Tensor, t: Tensor, sharpness: float, random: torch.Generator | None
    ) -> tuple[Shown, list[tuple[Tensor, Tensor]]]:
        """What is shown by rays at times [M], and each round's edges [M, K + 1] and weights [M, K], the field's last.

        random: jitters the intervals' edges; None: no jitter.
        """
        edges = origin.new_tensor([0.0, 1.0]).expand(len(origin), 2)
        weight, rounds = torch.ones_like(edges[:, :1]), []
        for count, proposal in zip(self.settings.proposal_samples, self.proposals, strict=True):
            edges = drawn_edges(edges, weight.detach() ** sharpness, count, random)
            place = self._places(origin, direction, edges)
            density = proposal(place, t.repeat_interleave(count)).reshape(-1, count)
            weight = weights_along(density, lengths(edges))
            rounds.append((edges, weight))
        edges = drawn_edges(edges, weight.detach() ** sharpness, self.settings.samples, random)
        place = self._places(origin, direction, edges)
        density, rgb = self.field(place, t.repeat_interleave(self.settings.samples))
        s = middles(edges)
        weight = weights_along(density.reshape(s.shape), lengths(edges))
        colour = (weight[..., None] * rgb.reshape(*s.shape, 3)).sum(1)
        return (colour, (weight * s).sum(1), weight.sum(1)), [*rounds, (edges, weight)]

    def _places(self, origin: Tensor, direction: Tensor, edges: Tensor) -> Tensor:
        """The middles of the intervals in the box, [M K, 3]."""
        depth_mm = self._box.depth_mm(middles(edges))
        return self._box.place(origin[:, None] + depth_mm[..., None] * direction[:, None]).flatten(0, 1)

    def _roughness(self) -> Tensor:
        found = self.field.planes.roughness(self.settings.smoothness)
        for proposal in self.proposals:
            found = found + proposal.planes.roughness(self.settings.proposal_smoothness)
        return found


def importance(seen: Seen, least: float, most: float) -> Tensor:
    """[F, H, W] weight with which a pixel is drawn: the difference of its colour from neighbouring frames, clamped to
    [least, most], divided by how often it shows tissue; 0 where it does not. Instruments are black, so tissue that
    they hide in a neighbouring frame counts as changed."""
    shown = seen.rgb * seen.tissue[..., None]
    weight = torch.empty_like(seen.depth_mm)
    often = seen.tissue.sum(0).clamp(min=1) / len(seen)
    for frame in range(len(seen)):
        around = [i for i in range(max(0, frame - WINDOW), min(len(seen), frame + WINDOW + 1)) if i != frame]
        changes = [(shown[frame] - shown[other]).abs().mean(-1) for other in around] or [torch.zeros_like(often)]
        weight[frame] = torch.stack(changes).mean(0).clamp(least, most) / often * seen.tissue[frame]
    return weight


class _Proposal(nn.Module):
    """Densities [M] at places [M, 3] and times [M]."""

    def __init__(self, settings: LerPlaneSettings, time_cells: int) -> None:
        super().__init__()
        self.planes = Planes(settings.proposal_cells, time_cells, settings.proposal_features)
        self.decode = nn.Sequential(
            nn.Linear(self.planes.size, settings.hidden), nn.ReLU(), nn.Linear(settings.hidden, 1)
        )

    def forward(self, place: Tensor, t: Tensor) -> Tensor:
        return _density(self.decode(self.planes(place, t))[:, 0])


class _PlaneField(nn.Module):
    """Densities [M] and colours [M, 3] at places [M, 3] and times [M]."""

    def __init__(self, settings: LerPlaneSettings, time_cells: int) -> None:
        super().__init__()
        self.bins, hidden = settings.bins, settings.hidden
        self.planes = Planes(settings.cells, time_cells, settings.features)
        given = self.planes.size + 4 * settings.bins
        self.decode = nn.Sequential(nn.Linear(given, hidden), nn.ReLU(), nn.Linear(hidden, 1 + HANDED_ON))
        colour = nn.Linear(HANDED_ON, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 3)
        self.colour = nn.Sequential(*colour, nn.Sigmoid())

    def forward(self, place: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        at = torch.cat([(place + 1) / 2, t[:, None]], 1)
        centres = (torch.arange(self.bins).to(at) + 0.5) / self.bins
        blobs = torch.exp(-0.5 * ((at[..., None] - centres) * self.bins).square()).flatten(1)
        decoded = self.decode(torch.cat([self.planes(place, t), blobs], 1))
        return _density(decoded[:, 0]), self.colour(decoded[:, 1:])


def _density(raw: Tensor) -> Tensor:
    return torch.exp(raw.clamp(max=MAX_LOG_DENSITY))
