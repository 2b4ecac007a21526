"""The part of docs/results/index.md from the rows of `python -m lab stability`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from lab.conditions import CLEAN, CONDITIONS, SEVERITIES
from lab.evaluate.atlas import WORST_FIRST, count_outcomes, places_of, series_in
from lab.evaluate.rows import Row
from lab.evaluate.stability import STABILITY, stability_rows
from lab.evaluate.stability_command import TABLE
from lab.evaluate.verdict import MAX_DEPTH_LOSS_MM, MAX_LOSS_DB
from lab.pages.markdown import number, origin, source, table

_COMPARED = (3, 5)
"""The severities at which methods are compared."""
_PLACES = len(CONDITIONS) * len(_COMPARED)
_LIGHT = (
    "smoke", "smoke_stereo", "splash", "splash_stereo", "exposure_drift", "auto_exposure", "white_balance",
    "advancing_lamp",
)  # fmt: skip
_LIT_SERIES = ("fast", "paper")
MAP = "stability-fast.png"
_INTRODUCTION = f"""
## Where methods break, and whether they say so

A synthetic clip is spoilt in {len(CONDITIONS)} ways at {len(SEVERITIES)} severities; the table counts severities
{" and ".join(map(str, _COMPARED))}. Silent is the defect: a loss of more than {MAX_LOSS_DB:g} dB against the method's
own clean clip, or of {MAX_DEPTH_LOSS_MM:g} mm of depth, without a warning ([how it is judged, and why some are
silent](../decisions/evaluation.md#clips-are-spoilt-on-purpose-silent-harm-is-the-defect)).
"""
_LIGHT_TEXT = """
Scores against the clean tissue where the light is spoilt, in dB: plain, and behind a stroke after one fit of gain and
offset by channel to all that is judged.
"""
_MAP = f"""
![Decibels lost of each condition at five severities, marked where the report warns and where not]({MAP})
"""


def stability_sections(folder: Path, pictures: Path) -> list[str]:
    """Markdown of the rows in `folder`, with the map if `pictures` holds it; none where there are no rows."""
    rows = stability_rows(folder)
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
    counts_table = table(header, cells)
    return [_INTRODUCTION, source(command, STABILITY, TABLE), counts_table, *drawn, *_light(rows), origin(rows)]


def _light(rows: Sequence[Row]) -> list[str]:
    """The scores in spoilt light, with their text; none without rows that have them."""
    header = ["", *(f"{series}, severity {each}" for series in _LIT_SERIES for each in (0, *_COMPARED))]
    cells = []
    for name in _LIGHT:
        condition = CONDITIONS[name]
        places = [
            (series, condition.clean_name if severity == 0 else name, str(severity))
            for series in _LIT_SERIES
            for severity in (0, *_COMPARED)
        ]
        scores = [_scores(rows, *place) for place in places]
        if any(scores):
            cells.append([condition.title, *(score or number(None, 1) for score in scores)])
    return [_LIGHT_TEXT, table(header, cells)] if cells else []


def _scores(rows: Sequence[Row], series: str, condition: str, severity: str) -> str:
    """Plain / fitted, means over seeds; empty where they were not measured."""
    place = (series, condition, severity)
    found = [row for row in rows if (row["series"], row["condition"], row["severity"]) == place and row["fitted_db"]]
    means = [fmean(float(row[name]) for row in found) for name in ("psnr_db", "fitted_db") if found]
    return " / ".join(number(mean, 1) for mean in means)


def _clean_db(rows: Sequence[Row], series: str) -> str:
    """The mean of all seeds on the clean clip."""
    found = [row["psnr_db"] for row in rows if (row["series"], row["condition"]) == (series, CLEAN)]
    return number(fmean(map(float, found)) if found and all(found) else None, 1)
