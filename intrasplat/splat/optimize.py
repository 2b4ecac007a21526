"""Adam's learning rates and their schedules. The arithmetic itself is fused into the backends' steps.

Rates are in optimiser units (median depth 60). They fall with progress in [0, 1], which reaches 1 before every warm
restart (intrasplat/train/schedule.py) and at the end of a run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any


@dataclass(frozen=True)
class Rate:
    """A learning rate that falls log-linearly from start to end as progress goes to 1; constant where end is None."""

    start: float
    end: float | None = None

    def times(self, factor: float) -> Rate:
        """The rate multiplied by the factor."""
        return Rate(factor * self.start, None if self.end is None else factor * self.end)

    def at(self, progress: float) -> float:
        """The rate at progress in [0, 1]."""
        if self.end is None or self.start == 0.0:
            return self.start
        return math.exp(math.log(self.start) + (math.log(self.end) - math.log(self.start)) * min(progress, 1.0))


@dataclass(frozen=True)
class Rates:
    """One learning rate per parameter group. motion_*: the deformation's weights, by their five kinds of channel.

    beta1, beta2  decay of Adam's two moments per step; the defaults are Adam's published ones
    """

    mean: Rate
    quaternion: Rate
    log_scale: Rate
    opacity: Rate
    colour: Rate
    gloss: Rate
    sh_rest: Rate
    motion_mean: Rate
    motion_quaternion: Rate
    motion_log_scale: Rate
    motion_colour: Rate
    motion_gloss: Rate
    eps: float = 1e-15
    beta1: float = 0.9
    beta2: float = 0.999

    def times(self, factor: float) -> Rates:
        """Every rate multiplied by the factor."""
        found: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        found |= {name: each.times(factor) for name, each in found.items() if isinstance(each, Rate)}
        return Rates(**found)


@dataclass(frozen=True)
class StepRates:
    """The rates of one iteration, as plain numbers."""

    mean: float
    quaternion: float
    log_scale: float
    opacity: float
    colour: float
    gloss: float
    sh_rest: float
    motion_mean: float
    motion_quaternion: float
    motion_log_scale: float
    motion_colour: float
    motion_gloss: float
    eps: float
    beta1: float = 0.9
    beta2: float = 0.999


@dataclass(frozen=True)
class AdamStep:
    """One step of Adam as the kernels take it: both bias corrections are folded into size and floor.

    m <- beta1 m + (1 - beta1) g;  v <- beta2 v + (1 - beta2) g^2;  value <- value - size m / (sqrt(v) + floor)
    """

    size: float
    floor: float
    beta1: float
    beta2: float


def rates_at(rates: Rates, progress: float) -> StepRates:
    """Every group's rate at progress in [0, 1]."""
    found = {name: getattr(rates, name) for name in StepRates.__dataclass_fields__}
    return StepRates(**{name: each.at(progress) if isinstance(each, Rate) else each for name, each in found.items()})


def adam_step(rate: float, rates: StepRates, count: int) -> AdamStep:
    """Adam's count-th step (from 1) at this rate (Kingma and Ba 2015)."""
    second = math.sqrt(1.0 - rates.beta2**count)
    return AdamStep(rate * second / (1.0 - rates.beta1**count), rates.eps * second, rates.beta1, rates.beta2)
