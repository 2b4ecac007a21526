"""Every way of training, by name: ours `instant`, `fast`, `quality`, `small`; `paper` and its variants.

A preset is data only. Rates are in optimiser units (median depth 60).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

from contract.wire.errors import InputError
from contract.wire.names import BUDGETS_S
from worker.fusion import FusionSettings
from worker.model.deformation import GaussianFdm, HexPlane, PolynomialFourier, QuarticFdm, SharedBasis, motion_named
from worker.model.gaussians import MAX_SH_DEGREE
from worker.model.loss import LossSettings
from worker.model.optimize import Rate, Rates
from worker.motion.capacity import USUAL_BASES
from worker.train.densify import DensifySettings


@dataclass(frozen=True)
class Preset:
    """One way of training.

    fusion           which points become Gaussians
    points_per_image "fill" fusion takes the grid stride that comes nearest to this many points per frame; None: as far
                     apart as the scene's detail allows
    points_by_budget whether budget_s decides points_per_image instead (preset_named)
    deformation      name of a motion in the registry (worker/model/deformation)
    bases            B of the deformation; None: as many as the scene's motion needs ("shared" alone)
    max_bases        limit for `bases` where the scene decides; None: no limit
    tracks           whether optical-flow tracks start the motion ("shared" only)
    start_width      sigma at the start, model time; None where the deformation places its own
    opacity, spread  of a Gaussian at the start; spread is its standard deviation over the distance to its neighbours
    sh_degree        of the colour; from 1 on, a degree is added every sh_every iterations
    order            "epochs": every training frame once, shuffled, again and again; "random": drawn each iteration
    frames_a_step    training frames of one iteration, which descends the sum of their losses
    both_eyes        whether a step takes both eyes of its frames, where the clip has two and options.eyes allows it
    warm_restarts    whether rates rise again when the iterations have doubled, if there are enough for two cycles, and
                     the last models of each are averaged (schedule.py); else rates fall once and nothing is averaged
    min_gain_db      a run with budget_s stops early where doubling its iterations gains less; None: no early stopping
    iterations       of a run without budget_s and iterations; None: budget_s
    budget_s         seconds of training of a run without either

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
        """With so many bases; where they are many, without first moments, which gain next to nothing and take a third
        of the model's memory."""
        many = self.bases is None and bases > USUAL_BASES
        return replace(self, bases=bases, rates=replace(self.rates, beta1=0.0) if many else self.rates)


MAX_FRAMES_A_STEP = 16
"""As many as a GPU's kernels draw at once (worker/raster/cuda/bins.py)."""
MIN_START = 1e-3
"""Of an opacity, a spread and a width at the start; an opacity stays as far below 1, for its logit is trained."""
MIN_POINTS, FEW_POINTS, MANY_POINTS = 20_000, 40_000, 80_000
MANY_POINTS_FROM_S = 9.0
"""From this budget on MANY_POINTS score more than FEW_POINTS. This is wall-clock time of two cores
(docs/decisions/training.md); a faster machine could afford them sooner. Nothing measures it at run time, because a run
that is resumed must start with the same points."""

_PAPER_ITERATIONS = 3000
_PAPER_DECAY = (1.6e-3, 5.06e-5)
"""1.6e-3 falling log-linearly to a hundredth over 4000 steps, of which 3000 are made: 1.6e-3 * 0.01**(3000 / 4000)."""
_PAPER_RATES = Rates(
    mean=Rate(*_PAPER_DECAY),
    quaternion=Rate(1e-3),
    log_scale=Rate(5e-3),
    opacity=Rate(5e-2),
    colour=Rate(2.5e-3),
    gloss=Rate(0.0),
    sh_rest=Rate(1.25e-4),
    motion_mean=Rate(*_PAPER_DECAY),
    motion_quaternion=Rate(*_PAPER_DECAY),
    motion_log_scale=Rate(*_PAPER_DECAY),
    motion_colour=Rate(0.0),
    motion_gloss=Rate(0.0),
)

_PAPER = Preset(
    name="paper",
    fusion=FusionSettings(mode="paper"),
    points_per_image=None,
    points_by_budget=False,
    deformation=GaussianFdm.kind,
    bases=17,
    max_bases=None,
    tracks=False,
    start_width=0.01,
    opacity=0.1,
    spread=1.0,
    sh_degree=3,
    sh_every=500,
    order="random",
    frames_a_step=1,
    both_eyes=False,
    warm_restarts=False,
    min_gain_db=None,
    rates=_PAPER_RATES,
    loss=LossSettings(normalised_depth=False),
    densify=DensifySettings(),
    iterations=_PAPER_ITERATIONS,
    budget_s=None,
)

# Found on d4d_endonerf and on synthetic clips (docs/decisions/training.md): the published rates of motion are some
# thirty times too slow for a run of hundreds of steps, and Adam's moments remember too long, for successive steps see
# frames from all over the clip.
_FAST_RATES = Rates(
    mean=Rate(1.6e-3, 5e-5),
    quaternion=Rate(1e-2, 3e-3),
    log_scale=Rate(2e-2, 6e-3),
    opacity=Rate(5e-2, 1.5e-2),
    colour=Rate(2.5e-2, 6e-3),
    gloss=Rate(2e-2, 5e-3),
    sh_rest=Rate(0.0),
    motion_mean=Rate(1.5e-2, 1.5e-3),
    motion_quaternion=Rate(5e-2, 5e-3),
    motion_log_scale=Rate(5e-2, 5e-3),
    motion_colour=Rate(5e-2, 5e-3),
    motion_gloss=Rate(2e-2, 2e-3),
    beta1=0.3,
    beta2=0.95,
)

_HASTE = 1.6
"""A run of a hundred steps gets nearer with larger ones: 0.2 to 0.4 dB on four clips."""

# A quarter of the Gaussians, half the bases and no change of size lose least for each byte
# (docs/decisions/training.md).
_SMALL_RATES = replace(_FAST_RATES, motion_log_scale=Rate(0.0))

_FAST = Preset(
    name="fast",
    fusion=FusionSettings(mode="fill"),
    points_per_image=MANY_POINTS,
    points_by_budget=True,
    deformation=SharedBasis.kind,
    bases=None,
    max_bases=None,
    tracks=True,
    start_width=None,
    opacity=0.9,
    spread=0.5,
    sh_degree=0,
    sh_every=0,
    order="epochs",
    frames_a_step=1,
    both_eyes=True,
    warm_restarts=True,
    min_gain_db=0.25,
    rates=_FAST_RATES,
    loss=LossSettings(colour_huber_delta=0.1),
    densify=None,
    iterations=None,
    budget_s=BUDGETS_S["fast"],
)

PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        preset.name: preset
        for preset in (
            replace(
                _FAST,
                name="instant",
                points_per_image=FEW_POINTS,
                rates=_FAST_RATES.times(_HASTE),
                budget_s=BUDGETS_S["instant"],
            ),
            _FAST,
            replace(_FAST, name="quality", min_gain_db=0.05, budget_s=BUDGETS_S["quality"]),
            replace(
                _FAST,
                name="small",
                points_per_image=MIN_POINTS,
                points_by_budget=False,
                max_bases=17,
                rates=_SMALL_RATES,
                budget_s=BUDGETS_S["small"],
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
    """The preset of this name; with points_by_budget, budget_s decides its points_per_image if it is given.

    Raises:
        InputError: there is none.
    """
    if name not in PRESETS:
        raise InputError("options.preset", f"there is no preset {name!r}.", f"Use one of: {', '.join(PRESETS)}.")
    preset = PRESETS[name]
    if budget_s is None or not preset.points_by_budget:
        return preset
    return replace(preset, points_per_image=FEW_POINTS if budget_s < MANY_POINTS_FROM_S else MANY_POINTS)
