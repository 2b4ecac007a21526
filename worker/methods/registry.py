"""Presets by their names: those of this package, and those that somebody registers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from contract.wire.errors import InputError
from worker.methods.fast import FAST, INSTANT, QUALITY, SMALL, points_for
from worker.methods.method import Preset
from worker.methods.paper import PAPER

_PRESETS = {preset.name: preset for preset in (INSTANT, FAST, QUALITY, SMALL, PAPER)}
PRESETS: Mapping[str, Preset] = MappingProxyType(_PRESETS)
"""Every preset by its name. The first five are those that contract/wire/names.py offers."""


def register_presets(*presets: Preset) -> None:
    """Make presets known by their names, for this process. To register one again changes nothing.

    Raises:
        ValueError: another preset has the name.
    """
    for preset in presets:
        if _PRESETS.setdefault(preset.name, preset) != preset:
            raise ValueError(f"there is another preset {preset.name!r}")


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
    return replace(preset, points_per_image=points_for(budget_s))
