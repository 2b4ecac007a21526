"""The part of docs/results/index.md that `intrasplat stability` has the rows for."""

from __future__ import annotations

from pathlib import Path

from worker.evaluate.atlas import WORST_FIRST, count_outcomes, map_name, places_of, series_in
from worker.evaluate.conditions import CONDITIONS, SEVERITIES
from worker.evaluate.rows import read_rows
from worker.evaluate.stability import LARGEST_DEPTH_LOSS_MM, LARGEST_LOSS_DB, STABILITY

_INTRODUCTION = f"""
## Where methods break, and whether they say so

`intrasplat stability --out docs/results` ([{STABILITY}]({STABILITY})) spoils a synthetic clip in {len(CONDITIONS)}
ways, {len(SEVERITIES)} severities each, reconstructs it and judges it by the truth. Harmed is what loses more than
{LARGEST_LOSS_DB:g} dB to the clean clip, or {LARGEST_DEPTH_LOSS_MM:g} mm of depth. Silent is the defect: harmed, and
the report has no warning that the clean clip's has not. What the user is told of each stands in
[stability.md](stability.md), how it is judged in [decision 016](../decisions/016-stability.md). Each method is compared
with itself on the clean clip (a pull and a cut with the same motion, calm), so a map shows what a mishap costs a method
and not which method is better: one that has hardly learnt loses little. Not every place has been measured for every
method, so counts compare within a row.

| | measured | {" | ".join(WORST_FIRST)} | map |
|---|{"---|" * len(WORST_FIRST)}---|---|
"""
_MAP = """
![Decibels lost of each condition at five severities, marked where the user was told and where not](stability-fast.png)
"""


def stability_sections(results: Path) -> list[str]:
    """Markdown; none where there are no rows."""
    rows = read_rows(results / STABILITY)
    if not rows:
        return []
    lines = []
    for series in series_in(rows):
        counted = count_outcomes(places_of(rows, series))
        measured = f"{sum(counted.values())} of {len(CONDITIONS) * len(SEVERITIES)}"
        counts = " | ".join(str(counted.get(outcome, 0)) for outcome in WORST_FIRST)
        name = f"{map_name(series)}.png"
        shown = f"[{name}]({name})" if (results / name).exists() else ""
        lines.append(f"| {series} | {measured} | {counts} | {shown} |\n")
    return [_INTRODUCTION, *lines, *([_MAP] if (results / "stability-fast.png").exists() else [])]
