"""What distinguishes the ways of training: ours, `instant`, `fast`, `quality`, `small`; `paper`, its variants, rivals.

A preset is data only; train.py reads it. Rates are in optimiser units (median depth 60).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

from contract.wire.errors import InputError
from worker.fusion import FusionSettings
from worker.model.deformation import GaussianFdm, HexPlane, PolynomialFourier, QuarticFdm, SharedBasis, motion_named
from worker.model.gaussians import MAX_SH_DEGREE
from worker.model.loss import LossSettings
from worker.model.optimize import Rate, Rates
from worker.train.densify import DensifySettings


@dataclass(frozen=True)
class Preset:
    """One way of training.

    fusion           which points become Gaussians
    points_per_image "fill" fusion takes the grid stride that comes nearest to this many points a frame; None: as far
                     apart as the scene's detail allows
    points_by_budget whether a run with budget_s takes as many points as pay within it instead
    deformation      name of a motion in the registry (worker/model/deformation)
    bases            B of the deformation; None: as many as the scene's motion needs ("shared" alone)
    most_bases       of those the scene may choose; None: as many as there are to choose from
    tracks           whether optical-flow tracks start the motion ("shared" only)
    start_width      sigma at the start, model time; None where the deformation places its own
    opacity, spread  of a Gaussian at the start; spread is its standard deviation over the distance to its neighbours
    sh_degree        of the colour; from 1 on, a degree is added every sh_every iterations
    order            "epochs": every training frame once, shuffled, again and again; "random": drawn each iteration
    frames_a_step    training frames of which an iteration sees so many: one step down the sum of their losses
    cycles           whether rates rise again when the steps have doubled, if there are enough for two cycles, and the
                     last models of each are averaged (schedule.py); else rates fall once and nothing is averaged
    worth_db         a run with budget_s ends where a doubling of its steps is worth less; None: never before its time
    iterations       of a run without budget_s and iterations; None: budget_s
    budget_s         seconds of training of a run without either

    Raises:
        ValueError: cycles with densification, worth_db without cycles, or a number that nothing can be trained with.
    """

    name: str
    fusion: FusionSettings
    points_per_image: int | None
    points_by_budget: bool
    deformation: str
    bases: int | None
    most_bases: int | None
    tracks: bool
    start_width: float | None
    opacity: float
    spread: float
    sh_degree: int
    sh_every: int
    order: Literal["epochs", "random"]
    frames_a_step: int
    cycles: bool
    worth_db: float | None
    rates: Rates
    loss: LossSettings
    densify: DensifySettings | None
    iterations: int | None
    budget_s: float | None

    def __post_init__(self) -> None:
        if self.cycles and self.densify is not None:
            raise ValueError("cycles end in an average of models, which are not of one size with densification")
        if self.worth_db is not None and not self.cycles:
            raise ValueError("worth_db compares the ends of cycles, so it needs cycles")
        least_bases = motion_named(self.deformation).min_bases
        ranges: tuple[tuple[str, float, float], ...] = (
            ("bases", least_bases, math.inf),
            ("most_bases", least_bases, math.inf),
            ("points_per_image", 1, math.inf),
            ("frames_a_step", 1, MOST_FRAMES_A_STEP),
            ("sh_degree", 0, MAX_SH_DEGREE),
            ("opacity", SMALLEST, 1 - SMALLEST),
            ("spread", SMALLEST, math.inf),
            ("start_width", SMALLEST, math.inf),
        )
        for name, least, most in ranges:
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                trainable = f"{least:g} or more" if most == math.inf else f"{least:g} to {most:g}"
                raise ValueError(f"{name} is {value}, and {trainable} can be trained with")


MOST_FRAMES_A_STEP = 16
"""As many as a GPU's kernels draw at once (worker/raster/cuda/bins.py)."""
SMALLEST = 1e-3
"""Of an opacity, a spread and a width at the start; an opacity stays as far below 1, for its logit is trained."""
FEWEST_POINTS, FEW_POINTS, MANY_POINTS = 20_000, 40_000, 80_000
PAYS_FROM_S = 9.0
"""From this budget on, twice the points are worth the time they take (docs/decisions/015)."""

_PAPER_ITERATIONS = 3000
_PAPER_DECAY = (1.6e-3, 5.06e-5)
"""1.6e-3 falling log-linearly to a hundredth over 4000 steps, of which 3000 are made: 1.6e-3 * 0.01**(3000 / 4000)."""
_PAPER_RATES = Rates(
    mean=Rate(*_PAPER_DECAY),
    quaternion=Rate(1e-3),
    log_scale=Rate(5e-3),
    opacity=Rate(5e-2),
    colour=Rate(2.5e-3),
    sh_rest=Rate(1.25e-4),
    motion_mean=Rate(*_PAPER_DECAY),
    motion_quaternion=Rate(*_PAPER_DECAY),
    motion_log_scale=Rate(*_PAPER_DECAY),
    motion_colour=Rate(0.0),
)

_PAPER = Preset(
    name="paper",
    fusion=FusionSettings(mode="paper"),
    points_per_image=None,
    points_by_budget=False,
    deformation=GaussianFdm.kind,
    bases=17,
    most_bases=None,
    tracks=False,
    start_width=0.01,
    opacity=0.1,
    spread=1.0,
    sh_degree=3,
    sh_every=500,
    order="random",
    frames_a_step=1,
    cycles=False,
    worth_db=None,
    rates=_PAPER_RATES,
    loss=LossSettings(normalised_depth=False),
    densify=DensifySettings(),
    iterations=_PAPER_ITERATIONS,
    budget_s=None,
)

# Found on d4d_endonerf and on synthetic clips (docs/decisions/005 and 015): the published rates of motion are some
# thirty times too slow for a run of hundreds of steps, and Adam's moments remember too long, for successive steps see
# frames from all over the clip.
_FAST_RATES = Rates(
    mean=Rate(1.6e-3, 5e-5),
    quaternion=Rate(1e-2, 3e-3),
    log_scale=Rate(2e-2, 6e-3),
    opacity=Rate(5e-2, 1.5e-2),
    colour=Rate(2.5e-2, 6e-3),
    sh_rest=Rate(0.0),
    motion_mean=Rate(1.5e-2, 1.5e-3),
    motion_quaternion=Rate(5e-2, 5e-3),
    motion_log_scale=Rate(5e-2, 5e-3),
    motion_colour=Rate(5e-2, 5e-3),
    beta1=0.3,
    beta2=0.95,
)

# A quarter of the Gaussians, half the bases and no change of size: what loses least for each byte (docs/decisions/017)
_SMALL_RATES = replace(_FAST_RATES, motion_log_scale=Rate(0.0))

_FAST = Preset(
    name="fast",
    fusion=FusionSettings(mode="fill"),
    points_per_image=MANY_POINTS,
    points_by_budget=True,
    deformation=SharedBasis.kind,
    bases=None,
    most_bases=None,
    tracks=True,
    start_width=None,
    opacity=0.9,
    spread=0.5,
    sh_degree=0,
    sh_every=0,
    order="epochs",
    frames_a_step=1,
    cycles=True,
    worth_db=0.25,
    rates=_FAST_RATES,
    loss=LossSettings(colour_zone=0.1),
    densify=None,
    iterations=None,
    budget_s=60.0,
)

PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        preset.name: preset
        for preset in (
            replace(_FAST, name="instant", points_per_image=FEW_POINTS, budget_s=6.0),
            _FAST,
            replace(_FAST, name="quality", worth_db=0.05, budget_s=240.0),
            replace(
                _FAST,
                name="small",
                points_per_image=FEWEST_POINTS,
                points_by_budget=False,
                most_bases=17,
                rates=_SMALL_RATES,
                budget_s=30.0,
            ),
            _PAPER,
            replace(_PAPER, name="paper-released", deformation=QuarticFdm.kind),
            replace(_PAPER, name="paper-wide", start_width=0.6 / 16),
            replace(_PAPER, name="pfs", deformation=PolynomialFourier.kind, start_width=None),
            replace(_PAPER, name="hexplane", deformation=HexPlane.kind, bases=0, start_width=None),
            replace(_PAPER, name="without_mapf", fusion=FusionSettings(mode="reference_only")),
        )
    }
)
"""Every preset by its name. `instant` and `quality` are `fast` for less and for more time, `small` is `fast` for little
room; `paper-wide` starts FDM's bases as wide as 0.6 of their spacing."""


def preset_named(name: str, budget_s: float | None = None) -> Preset:
    """The preset of this name; with points_by_budget, as many points as pay within budget_s if that is given.

    Raises:
        InputError: there is none.
    """
    if name not in PRESETS:
        raise InputError("options.preset", f"there is no preset {name!r}.", f"Use one of: {', '.join(PRESETS)}.")
    preset = PRESETS[name]
    if budget_s is None or not preset.points_by_budget:
        return preset
    return replace(preset, points_per_image=FEW_POINTS if budget_s < PAYS_FROM_S else MANY_POINTS)
