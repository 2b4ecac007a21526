"""The part of docs/results/index.md, and of README.md, on what a caller waits for: the rows of bm_post.py."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from lab.evaluate.rows import Row, read_rows
from lab.pages.markdown import origin, table

POST = "post.csv"
CPU = "cpu"
"""The device of a row that names none: it was measured before the rows had one."""
_INTRODUCTION = """
## What a caller waits for

`python -m lab.benchmarks.bm_post --csv docs/results/post.csv` ([post.csv](post.csv)): seconds from the POST of a clip
to a warm worker, medians. The first view shows one moment; a good view is a snapshot of training that scores 33 dB or
more in the left eye, counted where not every run had one. `t_train_s` and `t_post_s` are those of the report
([conventions](../conventions.md#clocks)). `eta off`: how far the `eta_s` of a job was off at most, as a share of the
whole, after its first tenth. `d4d_stereo` is `d4d-a` as raw stereo.
"""
_SHELL = """
The same through `intrasplat reconstruct` from the shell, imports and scoring included:
"""
_CALLER = {"first_view_s": ("first view", 1), "good_view_s": ("good view", 1)}
_CLOCKS = {"t_train_s": ("t_train_s", 1), "t_post_s": ("t_post_s", 1), "done_s": ("done", 1)}
_SCORED = {"scored_s": ("scored", 1), "eta_off": ("eta off", 2)}
_SCORES = {"psnr_db": ("left, dB", 1), "psnr_right_db": ("right, dB", 1)}
_COLUMNS = {
    "http": {**_CALLER, **_CLOCKS, **_SCORED, **_SCORES},
    "shell": {**_CLOCKS, **_SCORES},
}
"""By way, and by column: its name and digits."""


def post_sections(folder: Path) -> list[str]:
    """The section of bm_post.py, of the last commit of each clip, preset and way; nothing without rows."""
    groups = _groups(folder)
    parts = [_INTRODUCTION] if groups else []
    for way, columns in _COLUMNS.items():
        cells = [
            [
                *key[:2],
                f"{key[2]} s" if key[2] else "",
                key[4],
                str(len(rows)),
                *(_shown(rows, *each) for each in columns.items()),
            ]
            for key, rows in groups.items()
            if key[3] == way
        ]
        header = ["clip", "preset", "given", "device", "runs", *(name for name, _ in columns.values())]
        if cells:
            parts += [*([_SHELL] if way == "shell" else []), table(header, cells)]
    return [*parts, origin([row for rows in groups.values() for row in rows])] if groups else []


def post_claim(folder: Path) -> str:
    """Both clocks of each preset that was sent as it is, in a sentence a clip and device; empty without such rows."""
    said: dict[tuple[str, str], list[str]] = {}
    for (clip, preset, budget_s, way, device), rows in _groups(folder).items():
        if way == "http" and not budget_s:
            said.setdefault((clip, device), []).append(
                f"`{preset}` shows a first view after {_median(rows, 'first_view_s'):.1f} s and has its scene after "
                f"{_median(rows, 't_post_s'):.1f} s (`t_post_s`), {_median(rows, 't_train_s'):.1f} s of them training "
                "(`t_train_s`)"
            )
    sentences = []
    for (clip, device), each in said.items():
        where = "" if device == CPU else f" on {device}"
        sentences.append(f"Since the POST of `{clip}` to a warm worker{where}: {'; '.join(each)}.")
    return " ".join(sentences)


def _groups(folder: Path) -> dict[tuple[str, str, str, str, str], list[Row]]:
    """Rows with the report's clocks as columns, by clip, preset, budget, way and device; of each the last commit's."""
    found: dict[tuple[str, str, str, str, str], list[Row]] = {}
    for row in read_rows(folder / POST):
        clocks = {name: str(value) for name, value in json.loads(row["stages"]).items() if name in _CLOCKS}
        key = row["clip"], row["preset"], row["budget_s"], row["way"], row.get("device") or CPU
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
