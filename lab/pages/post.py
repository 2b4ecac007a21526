"""The part of docs/results/index.md, and of README.md, on what a caller waits for: the rows of bm_post.py."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from lab.evaluate.rows import Row, read_rows
from lab.pages.markdown import origin, source, table

POST = "post.csv"
CPU = "cpu"
"""The device of a row that names none: it was measured before the rows had one."""
AUTO = "auto"
"""The poses of a row that names none."""
PHANTOM = "phantom:"
_INTRODUCTION = """
## What a caller waits for

Seconds from the POST of a clip to a warm worker, medians; a good view scores 33 dB
or more in the left eye, counted where not every run had one. Shell: the same by `intrasplat reconstruct`, imports and
scoring included ([clocks](../conventions.md#clocks)).
"""
_COLUMNS = {
    "first_view_s": ("first view", 1), "good_view_s": ("good view", 1), "t_train_s": ("t_train_s", 1),
    "t_post_s": ("t_post_s", 1), "done_s": ("done", 1), "psnr_db": ("left, dB", 1), "psnr_right_db": ("right, dB", 1),
}  # fmt: skip
"""By column: its name and digits."""
_README_COLUMNS = ("first_view_s", "t_train_s", "t_post_s")
_CLOCKS = ("t_train_s", "t_post_s")
"""Columns that the report's stages hold."""


def post_sections(folder: Path) -> list[str]:
    """The section of bm_post.py, of the last commit of each clip, --poses, preset and way; nothing without rows."""
    groups = _groups(folder)
    if not groups:
        return []
    cells = [
        [
            clip if poses == AUTO else f"{clip}, poses={poses}",
            f"{preset}, {budget_s} s" if budget_s else preset,
            way,
            device,
            str(len(rows)),
            *(_shown(rows, *each) for each in _COLUMNS.items()),
        ]
        for (clip, poses, preset, budget_s, way, device), rows in groups.items()
    ]
    header = ["clip", "preset", "by", "device", "runs", *(name for name, _ in _COLUMNS.values())]
    command = source(f"python -m lab.benchmarks.bm_post --csv lab/rows/{POST}", POST)
    return [_INTRODUCTION, command, table(header, cells), origin([row for rows in groups.values() for row in rows])]


def post_table(folder: Path) -> str:
    """For README: both clocks of each preset that a recording was sent with, by device; empty without such rows."""
    cells = [
        [preset, device.removeprefix("cuda (").rstrip(")"), *(f"{_median(rows, name):.1f}" for name in _README_COLUMNS)]
        for (clip, poses, preset, budget_s, way, device), rows in _groups(folder).items()
        if way == "http" and not budget_s and poses == AUTO and not clip.startswith(PHANTOM)
    ]
    return table(["preset", "device", "first view, s", "of training, s", "scene, s"], cells) if cells else ""


def _groups(folder: Path) -> dict[tuple[str, str, str, str, str, str], list[Row]]:
    """Rows with the report's clocks as columns, by clip, poses, preset, budget, way and device; the last commit's."""
    found: dict[tuple[str, str, str, str, str, str], list[Row]] = {}
    for row in read_rows(folder / POST):
        clocks = {name: str(value) for name, value in json.loads(row["stages"]).items() if name in _CLOCKS}
        asked = row["clip"], row.get("poses") or AUTO, row["preset"], row["budget_s"]
        key = *asked, row["way"], row.get("device") or CPU
        found.setdefault(key, []).append({**row, **clocks})
    return {key: [row for row in rows if row["commit"] == rows[-1]["commit"]] for key, rows in found.items()}


def _median(rows: Sequence[Row], name: str) -> float:
    return median(float(row[name]) for row in rows if row.get(name))


def _shown(rows: Sequence[Row], name: str, column: tuple[str, int]) -> str:
    """The median; with a count where not every run has one."""
    count = sum(bool(row.get(name)) for row in rows)
    if not count:
        return "–"
    shown = f"{_median(rows, name):.{column[1]}f}"
    return shown if count == len(rows) else f"{shown} ({count} of {len(rows)})"
