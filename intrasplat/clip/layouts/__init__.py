"""The registry of input layouts: a new layout is a module here and an entry in LAYOUTS.

`auto` uses the first layout that recognises the files; registered layouts of users come before ours.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

from intrasplat.clip.layouts.endonerf import ENDONERF
from intrasplat.clip.layouts.frames import FRAMES
from intrasplat.clip.layouts.layout import ClipFiles, InputLayout
from intrasplat.clip.layouts.packed import SBS, TB
from intrasplat.clip.layouts.stereomis import STEREOMIS
from intrasplat.errors import InputError

__all__ = [
    "LAYOUTS",
    "ClipFiles",
    "InputLayout",
    "detect_layout",
    "layout_named",
    "register_layout",
    "registered_files",
]

LAYOUTS = (ENDONERF, STEREOMIS, SBS, TB, FRAMES)
"""In order of detection. intrasplat/names.py lists the names for modules that cannot import this one."""

_outside: dict[Path, InputLayout] = {}
"""Registered layouts of users, by the file that defines each."""


def register_layout(file: Path) -> InputLayout:
    """Add the layout that a Python file defines as LAYOUT, for this process and its decoding processes.

    The decoding process may read this file and installed packages; the file can import nothing else.

    Raises:
        ValueError: the file defines no LAYOUT, or its name is taken.
    """
    file = file.resolve()
    spec = importlib.util.spec_from_file_location(f"intrasplat_layout_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{file} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    layout = getattr(module, "LAYOUT", None)
    if not isinstance(layout, InputLayout):
        raise ValueError(f"{file} defines no InputLayout called LAYOUT")
    if layout.name in {"auto", *(each.name for each in _all())}:
        raise ValueError(f"there is a layout called {layout.name!r} already")
    _outside[file] = layout
    return layout


def registered_files() -> list[Path]:
    """The files of the registered layouts of users."""
    return list(_outside)


def detect_layout(files: ClipFiles) -> InputLayout:
    """The first layout that recognises the files. InputError if a layout finds them ambiguous."""
    return next(each for each in _all() if each.recognises(files))  # SBS, TB and FRAMES cover all remaining files


def layout_named(name: str) -> InputLayout:
    """The layout of that name. InputError if there is none."""
    found = next((each for each in _all() if each.name == name), None)
    if found is None:
        known = ", ".join(["auto", *(each.name for each in _all())])
        raise InputError("options.layout", f"{name!r} is not known.", f"Choose one of {known}.")
    return found


def _all() -> tuple[InputLayout, ...]:
    return (*_outside.values(), *LAYOUTS)
