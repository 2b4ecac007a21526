"""What a preset says, and how one preset departs from another.

A preset is data alone; the stages of worker/pipeline.py read it. Rates are in optimiser units (median depth 60).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from worker.fusion import FusionSettings
from worker.model.deformation import motion_named
from worker.model.gaussians import MAX_SH_DEGREE
from worker.model.loss import LossSettings
from worker.model.optimize import Rates
from worker.motion.capacity import USUAL_BASES

MAX_FRAMES_A_STEP = 16
"""The GPU's kernels draw at most so many frames at once (worker/raster/cuda/bins.py)."""
MIN_START = 1e-3
"""Least opacity, spread and width at the start. An opacity is at most 1 - MIN_START, because its logit is trained."""


@dataclass(frozen=True)
class DensifySettings:
    """When Gaussians are split and pruned, and which (worker/train/densify.py).

    from_iteration      the first iteration after which it happens; statistics are gathered from the first step on
    every               iterations between two densifications
    gradient_threshold  NDC; a Gaussian whose mean gradient is above it is split
    split_into          children of one Gaussian
    min_opacity         a Gaussian below it is dropped
    max_count           no more Gaussians than this: with FDM's 17 bases and Adam's moments one takes 6.8 kB, these
                        1.4 GB; the threshold alone bounds nothing on a clip that cannot be fitted

    Raises:
        ValueError: a number out of its range.
    """

    from_iteration: int = 600
    every: int = 100
    gradient_threshold: float = 2e-4
    split_into: int = 2
    min_opacity: float = 0.005
    max_count: int = 200_000

    def __post_init__(self) -> None:
        if self.every < 1 or self.split_into < 2 or self.max_count < 1:
            raise ValueError(f"every, split_into and max_count must be at least 1, 2 and 1: {self}")
        if not (0 < self.min_opacity < 1 and self.gradient_threshold > 0):
            raise ValueError(f"min_opacity must lie in (0, 1), gradient_threshold above 0: {self}")

    def due(self, iteration: int) -> bool:
        """Whether to densify after this iteration (from 1)."""
        return iteration >= self.from_iteration and iteration % self.every == 0


@dataclass(frozen=True)
class Preset:
    """One method of training, in the order in which a clip meets its parts.

    Points
        fusion            which points become Gaussians (worker/fusion)
        points_per_image  fusion "fill" takes the grid stride that comes nearest to this many points per frame; None:
                          as far apart as the scene's detail allows
        points_by_budget  whether budget_s decides points_per_image instead (registry.preset_named)
    Motion
        deformation       name of a motion in the registry (worker/model/deformation)
        bases             B of the deformation; None: as many as the scene's motion needs (worker/motion/capacity.py)
        max_bases         limit for `bases` where the scene decides; None: no limit
        tracks            whether optical-flow tracks start the motion (deformation "shared" alone)
        start_width       sigma of a basis at the start, model time; None where the deformation has its own
    Start
        opacity           opacity of a Gaussian at the start
        spread            its standard deviation at the start over the distance to its neighbours
        sh_degree         degree of the colour's harmonics
        sh_every          iterations after which a degree is added, where sh_degree is 1 or more
    Steps
        order             "epochs": every training frame once, shuffled, again and again; "random": drawn each iteration
        frames_a_step     training frames of one iteration, which descends the sum of their losses
        both_eyes         whether a step takes both eyes of its frames, where the clip has two and options.eyes allows
        rates, loss       learning rates (worker/model/optimize.py) and the loss (worker/model/loss.py)
        densify           when Gaussians are split and pruned; None: their number stays
    Schedule and end
        warm_restarts     whether rates rise again when the iterations have doubled, if there are enough for two cycles,
                          and the last models of each are averaged (worker/train/schedule.py); else rates fall once and
                          nothing is averaged
        min_gain_db       a run with budget_s stops early where doubling its iterations gains less; None: no early
                          stopping
        iterations        of a run without budget_s and iterations; None: budget_s
        budget_s          seconds of training of a run without either

    Raises:
        ValueError: warm restarts with densification, min_gain_db without warm restarts, or a number out of its range.
    """

    name: str
    fusion: FusionSettings
    points_per_image: int | None
    points_by_budget: bool
    deformation: str
    bases: int | None
    max_bases: int | None
    tracks: bool
    start_width: float | None
    opacity: float
    spread: float
    sh_degree: int
    sh_every: int
    order: Literal["epochs", "random"]
    frames_a_step: int
    both_eyes: bool
    warm_restarts: bool
    min_gain_db: float | None
    rates: Rates
    loss: LossSettings
    densify: DensifySettings | None
    iterations: int | None
    budget_s: float | None

    def __post_init__(self) -> None:
        if self.warm_restarts and self.densify is not None:
            raise ValueError("warm_restarts average models, which differ in size with densification")
        if self.min_gain_db is not None and not self.warm_restarts:
            raise ValueError("min_gain_db compares the ends of cycles, so it needs warm_restarts")
        min_bases = motion_named(self.deformation).min_bases
        ranges: tuple[tuple[str, float, float], ...] = (
            ("bases", min_bases, math.inf),
            ("max_bases", min_bases, math.inf),
            ("points_per_image", 1, math.inf),
            ("frames_a_step", 1, MAX_FRAMES_A_STEP),
            ("sh_degree", 0, MAX_SH_DEGREE),
            ("opacity", MIN_START, 1 - MIN_START),
            ("spread", MIN_START, math.inf),
            ("start_width", MIN_START, math.inf),
        )
        for name, minimum, maximum in ranges:
            value = getattr(self, name)
            if value is not None and not minimum <= value <= maximum:
                trainable = f"{minimum:g} or more" if maximum == math.inf else f"{minimum:g} to {maximum:g}"
                raise ValueError(f"{name} is {value}, and {trainable} can be trained with")

    def with_bases(self, bases: int) -> Preset:
        """The preset with so many bases.

        Where the scene chose more than USUAL_BASES, Adam has no first moments: they gain next to nothing and take a
        third of the model's memory (docs/decisions/042).
        """
        many = self.bases is None and bases > USUAL_BASES
        return replace(self, bases=bases, rates=replace(self.rates, beta1=0.0) if many else self.rates)


@dataclass(frozen=True)
class Departure:
    """One thing that a method does otherwise than the method it started from: a few values that belong together.

    name    what the method does, for tables
    fields  values of the preset's own fields
    rates   values of preset.rates
    loss    values of preset.loss
    needs   names of the departures without which this one has no effect, or no preset can have it
    """

    name: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    rates: Mapping[str, Any] = field(default_factory=dict)
    loss: Mapping[str, Any] = field(default_factory=dict)
    needs: tuple[str, ...] = ()


def departing(preset: Preset, departures: Iterable[Departure], name: str) -> Preset:
    """The preset under another name, with the values of all departures; where two give one value, the later counts.

    Raises:
        ValueError: no preset can have these values together.
    """
    fields: dict[str, Any] = {}
    rates: dict[str, Any] = {}
    loss: dict[str, Any] = {}
    for each in departures:
        fields.update(each.fields)
        rates.update(each.rates)
        loss.update(each.loss)
    return replace(preset, name=name, rates=replace(preset.rates, **rates), loss=replace(preset.loss, **loss), **fields)


def leaving_out(departures: Iterable[Departure], name: str) -> tuple[Departure, ...]:
    """The departures without the one of this name and without those that need it, in their order.

    Raises:
        KeyError: none has this name.
    """
    listed = tuple(departures)
    gone = {each.name for each in listed if each.name == name}
    if not gone:
        raise KeyError(name)
    while more := {each.name for each in listed if gone & {*each.needs}} - gone:
        gone |= more
    return tuple(each for each in listed if each.name not in gone)
