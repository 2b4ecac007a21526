"""The part of docs/results/index.md on detail from the recorded frames: the rows of bm_detail.py, and their chart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from lab.evaluate.charts import COPY_LINES
from lab.evaluate.rows import Row, read_rows
from lab.evaluate.style import GREY, SETTINGS, figure_of, look_of, save
from lab.pages.markdown import origin, source, table

DETAIL, DETAIL_CHART, DETAIL_VIEWS = "detail.csv", "detail.png", "detail-views.jpg"
CHARTED = "d4d-a-stereo"
_INTRODUCTION = """
## Detail from the recorded frames

Views of the model alone, and with what it misses of the recorded training frames
([definition](../conventions.md#detail)); held-out frames of both eyes, views of phantoms beside the endoscope, and what
an instrument hides from the left eye. Medians of the seeds. Seconds run from the request until the scene was done.
"""
_CHART = """
Hollow marks: the model alone; filled ones: with detail; the area behind a mark is that of scene and recorded frames on
disk.

![Decibels with and without detail against seconds from the request](detail.png)
"""
_VIEWS = """
A synthetic clip at a held-out moment, from the endoscope and 3, 8 and 15 degrees beside it: the truth, the model alone,
and with detail.

![Truth, model and detail, from 0, 3, 8 and 15 degrees](detail-views.jpg)

`python -m lab.benchmarks.bm_detail --clips phantom:breathing:640x512:48frames:stereo --preset instant --iterations 150
--picture docs/results/detail-views.jpg`
"""
_COLUMNS = {
    "model_db": ("model, dB", 2), "detail_db": ("detail, dB", 2), "detail_ssim": ("SSIM", 3),
    "copy_flow_db": ("copying by flow, dB", 2), "scene_bytes": ("scene, bytes", 0),
    "recorded_bytes": ("JPEGs, bytes", 0), "detail_bytes": ("video, bytes", 0),
    "t_post_s": ("seconds", 1), "view_ms": ("view, ms", 1), "detail_ms": ("with detail, ms", 1),
}  # fmt: skip
"""By column: its name and digits."""

Run = tuple[str, str, str, str]
"""Clip, preset, limit and way of holding out."""


def detail_sections(rows: Path, pictures: Path) -> list[str]:
    """The section of bm_detail.py, with its chart; nothing without rows."""
    found = read_rows(rows / DETAIL)
    if not found:
        return []
    cells = [
        [*run, view, str(len(group)), *(_shown(group, *each) for each in _COLUMNS.items())]
        for (run, view), group in _groups(found).items()
    ]
    header = ["clip", "preset", "limit", "held out", "view", "seeds", *(name for name, _ in _COLUMNS.values())]
    chart = _CHART if (pictures / DETAIL_CHART).exists() else ""
    views = _VIEWS if (pictures / DETAIL_VIEWS).exists() else ""
    command = source("python -m lab.benchmarks.bm_detail", DETAIL)
    return [_INTRODUCTION, chart, views, command, table(header, cells), origin(found)]


def draw_detail(rows: Sequence[Row], folder: Path) -> None:
    """The chart of the recorded clip, a panel for each eye and way of holding out, into folder."""
    import matplotlib as mpl
    from matplotlib.lines import Line2D

    groups = {each: group for each, group in _groups(rows).items() if each[0][0] == CHARTED}
    panels = sorted({(run[3], view) for run, view in groups}, key=lambda each: (each[0] != "every8", each))
    if not panels:
        return
    with mpl.rc_context(SETTINGS):
        handles = [
            Line2D([], [], color=look.colour, marker=look.marker, linestyle="none", label=preset)
            for preset in dict.fromkeys(run[1] for run, _ in groups)
            for look in [look_of(preset)]
        ]
        handles += [Line2D([], [], color=GREY, dashes=dashes, label=name) for name, dashes in COPY_LINES.values()]
        figure, axes = figure_of(len(panels), 2, handles)
        for axis, (holdout, view) in zip(axes, panels, strict=True):
            axis.set_title(f"{holdout}, {view} eye")
            axis.set_xlabel("seconds since the request (log)")
            axis.set_ylabel("held-out psnr_tissue, dB")
            axis.set_xscale("log")
            here = {run: group for (run, eye), group in groups.items() if (run[3], eye) == (holdout, view)}
            lefts = {run: groups[run, "left"] for run in here if (run, "left") in groups}
            _marks(axis, here, lefts)
            for column, (_, dashes) in COPY_LINES.items() if view == "left" else ():
                axis.axhline(_median(next(iter(here.values())), column), color=GREY, linewidth=1.0, dashes=dashes)
            axis.xaxis.set_major_formatter(mpl.ticker.ScalarFormatter())
            axis.xaxis.set_minor_formatter(mpl.ticker.NullFormatter())
            axis.set_xlim(5, 100)
            axis.set_xticks([5, 10, 20, 50, 100])
        save(figure, folder, DETAIL_CHART.removesuffix(".png"))


def _marks(axis: Any, groups: Mapping[Run, Sequence[Row]], lefts: Mapping[Run, Sequence[Row]]) -> None:
    """For each run a line from the model's score to that with detail. lefts have seconds and bytes."""
    for run, group in groups.items():
        if run not in lefts:
            continue
        look, seconds = look_of(run[1]), _median(lefts[run], "t_post_s")
        low, high = _median(group, "model_db"), _median(group, "detail_db")
        megabytes = sum(_median(lefts[run], name) for name in ("scene_bytes", "recorded_bytes", "detail_bytes")) / 1e6
        axis.plot([seconds, seconds], [low, high], color=look.colour, linewidth=1.0, zorder=2)
        axis.scatter(seconds, high, s=5 * megabytes, c=look.colour, alpha=0.25, linewidths=0, zorder=2)
        for score, face in ((low, "white"), (high, look.colour)):
            axis.scatter(seconds, score, s=30, c=face, marker=look.marker, edgecolors=look.colour, zorder=4)


def _groups(rows: Sequence[Row]) -> dict[tuple[Run, str], list[Row]]:
    """The rows of all seeds, by run and view."""
    found: dict[tuple[Run, str], list[Row]] = {}
    for row in rows:
        found.setdefault(((row["clip"], row["preset"], row["limit"], row["holdout"]), row["view"]), []).append(row)
    return found


def _median(rows: Sequence[Row], name: str) -> float:
    return median(float(row[name]) for row in rows if row[name])


def _shown(rows: Sequence[Row], name: str, column: tuple[str, int]) -> str:
    return f"{_median(rows, name):.{column[1]}f}" if any(row[name] for row in rows) else "–"
