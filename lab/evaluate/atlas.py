"""The stability atlas, drawn from rows alone: one heat map a method, and a table of what the user is told.

A cell of the map is a condition at a severity. It shows the loss in dB against the clean clip, mean over seeds, behind
a stroke the loss after a fit of gain and offset where that differs, and a mark for the worst outcome of any seed. Its
colour is the loss that decides. Unmeasured cells are hatched.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.conditions import CONDITIONS, SEVERITIES
from lab.evaluate.rows import Row
from lab.evaluate.style import GREY, SETTINGS, save
from lab.evaluate.verdict import MAX_DEPTH_LOSS_MM, MAX_LOSS_DB, SEPARATOR, judged_by

WORST_FIRST = ("silent", "crashed", "unknown", "diverged", "told", "refused", "held")
MARKS = {"silent": "X", "told": "^", "refused": "s", "diverged": "D", "crashed": "P", "unknown": "$?$"}
"""Matplotlib's markers by outcome; an unharmed cell has none."""
MEANINGS = {
    "silent": "harmed, and nothing was said",
    "told": "harmed, and the report warns",
    "refused": "refused, with the reason",
    "diverged": "ended in an error that says why",
    "crashed": "ended in an error nobody foresaw",
    "unknown": "the clean clip has no score to compare with",
}
FULL_COLOUR_DB = 10.0
"""Losses above this have the same colour: none of these results is usable."""
FIT_MATTERS_DB = 0.5
"""Smaller differences between the losses with and without a fit are not shown."""
COLOURS = "Blues"  # one hue, light to dark: read in print and by the colour-blind
DARK_FROM = 0.6  # of the scale, from where white writing is read better
ROW_INCHES, COLUMN_INCHES, LABEL_INCHES = 0.3, 1.35, 3.6
MAX_TOLD_CHARACTERS = 150


@dataclass(frozen=True)
class MapCell:
    """All seeds of a condition at a severity by one method; losses are means, NaN if unknown.

    fitted_loss_db is the loss after a fit of gain and offset, judged_db the one of both that decides; spread_db is the
    largest loss less the smallest, 0 for one seed.
    """

    outcome: str
    loss_db: float
    fitted_loss_db: float
    judged_db: float
    spread_db: float
    depth_loss_mm: float
    told: str


MapCells = Mapping[tuple[str, int], MapCell]


def places_of(rows: Sequence[Row], series: str) -> dict[tuple[str, int], MapCell]:
    """The places of a method that have rows, by condition and severity; the clean clips are among them."""
    gathered: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        if row["series"] == series:
            gathered.setdefault((row["condition"], int(row["severity"])), []).append(row)
    return {key: _place(each) for key, each in gathered.items()}


def series_in(rows: Sequence[Row]) -> list[str]:
    """The methods that have rows, in the order of their first."""
    return list(dict.fromkeys(row["series"] for row in rows))


def draw_map(places: MapCells, series: str, folder: Path) -> str:
    """stability-SERIES.png and .svg in folder; returns the name without its ending."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    shown = [name for name in CONDITIONS if any(key[0] == name for key in places)] or list(CONDITIONS)
    name = map_name(series)
    size = (LABEL_INCHES + COLUMN_INCHES * (len(SEVERITIES) + 0.6), 1.9 + ROW_INCHES * len(shown))
    with mpl.rc_context(SETTINGS | {"axes.grid": False}):
        figure = Figure(figsize=size, layout="constrained")
        axis = figure.subplots()
        losses = np.array([[_loss(places.get((each, level))) for level in SEVERITIES] for each in shown])
        colours = mpl.colormaps[COLOURS].with_extremes(bad="none")
        image = axis.imshow(losses, cmap=colours, vmin=0, vmax=FULL_COLOUR_DB, aspect="auto")
        for row, condition in enumerate(shown):
            for column, severity in enumerate(SEVERITIES):
                _write(axis, column, row, places.get((condition, severity)), CONDITIONS[condition].levels[column])
        axis.set_xticks(range(len(SEVERITIES)), [f"severity {each}" for each in SEVERITIES])
        axis.set_yticks(range(len(shown)), [CONDITIONS[each].title for each in shown])
        axis.tick_params(length=0, top=True, labeltop=True, bottom=False, labelbottom=False)
        axis.set_title(_title(places, series))
        figure.colorbar(
            image, label="dB lost against the clean clip (/ after a fit of gain and offset)", extend="max", shrink=0.6
        )
        figure.legend(handles=_handles(places), loc="outside lower center", ncols=2, fontsize=8.5)
        save(figure, folder, name)
    return name


def map_name(series: str) -> str:
    """What the files of a method's map are called, without their ending."""
    return "stability-" + "".join(each if each.isalnum() or each in "-_" else "-" for each in series)


def told_table(places: MapCells, series: str) -> str:
    """Markdown: of each condition, how each severity ended, and what the user is told at the highest one measured."""
    lines = [
        f"| {series} | severity 1 | 2 | 3 | 4 | 5 | what the user is told at the highest |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, condition in CONDITIONS.items():
        here = [places.get((name, severity)) for severity in SEVERITIES]
        measured = [place for place in here if place is not None]
        if measured:
            cells = " | ".join(_in_words(place) for place in here)
            lines.append(f"| {condition.title} | {cells} | {measured[-1].told or 'nothing'} |")
    return "\n".join(lines) + "\n"


def count_outcomes(places: MapCells) -> dict[str, int]:
    """How many places ended in each way, the worst first; ways that none ended in are left out."""
    spoilt = [place.outcome for (_, severity), place in places.items() if severity in SEVERITIES]
    return {outcome: spoilt.count(outcome) for outcome in WORST_FIRST if outcome in spoilt}


def _place(rows: Sequence[Row]) -> MapCell:
    worst = min(rows, key=lambda row: WORST_FIRST.index(row["outcome"]))
    told = worst["error"].partition(": ")[2] or worst["new_warnings"].split(SEPARATOR)[0]
    if len(told) > MAX_TOLD_CHARACTERS:
        told = told[:MAX_TOLD_CHARACTERS].rpartition(" ")[0] + " ..."
    losses_db = _known(rows, "loss_db")
    return MapCell(
        outcome=worst["outcome"],
        loss_db=_mean(losses_db),
        fitted_loss_db=_mean(_known(rows, "fitted_loss_db")),
        judged_db=_mean(_known(rows, judged_by(rows[0]["condition"]))),
        spread_db=max(losses_db) - min(losses_db) if losses_db else 0.0,
        depth_loss_mm=_mean(_known(rows, "depth_loss_mm")),
        told=told.replace("|", "/"),
    )


def _known(rows: Sequence[Row], name: str) -> list[float]:
    return [float(row[name]) for row in rows if row[name]]


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _loss(place: MapCell | None) -> float:
    return math.nan if place is None else place.judged_db


def _write(axis: Any, column: int, row: int, place: MapCell | None, level: float) -> None:
    """A place's figures and mark; hatching where it was not measured. The level stands small in its corner."""
    from matplotlib.patches import Rectangle

    corner = (column - 0.5, row - 0.5)
    if place is None:
        axis.add_patch(Rectangle(corner, 1, 1, fill=False, hatch="////", edgecolor="#d0d0d0", linewidth=0))
        return
    dark = not math.isnan(place.judged_db) and place.judged_db / FULL_COLOUR_DB > DARK_FROM
    ink = "white" if dark else "black"
    axis.text(column - 0.46, row, f"{level:g}", ha="left", va="center", fontsize=6, color=ink, alpha=0.75)
    axis.text(column + 0.06, row, _figures(place), ha="center", va="center", fontsize=7.5, color=ink)
    if place.outcome == "silent":
        axis.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor="#D55E00", linewidth=2.2))
    if marker := MARKS.get(place.outcome):
        axis.plot(column + 0.4, row, marker=marker, color=ink, markersize=5, fillstyle=_fill(place.outcome))


def _fill(outcome: str) -> Any:
    return "full" if outcome in ("silent", "crashed") else "none"


def _figures(place: MapCell) -> str:
    if math.isnan(place.loss_db):
        return place.outcome
    harmed_in_depth = place.depth_loss_mm > MAX_DEPTH_LOSS_MM
    fit_matters = abs(place.loss_db - place.fitted_loss_db) >= FIT_MATTERS_DB  # not where it is NaN
    fitted = f" / {place.fitted_loss_db:z.1f}" if fit_matters else ""
    return f"{place.loss_db:z.1f}{fitted}" + (f", {place.depth_loss_mm:.0f} mm" if harmed_in_depth else "")


def _in_words(place: MapCell | None) -> str:
    if place is None:
        return ""
    spread = f" (spread {place.spread_db:.1f})" if place.spread_db else ""
    figures = "" if math.isnan(place.loss_db) else f" {_figures(place)}{spread}"
    return (f"**{place.outcome}**" if place.outcome in ("silent", "crashed") else place.outcome) + figures


def _title(places: MapCells, series: str) -> str:
    counted = ", ".join(f"{number} {outcome}" for outcome, number in count_outcomes(places).items())
    return f"{series}: {counted}\n(harmed: over {MAX_LOSS_DB:g} dB, or over {MAX_DEPTH_LOSS_MM:g} mm of depth)"


def _handles(places: MapCells) -> list[Any]:
    """The legend: the marks in use."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    used = count_outcomes(places)
    handles: list[Any] = [
        Line2D([], [], linestyle="none", marker=MARKS[outcome], color="black", fillstyle=_fill(outcome), label=meaning)
        for outcome, meaning in MEANINGS.items()
        if outcome in used
    ]
    return [*handles, Patch(facecolor="white", edgecolor=GREY, hatch="////", label="not measured")]
