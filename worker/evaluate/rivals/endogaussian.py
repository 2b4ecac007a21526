"""`endogaussian`: Gaussians from the depth of all frames, moved by factor planes (Liu et al., 2024; own text).

Symbols: N Gaussians, M pixels, F training frames, H W pixels. docs/rivals.md lists what differs from the paper,
and why. Lengths are in optimiser units: the median depth is 60.

Small networks decode the features of a Gaussian's place and time into how far it has moved, turned, grown and faded.
The Gaussians are learnt without motion first, from the first frame, then with motion from all.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from contract.wire.errors import TrainingDiverged
from worker.evaluate.rivals.adaptive_density import AdaptiveDensity
from worker.evaluate.rivals.displacement import LOG_SCALE, MEAN, OPACITY, QUATERNION, Displacement
from worker.evaluate.rivals.fields import rays
from worker.evaluate.rivals.planes import Smoothness, mean_squared_difference
from worker.evaluate.rivals.rival import Rival, Seen, decayed, seeded, torch_threads
from worker.input.camera import Intrinsics
from worker.methods.method import DensifySettings
from worker.model.gaussians import Gaussians, initial_gaussians, sh_colour
from worker.model.loss import LossSettings, training_loss
from worker.model.metrics import COVERED_ALPHA
from worker.raster import Camera, Rendered
from worker.train.hooks import RenderedFrame
from worker.train.targets import MEDIAN_DEPTH_UNITS, camera_in_units, solid_depth_mm

PUBLISHED_LOSS = LossSettings(normalised_depth=False)
PUBLISHED_WIDTH = 640
"""Pixels. In a picture half as wide neighbours differ twice as much."""


@dataclass(frozen=True)
class EndoGaussianSettings:
    """Published values; where none is given, those of 3D and 4D Gaussian splatting. features, time_cells, hidden,
    static_share, splits_until and smoothness are ours (docs/rivals.md).

    start_share, start_most  share of each frame's measured pixels that become Gaussians, and how many they are at most
    opacity         at the start
    sh_degree       of the harmonics at the end; it rises evenly from 0
    cells, features, time_cells  of the planes, by resolution; time_cells is their most cells of time
    hidden          width of each decoder's hidden layer
    static_steps    steps without motion, the first of a training that the published steps end
    static_share    of a shorter training's time or steps; a step without motion takes less time than a later one
    densify         when and what to split and drop
    splits_until    share of the training after which nothing is split or dropped
    *_rate          of Adam; a pair is (first, last): constant while nothing moves, then it falls exponentially
    tv_weight       of the total variation of rendered colour and depth, in pictures as wide as those published
    smoothness      weights of how smooth the planes are
    """

    start_share: float = 0.01
    start_most: int = 30_000
    opacity: float = 0.1
    sh_degree: int = 3
    cells: tuple[int, ...] = (64, 128, 256)
    features: int = 16
    time_cells: int = 150
    hidden: int = 64
    static_steps: int = 1000
    static_share: float = 0.06
    densify: DensifySettings = field(default=DensifySettings())
    splits_until: float = 0.9
    mean_rate: tuple[float, float] = (1.6e-3, 1.6e-5)
    decoder_rate: tuple[float, float] = (1.6e-3, 1.6e-4)
    plane_rate: tuple[float, float] = (1.6e-2, 1.6e-3)
    quaternion_rate: float = 1e-3
    log_scale_rate: float = 5e-3
    opacity_rate: float = 5e-2
    colour_rate: float = 2.5e-3
    harmonics_rate: float = 1.25e-4
    tv_weight: float = 0.03
    smoothness: Smoothness = field(default=Smoothness(space=1e-4, time=0.0, time_l1=1e-4, acceleration=1e-2))


class EndoGaussian(Rival):
    """A training EndoGaussian."""

    not_measured = "confidence: it has none"
    published_steps = 4000

    def __init__(self, seen: Seen, seed: int, settings: EndoGaussianSettings | None = None) -> None:
        self.seed, self.settings, self._seen = seed, settings or EndoGaussianSettings(), seen
        self._scale = MEDIAN_DEPTH_UNITS / float(seen.depth_mm[seen.depth_mm > 0].median())
        self._with_tissue = seen.with_tissue
        poses = seen.world_from_camera.double().cpu().numpy()
        self._cameras = [camera_in_units(seen.intrinsics, pose, self._scale) for pose in poses]
        start = starting_gaussians(seen, self._scale, self.settings, self.generator(0))
        deformable = [start.mean, start.quaternion, start.log_scale, start.opacity_logit[:, None]]
        # copies, not views of one tensor: torch's fused Adam updates the wrong numbers of a view
        of_gaussians = [
            nn.Parameter(each.to(seen.rgb).contiguous()) for each in (*deformable, start.sh[:, :1], start.sh[:, 1:])
        ]
        *self._deformable, self._colour, self._harmonics = of_gaussians
        chosen, time_cells = self.settings, max(2, min(self.settings.time_cells, len(seen)))
        with seeded(seed):
            self.field = Displacement(chosen.cells, time_cells, chosen.features, chosen.hidden, start.mean)
        self.field.to(seen.rgb)
        of_field = [list(each.parameters()) for each in (self.field.decode, self.field.planes)]
        groups = [*([each] for each in of_gaussians), *of_field]
        self.optimizer = torch.optim.Adam([{"params": each} for each in groups], eps=1e-15, fused=True)
        self._adaptive_density = AdaptiveDensity(self.settings.densify, self.optimizer)
        self._static_until = 0.0  # share of the training at the last step without motion

    @property
    def gaussians(self) -> int:
        return len(self._colour)

    def rates(self, progress: float) -> Sequence[float]:
        chosen = self.settings
        share_since_static = (progress - self._static_until) / (1 - self._static_until)
        pairs = (chosen.mean_rate, chosen.decoder_rate, chosen.plane_rate)
        of_mean, *of_field = (decayed(each, share_since_static) for each in pairs)
        of_shapes = [chosen.quaternion_rate, chosen.log_scale_rate, chosen.opacity_rate]
        return [of_mean, *of_shapes, chosen.colour_rate, chosen.harmonics_rate, *of_field]

    def step(self, iteration: int, progress: float) -> float:
        static = self._is_static(iteration, progress)
        if static:
            self._static_until = progress
        # without motion the rasteriser's own threads do most of a step, while torch's would only spin
        with torch_threads(1) if static else nullcontext():
            loss = super().step(iteration, progress)
        if progress < self.settings.splits_until and self.settings.densify.due(iteration):
            *self._deformable, self._colour, self._harmonics = self._adaptive_density.split(self.generator(iteration))
        return loss

    def loss(self, iteration: int, progress: float) -> Tensor:
        """Of one frame: colour and inverse depth where there is tissue, and how uneven the picture is anywhere."""
        seen, frame = self._seen, self._with_tissue[0]
        static = self._is_static(iteration, progress)
        if not static:
            drawn = torch.randint(len(self._with_tissue), (), generator=self.generator(iteration))
            frame = self._with_tissue[int(drawn)]
        degree = min(self.settings.sh_degree, int((self.settings.sh_degree + 1) * progress))
        deformed = torch.cat([*self._deformable], 1) if static else self._deformed(float(seen.t[frame]))
        self._adaptive_density.watch(deformed, self._cameras[frame])
        shown = self._shown(deformed, self._cameras[frame], degree)
        depth = seen.depth_mm[frame] * self._scale
        true = seen.rgb[frame], depth, seen.tissue[frame]
        loss = training_loss(shown.rgb, shown.depth, shown.alpha, *true, PUBLISHED_LOSS).total
        tv_weight = self.settings.tv_weight * (seen.intrinsics.width / PUBLISHED_WIDTH) ** 2
        for each, axis in product((shown.rgb, shown.depth), (0, 1)):
            loss = loss + tv_weight * mean_squared_difference(each, axis, 1)
        return loss if static else loss + self.field.planes.roughness(self.settings.smoothness)

    @torch.no_grad()
    def render(self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics) -> RenderedFrame:
        camera = camera_in_units(intrinsics, world_from_camera, self._scale)
        shown = self._shown(self._deformed(t), camera, self.settings.sh_degree)
        rgb, depth, alpha = (each.float().cpu().numpy() for each in (shown.rgb, shown.depth, shown.alpha))
        return RenderedFrame(rgb, solid_depth_mm(depth, alpha, self._scale), alpha)

    @torch.no_grad()
    def motion_mm(
        self, t: float, world_from_camera: NDArray[np.float64], intrinsics: Intrinsics
    ) -> NDArray[np.float32]:
        """The displacements of the Gaussians that a pixel is blended of, blended with the same weights."""
        first, deformed = self._deformed(0.0), self._deformed(t)
        distance_mm = (deformed[:, MEAN] - first[:, MEAN]) / self._scale
        camera = camera_in_units(intrinsics, world_from_camera, self._scale)
        shown = _rasterized(first, distance_mm, camera)
        alpha = shown.alpha[..., None]
        motion = torch.where(alpha >= COVERED_ALPHA, shown.rgb / alpha.clamp(min=COVERED_ALPHA), torch.nan)
        return motion.float().cpu().numpy()

    def _is_static(self, iteration: int, progress: float) -> bool:
        """Whether a step is without motion: one of the first static_steps of a training that makes all published steps;
        of one that ends sooner, only in its first static_share. It ends sooner if progress is ahead of the share of
        the published steps that are made."""
        share, made = self.settings.static_share, iteration - 1
        in_time = self.time_share < share and (progress < share or progress <= made / self.published_steps)
        return in_time and iteration <= self.settings.static_steps

    def _deformed(self, t: float) -> Tensor:
        """Deformed Gaussians at time t: [N, DEFORMED].

        Raises:
            TrainingDiverged: a place is not finite. Torch would look it up outside the planes' memory and crash.
        """
        mean = self._deformable[0]
        if not bool(torch.isfinite(mean).all()):
            raise TrainingDiverged("A Gaussian's place is no longer a number.")
        changed: Tensor = self.field(mean, t)
        return torch.cat([*self._deformable], 1) + changed

    def _shown(self, deformed: Tensor, camera: Camera, degree: int) -> Rendered:
        """The picture of Gaussians [N, DEFORMED], with harmonics up to the degree."""
        sh = torch.cat([self._colour, self._harmonics[:, : (degree + 1) ** 2 - 1]], 1)
        direction = nn.functional.normalize(deformed[:, MEAN] - camera.centre(deformed), dim=-1)
        return _rasterized(deformed, sh_colour(sh, direction), camera)


def starting_gaussians(
    seen: Seen, units_per_mm: float, settings: EndoGaussianSettings, random: torch.Generator
) -> Gaussians:
    """Round Gaussians at measured places of all frames: the same share of each frame's pixels, drawn at random."""
    chosen = []
    for index in range(len(seen)):
        pixels = torch.nonzero(seen.depth_mm[index] > 0)
        count = min(len(pixels), max(1, round(settings.start_share * len(pixels))))
        drawn = pixels[torch.randperm(len(pixels), generator=random)[:count].to(pixels.device)]
        chosen.append(torch.cat([torch.full_like(drawn[:, :1], index), drawn], 1))
    every = torch.cat(chosen)
    kept = every[torch.randperm(len(every), generator=random)[: settings.start_most].to(every.device)]
    frame, row, column = kept.unbind(1)
    origin, direction = rays(seen.intrinsics, row, column, seen.world_from_camera[frame])
    points = units_per_mm * (origin + seen.depth_mm[frame, row, column][:, None] * direction)
    place, rgb = points.cpu().numpy(), seen.rgb[frame, row, column].cpu().numpy()
    return initial_gaussians(place, rgb, sh_degree=settings.sh_degree, opacity=settings.opacity)


def _rasterized(deformed: Tensor, colour: Tensor, camera: Camera) -> Rendered:
    """Gaussians [N, DEFORMED] of colours [N, 3], by their device's rasteriser; float64 by the reference."""
    if deformed.is_cuda:
        from worker.raster.cuda import rasterize
    elif deformed.dtype == torch.float64:
        from worker.raster.reference import rasterize
    else:
        from worker.raster.cpu import rasterize
    opacity = torch.sigmoid(deformed[:, OPACITY])
    return rasterize(deformed[:, MEAN], deformed[:, QUATERNION], deformed[:, LOG_SCALE].exp(), opacity, colour, camera)
