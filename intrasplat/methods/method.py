"""`Preset`, all settings of a method, and `Departure`, a difference of one preset from another.

A preset contains only data, which the stages of intrasplat/pipeline.py read. Rates are in optimiser units (median
depth 60).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from intrasplat.fusion import FusionSettings
from intrasplat.motion.capacity import USUAL_BASES
from intrasplat.splat.deformation import motion_named
from intrasplat.splat.gaussians import MAX_SH_DEGREE
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.optimize import Rates

MAX_FRAMES_A_STEP = 16
"""The most frames that the GPU's kernels render at once (intrasplat/splat/cuda/bins.py)."""
MIN_START = 1e-3
"""Least initial opacity, spread and width. An opacity is at most 1 - MIN_START, because its logit must be finite."""


@dataclass(frozen=True)
class DensifySettings:
    """When Gaussians are split and pruned, and which (intrasplat/train/densify.py).

    from_iteration      the first iteration that may densify; statistics are gathered from the first step on
    every               iterations between two densifications
    gradient_threshold  NDC; a Gaussian with a greater mean gradient is split
    split_into          children of one Gaussian
    min_opacity         a Gaussian below it is removed
    max_count           limit of Gaussians: with FDM's 17 bases and Adam's moments one takes 6.8 kB, so many 1.4 GB. On
                        a clip that cannot be fitted, the threshold alone does not bound their number.

    Raises:
        ValueError: a number is out of its range.
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
        fusion            which points become Gaussians (intrasplat/fusion)
        points_per_image  fusion "fill" takes the grid stride that comes nearest to this many points per frame; None:
                          the widest stride that the scene's detail allows
        points_by_budget  whether budget_s decides points_per_image instead (registry.preset_named)
    Motion
        deformation       name of a motion in the registry (intrasplat/splat/deformation)
        bases             B of the deformation; None: as many as the scene's motion needs (motion/capacity.py)
        max_bases         limit of `bases` where the scene decides; None: no limit
        tracks            whether optical-flow tracks initialise the motion (only deformation "shared")
        start_width       initial sigma of a basis, model time; None: the deformation's own
    Start
        opacity           initial opacity of a Gaussian
        spread            its initial standard deviation over the distance to its neighbours
        sh_degree         degree of the colour's spherical harmonics
        sh_every          iterations after which a degree is added, where sh_degree is 1 or more
    Steps
        order             "epochs": every training frame once, shuffled, then again; "random": drawn each iteration
        frames_a_step     training frames of one iteration, which minimises the sum of their losses
        both_eyes         whether a step uses both eyes of its frames, where the clip has two and options.eyes allows it
        rates, loss       learning rates (intrasplat/splat/optimize.py) and the loss (intrasplat/splat/loss.py)
        densify           when Gaussians are split and pruned; None: their number stays the same
    Schedule and end
        warm_restarts     whether rates rise again each time the iterations have doubled, if they suffice for two
                          cycles, and the last models of a cycle are averaged (intrasplat/train/schedule.py); else
                          rates fall once and nothing is averaged
        min_gain_db       early stopping: a run with budget_s ends if doubling its iterations gains less; None: never
        iterations        number of iterations if a request gives neither budget_s nor iterations; None: budget_s counts
        budget_s          seconds of training if a request gives neither

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
        third of the model's memory (docs/decisions/motion.md).
        """
        many = self.bases is None and bases > USUAL_BASES
        return replace(self, bases=bases, rates=replace(self.rates, beta1=0.0) if many else self.rates)


@dataclass(frozen=True)
class Departure:
    """One difference of a method from the method it is based on: a few values that belong together.

    name    what the method does, for tables
    fields  new values of the preset's own fields
    rates   new values in preset.rates
    loss    new values in preset.loss
    needs   names of the departures without which this one has no effect or is invalid
    """

    name: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    rates: Mapping[str, Any] = field(default_factory=dict)
    loss: Mapping[str, Any] = field(default_factory=dict)
    needs: tuple[str, ...] = ()


def departing(preset: Preset, departures: Iterable[Departure], name: str) -> Preset:
    """The preset under another name, with the values of all departures; where two set one value, the later wins.

    Raises:
        ValueError: the values are invalid together.
    """
    fields: dict[str, Any] = {}
    rates: dict[str, Any] = {}
    loss: dict[str, Any] = {}
    for each in departures:
        fields.update(each.fields)
        rates.update(each.rates)
        loss.update(each.loss)
    return replace(preset, name=name, rates=replace(preset.rates, **rates), loss=replace(preset.loss, **loss), **fields)
