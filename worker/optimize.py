"""Adam's rates and their schedules. The arithmetic itself is fused into the backends' steps.

Rates are stated in optimiser units (median depth 60) and a whole run: progress p = iteration / iterations in [0, 1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

BETA1, BETA2 = 0.9, 0.999


@dataclass(frozen=True)
class Rate:
    """A learning rate that falls log-linearly from start to end over the run; constant where end is None."""

    start: float
    end: float | None = None

    def at(self, progress: float) -> float:
        if self.end is None or self.start == 0.0:
            return self.start
        return math.exp(math.log(self.start) + (math.log(self.end) - math.log(self.start)) * min(progress, 1.0))


@dataclass(frozen=True)
class Rates:
    """One rate a parameter group. motion_* are those of the deformation's weights for its four kinds of channel."""

    mean: Rate
    quaternion: Rate
    log_scale: Rate
    opacity: Rate
    colour: Rate
    sh_rest: Rate
    motion_mean: Rate
    motion_quaternion: Rate
    motion_log_scale: Rate
    motion_colour: Rate
    eps: float = 1e-15


@dataclass(frozen=True)
class StepRates:
    """The rates of one iteration, as plain numbers."""

    mean: float
    quaternion: float
    log_scale: float
    opacity: float
    colour: float
    sh_rest: float
    motion_mean: float
    motion_quaternion: float
    motion_log_scale: float
    motion_colour: float
    eps: float


def rates_at(rates: Rates, progress: float) -> StepRates:
    """Every group's rate at progress in [0, 1]."""
    values = {name: getattr(rates, name).at(progress) for name in StepRates.__dataclass_fields__ if name != "eps"}
    return StepRates(**values, eps=rates.eps)


def adam_step_size(rate: float, eps: float, count: int) -> tuple[float, float]:
    """Rate and eps of Adam's count-th step (from 1) with both bias corrections folded in (Kingma and Ba 2015)."""
    second = math.sqrt(1.0 - BETA2**count)
    return rate * second / (1.0 - BETA1**count), eps * second
