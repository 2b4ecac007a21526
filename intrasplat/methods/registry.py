"""Presets by name: those of this package, and those that other code registers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from intrasplat.errors import InputError
from intrasplat.methods.fast import FAST, INSTANT, QUALITY, SMALL, points_for
from intrasplat.methods.method import Preset
from intrasplat.methods.paper import PAPER

_PRESETS = {preset.name: preset for preset in (INSTANT, FAST, QUALITY, SMALL, PAPER)}
PRESETS: Mapping[str, Preset] = MappingProxyType(_PRESETS)
"""Every preset by its name. The first five are those that intrasplat/names.py offers."""


def register_presets(*presets: Preset) -> None:
    """Register presets by their names, in this process. Registering one again changes nothing.

    Raises:
        ValueError: another preset has the name.
    """
    for preset in presets:
        if _PRESETS.setdefault(preset.name, preset) != preset:
            raise ValueError(f"there is another preset {preset.name!r}")


def preset_named(name: str, budget_s: float | None = None) -> Preset:
    """The preset of this name. If it has points_by_budget and budget_s is given, that decides its points_per_image.

    Raises:
        InputError: there is no such preset.
    """
    if name not in PRESETS:
        raise InputError("options.preset", f"there is no preset {name!r}.", f"Use one of: {', '.join(PRESETS)}.")
    preset = PRESETS[name]
    if budget_s is None or not preset.points_by_budget:
        return preset
    return replace(preset, points_per_image=points_for(budget_s))
