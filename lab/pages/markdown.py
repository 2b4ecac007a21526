"""Figures, tables and their origin in Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median

from lab.evaluate.rows import Row

MAX_NAMED_COMMITS = 4
"""More commits than these are counted, not named: the rows name them."""


def number(value: float | None, digits: int) -> str:
    """The value with so many digits; a dash where there is none."""
    if value is None or math.isnan(value):
        return "–"
    return f"{round(value, digits) + 0.0:.{digits}f}"  # adding 0.0 turns -0.0 into 0.0


def median_of(rows: Sequence[Row], name: str, digits: int) -> str:
    """The median of a column over the rows that have it; a dash where none has."""
    known = [float(row[name]) for row in rows if row.get(name)]
    return number(median(known) if known else None, digits)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = ["", "| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def source(command: str, *files: str) -> str:
    """The line under a section's text: the command that prints its rows, and the files of lab/rows/ that hold them."""
    links = ", ".join(f"[{name}](../../lab/rows/{name})" for name in files)
    return f"\n`{command}`, rows in {links}.\n"


def origin(runs: Sequence[Row]) -> str:
    """The machines, days and commits that the rows were measured with, and the load where they have it."""
    machines: dict[str, set[str]] = {}
    for row in runs:
        if row["machine"]:
            name, _, day = row["machine"].rpartition(", ")
            machines.setdefault(name or day, set()).add(day)
    where = "; ".join(f"{name}, {_days(days)}" for name, days in sorted(machines.items()))
    commits = sorted({row["commit"] for row in runs if row["commit"]})
    named = (
        f"commit{'s' * (len(commits) > 1)} {', '.join(commits)}"
        if len(commits) <= MAX_NAMED_COMMITS
        else f"{len(commits)} commits"
    )
    loads = [float(row["load_1min"]) for row in runs if row.get("load_1min")]
    load = f"; median load before a run {median(loads):.1f}" if loads else ""
    return f"\nMeasured on {where}; {named}{load}.\n"


def _days(days: set[str]) -> str:
    first, last = min(days), max(days)
    return first if first == last else f"{first} to {last}"
