"""What is measured: a grid of cells, each of them one reconstruction.

A series is a preset, or a preset with some of its numbers changed: `fast:bases=9,points_per_image=20000`. Every grid,
that of capacity too, is a list of series.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

from contract.wire.errors import InputError
from contract.wire.options import ReconstructionOptions, parse_options
from worker.train.presets import PRESETS, Preset, preset_named

OURS = tuple(name for name in ("instant", "fast", "quality", "small") if name in PRESETS)
RIVALS = ("paper", "paper-released", "without_mapf", "pfs", "hexplane")
"""The published method, as printed and as released, and what it compares itself with."""
DEFAULT_SERIES = (*OURS, *RIVALS)
SHORTHANDS = {"ours": OURS, "rivals": RIVALS}
DEFAULT_HOLDOUTS = ("every8", "blocks8")
GRID_BASES = (3, 5, 9, 17, 33)
GRID_POINTS = (10_000, 20_000, 40_000, 80_000)
"""Bases and Gaussians per image of the grid that the automatic choice is compared with."""


@dataclass(frozen=True)
class Cell:
    """One reconstruction: exactly one of budget_s and iterations is given."""

    clip: str
    series: str
    holdout: str
    seed: int
    budget_s: float | None = None
    iterations: int | None = None

    @property
    def limit(self) -> str:
        """How long it trains, in words."""
        return f"{self.iterations} iterations" if self.iterations else f"{self.budget_s:g} s"

    @property
    def key(self) -> tuple[str, ...]:
        """What its row is found by; the values of rows.KEY."""
        return (self.clip, self.holdout, self.series, str(self.seed), self.limit)


def plan(
    clips: Sequence[str],
    series: Sequence[str],
    holdouts: Sequence[str],
    seeds: Sequence[int],
    budgets_s: Sequence[float] = (),
    iterations: Sequence[int] = (),
) -> list[Cell]:
    """Every combination, clip by clip so that each is opened once; without budgets and iterations as the presets say.

    Cells have the series' canonical names: one series is one row, however it was spelt.

    Args:
        series: also "ours" and "rivals".

    Raises:
        InputError: a series is not known, or no reconstruction takes a holdout or a seed.
    """
    presets = dict(_read(name) for each in series for name in SHORTHANDS.get(each, (each,)))
    cells = []
    for clip in clips:
        for holdout in holdouts:
            for seed in seeds:
                for name, preset in presets.items():
                    fixed = list(iterations)
                    timed = list(budgets_s)
                    if not fixed and not timed:  # the preset's own; iterations before seconds, as in a reconstruction
                        fixed = [preset.iterations] if preset.iterations else []
                        timed = [preset.budget_s] if preset.budget_s and not fixed else []
                    cells += [Cell(clip, name, holdout, seed, budget_s=each) for each in timed]
                    cells += [Cell(clip, name, holdout, seed, iterations=each) for each in fixed]
    for cell in cells:
        options_of(cell)
    return cells


def options_of(cell: Cell) -> ReconstructionOptions:
    """The options of the cell's reconstruction. The preset is named only if the series changes none of its values.

    Raises:
        InputError: no reconstruction takes one of them.
    """
    preset = {"preset": cell.series} if cell.series in PRESETS else {}
    length = {"budget_s": cell.budget_s, "iterations": cell.iterations}
    return parse_options(ReconstructionOptions, {"holdout": cell.holdout, "seed": cell.seed, **length, **preset})


def preset_of(series: str) -> Preset:
    """The preset that a series names, with its changes made.

    Raises:
        InputError: there is no such preset, no such plain value in it, it makes no use of one, or none can train so.
    """
    return _read(series)[1]


def base_of(series: str) -> str:
    """The preset that a series is a variant of."""
    return series.partition(":")[0]


def capacity_grid(preset: str) -> list[str]:
    """The preset, whose capacity is chosen for the scene, and its variants with fixed capacities."""
    fixed = [f"{preset}:bases={bases},points_per_image={points}" for bases in GRID_BASES for points in GRID_POINTS]
    return [preset, *fixed]


def _read(series: str) -> tuple[str, Preset]:
    """A series' canonical name, with its changes in alphabetical order, and its preset. Raises as preset_of."""
    name, _, changes = series.partition(":")
    preset = preset_named(name)
    values: dict[str, Any] = {}
    for change in filter(None, changes.split(",")):
        field, _, text = change.partition("=")
        plain = _plain_fields()
        if field not in plain:
            problem = f"{change!r} in {series!r} changes no plain value of a preset."
            raise InputError("--series", problem, f"Use FIELD=VALUE with one of: {', '.join(plain)}.")
        if field == "points_per_image" and preset.fusion.mode != "fill":
            problem = f"{name!r} does not choose how many points an image gives, so {change!r} would change nothing."
            raise InputError("--series", problem, "Leave it out.")
        if field in values:
            raise InputError("--series", f"{series!r} gives {field!r} twice.", "Give it once.")
        values[field] = _value(series, field, text, getattr(preset, field))
    if not values:
        return name, preset
    written = ",".join(f"{field}={str(values[field]).lower()}" for field in sorted(values))
    try:
        return f"{name}:{written}", dataclasses.replace(preset, **values)
    except ValueError as error:
        problem = f"{series!r} cannot be trained: {error}."
        raise InputError("--series", problem, "Change what it needs too, or leave the change out.") from None


def _plain_fields() -> list[str]:
    """The fields of a preset that a series can change: numbers, words and switches.

    Not the name, not points_by_budget, which has no effect in a changed preset, and not the length, which is the cell's
    limit.
    """
    others = ("name", "points_by_budget", "iterations", "budget_s")
    names = [each.name for each in dataclasses.fields(Preset) if each.name not in others]
    return [name for name in names if not any(dataclasses.is_dataclass(getattr(x, name)) for x in PRESETS.values())]


def _value(series: str, field: str, text: str, current: object) -> object:
    """text as a value of the current one's type."""
    kind = get_type_hints(Preset)[field]
    words = get_args(kind) if get_origin(kind) is Literal else ()
    try:
        if text == "none" and type(None) in get_args(kind):
            return None
        if isinstance(current, bool):
            return {"true": True, "false": False}[text]
        if words:
            return words[words.index(text)]
        value = float(text) if float in (kind, *get_args(kind)) else int(text)
        if not math.isfinite(value):
            raise ValueError(text)
        return value
    except (KeyError, ValueError, OverflowError):
        problem = f"{text!r} in {series!r} is not a value in place of {current!r}."
        known = ", ".join(words) or "a number, true, false or, where there need not be any, none"
        raise InputError("--series", problem, f"Give {known}.") from None
