"""The charts, drawn from rows alone: a row of panels a clip, a column a way of holding out.

curves  held-out psnr_tissue against seconds of training
pareto  its end against the seconds it took, a mark's area the scene's bytes; the front joins what nothing beats in both
frames  its end against images rendered a second
knee    of the grid of capacities: its end against the scene's bytes, and where the automatic choice lies

What was not measured is named in its panel. Copying the neighbouring frames is dashed everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from worker.evaluate.cells import DEFAULT_SERIES, base_of, preset_of
from worker.evaluate.published import LABEL, RESULTS, Published
from worker.evaluate.rows import Results, Row
from worker.evaluate.style import (
    BASES_LOOKS,
    FAINT,
    GREY,
    SETTINGS,
    Look,
    add_legend,
    figure_of,
    look_of,
    save,
)
from worker.evaluate.summary import Group, capacities, groups_of

AREA_A_MEGABYTE = 6.0
"""Points squared; a scene of 33 MB is a mark of 16 points across, one of 2 MB of 4."""
LEAST_AREA = 9.0
REAL_CLIP = "d4d-a"
"""Published figures stand beside the real clip alone, held out as the papers do."""
PAPERS_HOLDOUT = "every8"
DECIBEL = "held-out psnr_tissue, dB"


def draw_all(results: Results, folder: Path) -> list[str]:
    """Draw what the rows allow into folder; the names of the charts that were drawn."""
    import matplotlib as mpl

    groups = groups_of(results.runs)
    presets = [group for group in groups if group.series == base_of(group.series)]
    drawn = []
    with mpl.rc_context(SETTINGS):
        if any(group.rows for group in presets):
            _draw(presets, lambda axis, here: _curves(axis, here, results.curves), folder, "curves")
            _draw(presets, _pareto, folder, "pareto")
            _draw([group for group in presets if group.clip == presets[0].clip], _pareto, folder, "pareto-first-clip")
            _draw(presets, _frames, folder, "frames")
            drawn += ["curves", "pareto", "pareto-first-clip", "frames"]
        if capacities(groups):
            _draw_knee(groups, folder)
            drawn.append("knee")
    return drawn


def _draw(groups: Sequence[Group], draw_panel: Callable[[Any, Sequence[Group]], None], folder: Path, name: str) -> None:
    """One panel a place, the legend of all series below."""
    clips, holdouts = _grid(groups)
    figure, axes = figure_of(len(clips), len(holdouts))
    for clip, axis_row in zip(clips, axes, strict=True):
        for holdout, axis in zip(holdouts, axis_row, strict=True):
            here = [group for group in groups if group.place == (clip, holdout)]
            axis.set_title(_title(clip, holdout, here))
            axis.set_ylabel(DECIBEL)
            draw_panel(axis, here)
            _copies(axis, here)
            _name_missing(axis, here)
    series = list(dict.fromkeys(group.series for group in groups if group.rows))
    with_published = name != "curves" and (REAL_CLIP, PAPERS_HOLDOUT) in {group.place for group in groups}
    add_legend(figure, _handles(series, name != "curves", with_published))
    save(figure, folder, name)


def _curves(axis: Any, groups: Sequence[Group], curves: Sequence[Row]) -> None:
    """Every run of a group, the one that ends in the middle drawn strongly."""
    axis.set_xscale("log")
    axis.set_xlabel("seconds of training (log)")
    for group in groups:
        runs = {row["seed"]: float(row["psnr_tissue_db"] or "nan") for row in group.rows}
        ranked = sorted(runs, key=lambda seed: runs[seed])
        look = look_of(group.series)
        for seed in ranked:
            points = [
                (float(row["t_train_s"]), float(row["psnr_tissue_db"]))
                for row in curves
                if (row["clip"], row["holdout"], row["series"], row["limit"], row["seed"])
                == (*group.place, group.series, group.limit, seed)
            ]
            if not points:
                continue
            is_middle = seed == ranked[len(ranked) // 2]
            seconds, decibels = zip(*sorted(points), strict=True)
            style = {"marker": look.marker, "markersize": 4.5, "linewidth": 1.6} if is_middle else {"alpha": 0.35}
            axis.plot(seconds, decibels, color=look.colour, zorder=3 if is_middle else 2, **style)
    _plain_ticks(axis.xaxis)


def _pareto(axis: Any, groups: Sequence[Group]) -> None:
    axis.set_xscale("log")
    axis.set_xlabel("seconds of training (log)")
    _marks(axis, groups, "t_train_s")
    _front(axis, groups)
    if groups and groups[0].place == (REAL_CLIP, PAPERS_HOLDOUT):
        _published(axis, lambda each: each.train_s)
    _plain_ticks(axis.xaxis)


def _frames(axis: Any, groups: Sequence[Group]) -> None:
    axis.set_xscale("log")
    axis.set_xlabel("images rendered a second, at the clip's size (log)")
    _marks(axis, groups, "render_fps")
    if groups and groups[0].place == (REAL_CLIP, PAPERS_HOLDOUT):
        _published(axis, lambda each: each.fps)
    _plain_ticks(axis.xaxis)


def _marks(axis: Any, groups: Sequence[Group], across: str) -> None:
    """A mark a group at its medians, its area the scene's bytes; the limit beside it if the series has several."""
    for group in groups:
        x, y = group.median(across), group.median("psnr_tissue_db")
        if math.isnan(x) or math.isnan(y):
            continue
        look = look_of(group.series)
        area = max(LEAST_AREA, AREA_A_MEGABYTE * group.median("scene_bytes") / 1e6)
        axis.scatter(
            x, y, s=area, c=look.colour, marker=look.marker, alpha=0.85, edgecolors="white", linewidths=0.6, zorder=3
        )
        if len({each.limit for each in groups if each.series == group.series}) > 1:
            offset = 3 + math.sqrt(area) / 2
            axis.annotate(group.limit, (x, y), (offset, -3), textcoords="offset points", fontsize=7, color=GREY)


def _front(axis: Any, groups: Sequence[Group]) -> None:
    """Joins the groups that no other beats in both seconds and decibels."""
    points = sorted((group.median("t_train_s"), group.median("psnr_tissue_db")) for group in groups if group.rows)
    front: list[tuple[float, float]] = []
    for x, y in points:
        if not math.isnan(y) and (not front or y > front[-1][1]):
            front.append((x, y))
    if len(front) > 1:
        axis.plot(*zip(*front, strict=True), color=GREY, linewidth=1.0, zorder=1)


def _published(axis: Any, across: Callable[[Published], float | None]) -> None:
    for each in RESULTS:
        x = across(each)
        if each.data != "EndoNeRF" or x is None:
            continue
        axis.scatter(x, each.psnr_paper_db, s=45, facecolors="none", edgecolors=GREY, linewidths=1.0, zorder=2)
        axis.annotate(
            each.method, (x, each.psnr_paper_db), (0, -11), textcoords="offset points", ha="center", fontsize=7,
            color=GREY,
        )  # fmt: skip


def _copies(axis: Any, groups: Sequence[Group]) -> None:
    """Dashed: what copying the neighbouring frames scores, blended and by optical flow."""
    for name, what, dashes in (("copy_blend_db", "blend", (5, 3)), ("copy_flow_db", "flow", (2, 2))):
        known = [group.median(name) for group in groups if not math.isnan(group.median(name))]
        if not known:
            continue
        axis.axhline(known[0], color=GREY, linewidth=1.0, dashes=dashes, zorder=1)
        axis.annotate(
            f"copying: {what}", (0, known[0]), (4, 2), xycoords=("axes fraction", "data"),
            textcoords="offset points", fontsize=7, color=GREY,
        )  # fmt: skip


def _name_missing(axis: Any, groups: Sequence[Group]) -> None:
    """Says in the panel which series have no figure here, and which failed."""
    failed = [group.series for group in groups if group.errors and not group.rows]
    present = {group.series for group in groups}
    missing = [series for series in DEFAULT_SERIES if series not in present]
    lines = [f"{word}: {', '.join(names)}" for word, names in (("failed", failed), ("missing", missing)) if names]
    axis.text(
        0.99,
        0.02,
        "\n".join(lines),
        transform=axis.transAxes,
        ha="right",
        va="bottom",
        fontsize=7,
        color=GREY,
        wrap=True,
    )


def _draw_knee(groups: Sequence[Group], folder: Path) -> None:
    """A line a number of bases over the numbers of Gaussians; a star where the automatic choice lies."""
    from matplotlib.lines import Line2D

    choices = [each.chosen for each in capacities(groups)]
    clips, holdouts = _grid(choices)
    figure, axes = figure_of(len(clips), len(holdouts))
    shown: dict[int, Look] = {}
    for axis, place in ((axes[i][j], (a, b)) for i, a in enumerate(clips) for j, b in enumerate(holdouts)):
        axis.set_title(_title(*place, [group for group in groups if group.place == place]))
        axis.set_ylabel(DECIBEL)
        axis.set_xlabel("scene on disk, MB (log)")
        axis.set_xscale("log")
        for chosen in (each for each in choices if each.place == place):
            grid = [each for each in groups if each.place == place and base_of(each.series) == chosen.series]
            lines: dict[int, list[Group]] = {}
            for group in grid:
                if group.series != chosen.series and group.limit == chosen.limit and group.rows:
                    lines.setdefault(preset_of(group.series).bases, []).append(group)
            for number, bases in enumerate(sorted(lines)):
                shown[bases] = BASES_LOOKS[number % len(BASES_LOOKS)]
                _knee_line(axis, lines[bases], shown[bases])
            x, y = chosen.median("scene_bytes") / 1e6, chosen.median("psnr_tissue_db")
            axis.scatter(x, y, s=170, marker="*", c=look_of(chosen.series).colour, edgecolors="white", zorder=4)
        _copies(axis, [each for each in groups if each.place == place])
        _plain_ticks(axis.xaxis)
    handles = [
        Line2D([], [], color=look.colour, marker=look.marker, label=f"{bases} bases")
        for bases, look in sorted(shown.items())
    ]
    star: dict[str, Any] = {"marker": "*", "markersize": 12, "linestyle": "none"}
    add_legend(figure, [*handles, Line2D([], [], color=look_of("fast").colour, label="automatic choice", **star)])
    save(figure, folder, "knee")


def _knee_line(axis: Any, groups: Sequence[Group], look: Look) -> None:
    points = sorted((group.median("scene_bytes") / 1e6, group.median("psnr_tissue_db")) for group in groups)
    axis.plot(*zip(*points, strict=True), color=look.colour, marker=look.marker, markersize=5, linewidth=1.3)


def _handles(series: Sequence[str], with_areas: bool, with_published: bool) -> list[Any]:
    """The legend's entries."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=look_of(name).colour, marker=look_of(name).marker, label=name,
               linestyle="none" if with_areas else "-")
        for name in series
    ]  # fmt: skip
    if with_areas:
        for megabytes in (2, 30, 100):
            size = math.sqrt(AREA_A_MEGABYTE * megabytes)
            handles.append(Line2D([], [], color=FAINT, marker="o", markersize=size, linestyle="none",
                                  label=f"{megabytes} MB"))  # fmt: skip
    if with_published:
        handles.append(Line2D([], [], color=GREY, marker="o", markerfacecolor="none", linestyle="none", label=LABEL))
    return handles


def _grid(groups: Sequence[Group]) -> tuple[list[str], list[str]]:
    """Clips and ways of holding out, in the order of the rows."""
    return list(dict.fromkeys(each.clip for each in groups)), list(dict.fromkeys(each.holdout for each in groups))


def _title(clip: str, holdout: str, groups: Sequence[Group]) -> str:
    sizes = {(row["width"], row["height"]) for group in groups for row in group.rows if row["width"]}
    size = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
    return ", ".join(filter(None, (clip, holdout, size)))


def _plain_ticks(axis: Any) -> None:
    """1, 2, 5, 10 instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
