"""Figures, tables and their origin in Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median

from lab.evaluate.rows import Row


def number(value: float | None, digits: int) -> str:
    """The value with so many digits; a dash where there is none."""
    if value is None or math.isnan(value):
        return "–"
    return f"{round(value, digits) + 0.0:.{digits}f}"  # adding 0.0 turns -0.0 into 0.0


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = ["", "| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def origin(runs: Sequence[Row]) -> str:
    """On which machines rows were measured, with which commits, and beside how much other work where they tell."""
    machines, commits = (", ".join(sorted({row[name] for row in runs if row[name]})) for name in ("machine", "commit"))
    loads = [float(row["load_1min"]) for row in runs if row.get("load_1min")]
    load = f"; load before a run {min(loads):.1f} to {max(loads):.1f}, median {median(loads):.1f}" if loads else ""
    return f"\nMeasured on {machines}, commits {commits} (+: with changes not yet committed){load}.\n"
