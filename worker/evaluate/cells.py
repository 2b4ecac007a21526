"""What is measured: a grid of cells, each of them one reconstruction.

A series is a preset, or a preset with some of its numbers changed: `fast:bases=9,points_per_image=20000`. Every grid,
that of capacity too, is a list of series. `fast:eyes=left` is the preset as it is, trained on the left eye of a stereo
clip; without it a preset that can takes both. A series may also be a system of the paper's table 1 (rivals/), as it is.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

from contract.wire.errors import InputError
from contract.wire.names import LABORATORY_PRESETS, Eyes
from contract.wire.options import ReconstructionOptions, parse_options
from worker.evaluate.rivals import RIVAL_BUDGET_S, RIVAL_SYSTEMS
from worker.methods.method import Preset
from worker.methods.registry import PRESETS

OURS = tuple(name for name in ("instant", "fast", "quality", "small") if name in PRESETS)
PUBLISHED = "paper"
"""The published method, as printed."""
ABLATION = (PUBLISHED, "paper-released", "without_mapf", "pfs", "hexplane")
"""The published method, as printed and as released, and the variants that its ablation compares it with."""
DEFAULT_SERIES = (*OURS, *ABLATION)
TABLE_1 = ("fast", "paper", *reversed(tuple(RIVAL_SYSTEMS)))
"""Our default and the systems that the paper's table 1 compares: those that are measured soonest come first."""
SHORTHANDS = {"ours": OURS, "ablation": ABLATION, "table1": TABLE_1}
DEFAULT_HOLDOUTS = ("every8", "blocks8")
GRID_BASES = (3, 5, 9, 17, 33)
GRID_POINTS = (10_000, 20_000, 40_000, 80_000)
"""Bases and Gaussians per image of the grid that the automatic choice is compared with."""
EYES = "eyes"
BOTH_EYES: Eyes = "both"
"""The change in a series that is an option of the reconstruction and no value of its preset, and what it is unsaid."""


def expected_beside(series: Collection[str]) -> list[str]:
    """The series that a comparison of these is to have: the table's if a system of others is among them, and all
    presets unless they are the table's alone."""
    table = TABLE_1 if any(each in RIVAL_SYSTEMS for each in series) else ()
    presets = () if table and set(series) <= set(TABLE_1) else DEFAULT_SERIES
    return list(dict.fromkeys((*presets, *table)))


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
    eyes: Sequence[Eyes] = (BOTH_EYES,),
) -> list[Cell]:
    """Every combination, clip by clip so that each is opened once; without budgets and iterations as the presets say.

    Cells have the series' canonical names: one series is one row, however it was spelt.

    Args:
        series: also "ours", "ablation" and "table1".
        eyes: of the series that do not say themselves; a preset that trains on the left eye alone has one cell.

    Raises:
        InputError: a series is not known, or no reconstruction takes a holdout or a seed.
    """
    named = [name for each in series for name in SHORTHANDS.get(each, (each,))]
    lengths = dict(_named_length(with_eyes(name, which)) for name in named for which in eyes)
    cells = []
    for clip in clips:
        for holdout in holdouts:
            for seed in seeds:
                for name, (own_iterations, own_budget_s) in lengths.items():
                    fixed = list(iterations)
                    timed = list(budgets_s)
                    if not fixed and not timed:  # the preset's own; iterations before seconds, as in a reconstruction
                        fixed = [own_iterations] if own_iterations else []
                        timed = [own_budget_s] if own_budget_s and not fixed else []
                    cells += [Cell(clip, name, holdout, seed, budget_s=each) for each in timed]
                    cells += [Cell(clip, name, holdout, seed, iterations=each) for each in fixed]
    for cell in cells:
        options_of(cell)
    return cells


def options_of(cell: Cell) -> ReconstructionOptions:
    """The options of the cell's reconstruction. The preset is named only if the series changes none of its values; a
    rival and a variant of `paper` get the frames of the published method, whatever their budget.

    Raises:
        InputError: no reconstruction takes one of them.
    """
    preset = {}
    if is_rival_system(cell.series) or cell.series in LABORATORY_PRESETS:
        preset = {"preset": PUBLISHED}
    elif not is_changed(cell.series):
        preset = {"preset": preset_of(cell.series).name}
    length = {"budget_s": cell.budget_s, "iterations": cell.iterations}
    chosen = {"holdout": cell.holdout, "seed": cell.seed, EYES: eyes_of(cell.series)}
    return parse_options(ReconstructionOptions, {**chosen, **length, **preset})


def own_preset_of(series: str) -> Preset | None:
    """The preset that trains in place of the one in options_of; None if that one trains. Raises as preset_of."""
    return preset_of(series) if is_changed(series) or series in LABORATORY_PRESETS else None


def preset_of(series: str) -> Preset:
    """The preset that a series names, with its changes made.

    Raises:
        InputError: there is no such preset, no such plain value in it, it makes no use of one, or none can train so.
    """
    return _read(series)[1]


def is_rival_system(series: str) -> bool:
    """Whether the series is one of RIVAL_SYSTEMS, which have no preset.

    Raises:
        InputError: it is one with changes.
    """
    if preset_name_of(series) not in RIVAL_SYSTEMS:
        return False
    if _changes(series):
        problem = f"{series!r} changes a system of others, which is measured as it is."
        raise InputError("--series", problem, f"Write {preset_name_of(series)!r}.")
    return True


def preset_name_of(series: str) -> str:
    """The name of the preset that a series is a variant of, or of the system that it is."""
    return series.partition(":")[0]


def eyes_of(series: str) -> Eyes:
    """The eyes that a series trains on, where the clip has two and its preset takes two."""
    return "left" if f"{EYES}=left" in _changes(series) else BOTH_EYES


def with_eyes(series: str, eyes: Eyes) -> str:
    """The series trained on these eyes, unless it says itself or its preset takes one eye only."""
    preset = PRESETS.get(preset_name_of(series))
    decided = any(_is_eyes(change) for change in _changes(series)) or eyes == BOTH_EYES
    if decided or preset is None or not preset.both_eyes:
        return series
    return _named(preset.name, sorted([*_changes(series), f"{EYES}={eyes}"]))


def base_of(series: str) -> str:
    """The series with the same preset and the same eyes that changes none of the preset's values."""
    return _named(preset_name_of(series), [change for change in _changes(series) if _is_eyes(change)])


def is_changed(series: str) -> bool:
    """Whether the series changes a value of its preset."""
    return any(not _is_eyes(change) for change in _changes(series))


def capacity_grid(series: str) -> list[str]:
    """The series, whose capacity is chosen for the scene, and its variants with fixed capacities.

    Raises:
        InputError: it is one of RIVAL_SYSTEMS.
    """
    name, own = preset_name_of(series), _changes(series)
    if name in RIVAL_SYSTEMS:
        raise InputError("--grid", f"{name!r} is measured as published.", "Name presets alone with --series.")
    grid = ([f"bases={bases}", f"points_per_image={points}"] for bases in GRID_BASES for points in GRID_POINTS)
    return [series, *(_named(name, [*fixed, *own]) for fixed in grid)]


def _changes(series: str) -> list[str]:
    return list(filter(None, series.partition(":")[2].split(",")))


def _is_eyes(change: str) -> bool:
    return change.partition("=")[0] == EYES


def _named(preset: str, changes: Sequence[str]) -> str:
    return f"{preset}:{','.join(changes)}" if changes else preset


def _named_length(series: str) -> tuple[str, tuple[int | None, float | None]]:
    """A series' canonical name, and the iterations or seconds that it trains if nobody says. Raises as preset_of."""
    if is_rival_system(series):
        return preset_name_of(series), (None, RIVAL_BUDGET_S)
    name, preset = _read(series)
    return name, (preset.iterations, preset.budget_s)


def _read(series: str) -> tuple[str, Preset]:
    """A series' canonical name, with its changes in alphabetical order, and its preset. Raises as preset_of."""
    name = preset_name_of(series)
    if is_rival_system(series):
        problem = f"{series!r} is no preset: `intrasplat evaluate` and `stability` alone train it."
        raise InputError("--series", problem, f"Use one of: {', '.join(PRESETS)}.")
    if name not in PRESETS:
        shorthands = f"in `intrasplat evaluate` also {', '.join(SHORTHANDS)}"
        remedy = f"Use one of: {', '.join([*PRESETS, *RIVAL_SYSTEMS])}; {shorthands}."
        raise InputError("--series", f"there is no series {series!r}.", remedy)
    preset = PRESETS[name]
    values: dict[str, Any] = {}
    for change in _changes(series):
        field, _, text = change.partition("=")
        _check_change(preset, series, change)
        if field in values:
            raise InputError("--series", f"{series!r} gives {field!r} twice.", "Give it once.")
        values[field] = _value(series, field, text, getattr(preset, field, BOTH_EYES))
    written = [f"{field}={str(values[field]).lower()}" for field in sorted(values)]
    values.pop(EYES, None)
    try:
        changed = dataclasses.replace(preset, **values) if values else preset
    except ValueError as error:
        problem = f"{series!r} cannot be trained: {error}."
        raise InputError("--series", problem, "Change what it needs too, or leave the change out.") from None
    return _named(name, [change for change in written if change != f"{EYES}={BOTH_EYES}"]), changed


def _check_change(preset: Preset, series: str, change: str) -> None:
    """InputError unless the preset has what is changed, and the change has an effect."""
    field, plain = change.partition("=")[0], [*_plain_fields(), EYES]
    if field not in plain:
        problem = f"{change!r} in {series!r} changes no plain value of a preset."
        raise InputError("--series", problem, f"Use FIELD=VALUE with one of: {', '.join(plain)}.")
    why = ""
    if field == "points_per_image" and preset.fusion.mode != "fill":
        why = "does not choose how many points an image gives"
    if field == EYES and not preset.both_eyes:
        why = "trains on the left eye alone"
    if why:
        problem = f"{preset.name!r} {why}, so {change!r} would change nothing."
        raise InputError("--series", problem, "Leave it out.")


def _plain_fields() -> list[str]:
    """The fields of a preset that a series can change: numbers, words and switches.

    Not the name, not points_by_budget, which has no effect in a changed preset, not both_eyes, for which there is
    eyes=left, and not the length, which is the cell's limit.
    """
    others = ("name", "points_by_budget", "both_eyes", "iterations", "budget_s")
    names = [each.name for each in dataclasses.fields(Preset) if each.name not in others]
    return [name for name in names if not any(dataclasses.is_dataclass(getattr(x, name)) for x in PRESETS.values())]


def _value(series: str, field: str, text: str, current: object) -> object:
    """text as a value of the current one's type."""
    kind = Eyes if field == EYES else get_type_hints(Preset)[field]
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
