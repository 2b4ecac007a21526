"""The part of docs/results/index.md from the rows of `python -m lab stability`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from lab.conditions import CLEAN, CONDITIONS, SEVERITIES
from lab.evaluate.atlas import WORST_FIRST, count_outcomes, places_of, series_in
from lab.evaluate.rows import Row, read_rows
from lab.evaluate.stability import MAX_DEPTH_LOSS_MM, MAX_LOSS_DB, STABILITY
from lab.evaluate.stability_command import TABLE
from lab.pages.markdown import number, origin, source, table

_COMPARED = (3, 5)
"""The severities at which methods are compared."""
_PLACES = len(CONDITIONS) * len(_COMPARED)
MAP = "stability-fast.png"
_INTRODUCTION = f"""
## Where methods break, and whether they say so

A synthetic clip is spoilt in {len(CONDITIONS)} ways at {len(SEVERITIES)} severities; the table counts severities
{" and ".join(map(str, _COMPARED))}. Silent is the defect: a loss of more than {MAX_LOSS_DB:g} dB against the method's
own clean clip, or of {MAX_DEPTH_LOSS_MM:g} mm of depth, without a warning ([how it is judged, and why some are
silent](../decisions/evaluation.md#clips-are-spoilt-on-purpose-silent-harm-is-the-defect)).
"""
_MAP = f"""
![Decibels lost of each condition at five severities, marked where the report warns and where not]({MAP})
"""


def stability_sections(folder: Path, pictures: Path) -> list[str]:
    """Markdown of the rows in `folder`, with the map if `pictures` holds it; none where there are no rows."""
    rows = read_rows(folder / STABILITY)
    if not rows:
        return []
    cells = []
    for series in series_in(rows):
        compared = {key: place for key, place in places_of(rows, series).items() if key[1] in _COMPARED}
        counted = count_outcomes(compared)
        counts = [str(counted.get(outcome, 0)) for outcome in WORST_FIRST]
        cells.append([series, _clean_db(rows, series), f"{sum(counted.values())} of {_PLACES}", *counts])
    command = "python -m lab stability --out lab/rows"
    drawn = [_MAP] if (pictures / MAP).exists() else []
    header = ["", "clean, dB", "measured", *WORST_FIRST]
    return [_INTRODUCTION, source(command, STABILITY, TABLE), table(header, cells), *drawn, origin(rows)]


def _clean_db(rows: Sequence[Row], series: str) -> str:
    """The mean of all seeds on the clean clip."""
    found = [row["psnr_db"] for row in rows if (row["series"], row["condition"]) == (series, CLEAN)]
    return number(fmean(map(float, found)) if found and all(found) else None, 1)
