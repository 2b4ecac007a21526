"""The charts, drawn from rows alone: a row of panels per clip, a column per way of holding out.

curves  held-out psnr_tissue against seconds of training; curves-ssim, curves-depth: SSIM, median depth error
curves-eyes  the same of the left eye and of the right eye beside each other, where a clip has two
pareto  its end against the seconds it took; a line joins the Pareto front
pareto-right  the same for the right eye
curves-post, pareto-post  the same against seconds from the request; pareto-one-clip has both clocks
frames  its end against images rendered a second
knee    of the grid of capacities: its end against the scene's bytes, and where the automatic choice lies

The area of the disc behind a mark is the scene's size on disk; a small scene's disc is hidden by its mark. Unmeasured
series are named over their panel, and a clock that no row has gets no chart. Dashed lines are the scores of copying the
neighbouring frames, and for the right eye of warping the left eye's picture of the same moment. Series trained on the
left eye alone have hollow marks.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from lab.evaluate.cells import DEFAULT_SERIES, base_of, expected_beside, preset_of
from lab.evaluate.published import LABEL, RESULTS
from lab.evaluate.rows import Results, Row, key_of
from lab.evaluate.style import BASES_LOOKS, FAINT, GREY, SETTINGS, Look, figure_of, look_of, save
from lab.evaluate.summary import Group, Place, capacities, groups_of

AREA_A_MEGABYTE, MARK_AREA = 5.0, 30.0
"""Points squared: a scene of 33 MB has a disc of 14 points across; one of less than 6 MB is behind its mark."""
LEGEND_MEGABYTES = (10, 50)
SHOWN_BELOW_WORST_DB = 6.0
"""Curves start far below their ends; parts that lie this far below the worst end are cut off."""
MAX_FINE_TICKS = 500
"""An axis that spans more than this factor has ticks only at powers of ten, because others would overlap."""
REAL_CLIPS, PAPERS_HOLDOUT = ("d4d-a", "d4d-a-320x256"), "every8"
"""Published figures are drawn only for the real clip, at any size, with the papers' held-out frames."""
SCORE, DECIBEL = "psnr_tissue_db", "held-out psnr_tissue, dB"
TRAINING, SINCE_REQUEST, SPEED = "t_train_s", "t_post_s", "render_fps"
OVER_TIME = {
    "curves": (SCORE, DECIBEL, TRAINING),
    "curves-post": (SCORE, DECIBEL, SINCE_REQUEST),
    "curves-ssim": ("ssim", "held-out SSIM", TRAINING),
    "curves-depth": ("depth_agreement_mm", "median depth error, mm", TRAINING),
}
"""By chart: the column of curves.csv, its label, and the clock."""
ACROSS = {
    TRAINING: "seconds of training (log)",
    SINCE_REQUEST: "seconds since the request (log)",
    SPEED: "images rendered a second, at the clip's size (log)",
}
"""By column: the label of the x axis."""
RIGHT = "psnr_right_db"
EYES = {
    "left eye": (SCORE, DECIBEL),
    "right eye": (RIGHT, "held-out psnr_right, dB"),
}
"""By eye: its column in both files, and its label."""
COPY_LINES = {"copy_blend_db": ("copying: blend", (5, 3)), "copy_flow_db": ("copying: flow", (2, 2))}
WARP_LINES = {"warp_db": ("warped left eye", (5, 3))}
"""By column: the label of a dashed line, and its dashes."""

Points = list[tuple[float, float]]
DrawPanel = Callable[[Any, Sequence[Group], str], list[str]]
"""Draws groups of one place over a column of ACROSS; returns the series that have no figure in it."""


def draw_all(results: Results, folder: Path) -> list[str]:
    """Draw all charts for which there are rows into folder. Returns their names."""
    import matplotlib as mpl

    groups = groups_of(results.runs)
    choices = [each.chosen for each in capacities(groups)]
    presets = [group for group in groups if group.series == base_of(group.series) and group not in choices]
    drawn = []
    with mpl.rc_context(SETTINGS):
        if any(group.rows for group in presets):
            drawn += _draw_presets(presets, results.curves, folder)
        if stereo := _at_places(presets, lambda group: not math.isnan(group.median(RIGHT))):
            _draw_eyes(stereo, results.curves, folder)
            _draw(stereo, partial(_ends, score=RIGHT), folder, "pareto-right", [TRAINING])
            drawn += ["curves-eyes", "pareto-right"]
        if choices:
            _draw_knee(groups, choices, folder)
            drawn.append("knee")
    return drawn


def _draw_presets(presets: Sequence[Group], curves: Sequence[Row], folder: Path) -> list[str]:
    """Draw the charts that need neither a second eye nor the grid. Returns their names."""
    drawn = []
    since_request = _points_by_run(curves, SCORE, SINCE_REQUEST)
    with_curves = _at_places(presets, lambda group: any(key_of(row) in since_request for row in group.rows))
    with_ends = _at_places(presets, lambda group: not math.isnan(group.median(SINCE_REQUEST)))
    for name, (column, _, clock) in OVER_TIME.items():
        if _points_by_run(curves, column, clock):
            groups = with_curves if clock == SINCE_REQUEST else presets
            _draw(groups, partial(_curves, rows=curves, score=column), folder, name, [clock])
            drawn.append(name)
    alone = [group for group in presets if group.clip == clip_alone(presets)]
    for name, (groups, columns) in {
        "pareto": (presets, [TRAINING]),
        "pareto-post": (with_ends, [SINCE_REQUEST]),
        "pareto-one-clip": (alone, [TRAINING, SINCE_REQUEST]),
        "frames": (presets, [SPEED]),
    }.items():
        if known := [each for each in columns if any(not math.isnan(group.median(each)) for group in groups)]:
            _draw(groups, _ends, folder, name, known)
            drawn.append(name)
    return drawn


def clip_alone(groups: Sequence[Group]) -> str:
    """The clip of the chart that shows one alone: the real one if it was measured, else the first."""
    clips = [group.clip for group in groups if group.rows]
    return next((clip for clip in REAL_CLIPS if clip in clips), clips[0])


def _draw(groups: Sequence[Group], draw_panel: DrawPanel, folder: Path, name: str, across: Sequence[str]) -> None:
    """One panel per column across and place, the legend of all series below."""
    panels = [(column, place) for column in across for place in _places(groups)]
    figure, axes = figure_of(len(panels), _columns([place for _, place in panels]), _handles(groups, name))
    for (column, place), axis in zip(panels, axes, strict=True):
        here = [group for group in groups if group.place == place]
        if not here:
            _leave_empty(axis, place)
            continue
        axis.set_xlabel(ACROSS[column])
        score, label, _ = OVER_TIME.get(name, (SCORE, DECIBEL, column))
        axis.set_ylabel(EYES["right eye"][1] if name == "pareto-right" else label)
        without = draw_panel(axis, here, column)
        _name(axis, place, here, _missing(here, {f"without {column if score == SCORE else score}": without}))
        if score == SCORE:
            _dashed(axis, here, WARP_LINES if name == "pareto-right" else COPY_LINES)
        _finish(axis)
        if name in OVER_TIME and score == SCORE:
            _cut_below([axis], [group.median(SCORE) for group in here])
    save(figure, folder, name)


def _at_places(groups: Sequence[Group], is_known: Callable[[Group], bool]) -> list[Group]:
    """The groups of the places where is_known is true for any group."""
    places = {group.place for group in groups if is_known(group)}
    return [group for group in groups if group.place in places]


def _draw_eyes(groups: Sequence[Group], curves: Sequence[Row], folder: Path) -> None:
    """Two panels per place on one scale: the held-out frames of the left eye, and of the right."""
    places = list(dict.fromkeys(group.place for group in groups))
    figure, axes = figure_of(2 * len(places), 2, _handles(groups, "curves"))
    for place, *pair in zip(places, axes[::2], axes[1::2], strict=True):
        here = [group for group in groups if group.place == place]
        for axis, (eye, (column, label)) in zip(pair, EYES.items(), strict=True):
            _name(axis, place, here, eye)
            axis.set_xlabel(ACROSS[TRAINING])
            axis.set_ylabel(label)
            _curves(axis, here, TRAINING, rows=curves, score=column)
            _dashed(axis, here, WARP_LINES if column == RIGHT else COPY_LINES)
            _finish(axis)
        limits = [axis.get_ylim() for axis in pair]
        for axis in pair:
            axis.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))
        _cut_below(pair, [group.median(column) for group in here for column, _ in EYES.values()])
    save(figure, folder, "curves-eyes")


def _points_by_run(curves: Sequence[Row], column: str, clock: str) -> dict[tuple[str, ...], Points]:
    """Seconds by a clock and a score of every run's curve, by the run's key."""
    points: dict[tuple[str, ...], Points] = {}
    for row in curves:
        if row[column] and row[clock]:
            points.setdefault(key_of(row), []).append((float(row[clock]), float(row[column])))
    return {key: sorted(each) for key, each in points.items()}


def _curves(axis: Any, groups: Sequence[Group], clock: str, *, rows: Sequence[Row], score: str) -> list[str]:
    """Draw every run of a group, the one with the median end in bold. A DrawPanel with the rows of the curves."""
    points, without = _points_by_run(rows, score, clock), []
    for group in groups:
        look = look_of(group.series)
        runs = sorted((points[key_of(row)] for row in group.rows if key_of(row) in points), key=lambda run: run[-1][1])
        without += [group.series] if group.rows and not runs else []
        for place, run in enumerate(runs):
            is_middle = place == len(runs) // 2
            marks = {"marker": look.marker, "markersize": 4.5, "markerfacecolor": look.face, "linewidth": 1.6}
            style = marks if is_middle else {"alpha": 0.35}
            axis.plot(*zip(*run, strict=True), color=look.colour, zorder=3 if is_middle else 2, **style)
            if is_middle:
                _name_limit(axis, group, groups, run[-1], (3, 4))
    return without


def _ends(axis: Any, groups: Sequence[Group], across: str, *, score: str = SCORE) -> list[str]:
    """The end of every group; joined by their front where seconds lie across. A DrawPanel."""
    without = _marks(axis, groups, across, score)
    if across != SPEED:
        _front(axis, groups, across, score)
    if across != SINCE_REQUEST and groups and _has_published(groups[0].place):
        _published(axis, across)
    return without


def _marks(axis: Any, groups: Sequence[Group], across: str, score: str) -> list[str]:
    """A mark a group at its medians, and behind it a disc whose area is the scene's size; series without a mark."""
    without = []
    for group in groups:
        x, y = group.median(across), group.median(score)
        if math.isnan(x) or math.isnan(y):
            without += [group.series] if group.rows and math.isnan(x) else []
            continue
        look = look_of(group.series)
        area = AREA_A_MEGABYTE * group.median("scene_bytes") / 1e6
        axis.scatter(x, y, s=area, c=look.colour, alpha=0.25, linewidths=0, zorder=2)
        mark: dict[str, Any] = {
            "marker": look.marker,
            "edgecolors": look.edge,
            "linewidths": 1.2 if look.hollow else 0.5,
        }
        axis.scatter(x, y, s=MARK_AREA, c=look.face, zorder=4, **mark)
        _name_limit(axis, group, groups, (x, y), (2 + math.sqrt(max(area, MARK_AREA)) / 2, -3))
    return without


def _name_limit(
    axis: Any, group: Group, groups: Sequence[Group], place: tuple[float, float], offset: tuple[float, float]
) -> None:
    """The limit beside a mark, if its series was run with several."""
    if len({each.limit for each in groups if each.series == group.series}) > 1:
        colour = look_of(group.series).colour
        axis.annotate(group.limit, place, offset, textcoords="offset points", fontsize=7, color=colour, zorder=5)


def _front(axis: Any, groups: Sequence[Group], clock: str, score: str) -> None:
    """Join the groups that no other beats in both seconds and decibels."""
    points = ((group.median(clock), group.median(score)) for group in groups)
    front: Points = []
    for x, y in sorted(point for point in points if not any(map(math.isnan, point))):
        if not front or y > front[-1][1]:
            front.append((x, y))
    if len(front) > 1:
        axis.plot(*zip(*front, strict=True), color=GREY, linewidth=1.0, zorder=1)


def _published(axis: Any, across: str) -> None:
    """Draw the figures of papers as hollow, unconnected marks, with names above and below alternately."""
    for place, each in enumerate(each for each in RESULTS if each.data == "EndoNeRF"):
        x, y = each.fps if across == SPEED else each.train_s, each.psnr_paper_db
        if x is None:
            continue
        axis.scatter(x, y, s=45, facecolors="none", edgecolors=GREY, linewidths=1.0, zorder=2)
        text: dict[str, Any] = {"ha": "center", "fontsize": 7, "color": GREY, "zorder": 5}
        axis.annotate(each.method, (x, y), (0, (6, -12)[place % 2]), textcoords="offset points", **text)


def _dashed(axis: Any, groups: Sequence[Group], lines: Mapping[str, tuple[str, tuple[int, int]]]) -> None:
    """Draw the scores of copying or warping recorded pictures as dashed lines, named to the right of the panel."""
    rising = []
    for column in lines:
        known = [score for group in groups if not math.isnan(score := group.median(column))]
        rising += [(known[0], column)] if known else []
    for place, (score, column) in enumerate(sorted(rising)):
        what, dashes = lines[column]
        axis.axhline(score, color=GREY, linewidth=1.0, dashes=dashes, zorder=1)
        aligned = "center" if len(rising) == 1 else ("top", "bottom")[place]
        text: dict[str, Any] = {"fontsize": 7, "color": GREY, "va": aligned, "xycoords": ("axes fraction", "data")}
        axis.annotate(what, (1.0, score), (3, 0), textcoords="offset points", **text)


def _missing(groups: Sequence[Group], more: Mapping[str, Sequence[str]]) -> str:
    """The text on series without a figure here, on failed ones, and on those in `more`."""
    failed = [group.series for group in groups if group.errors and not group.rows]
    there = {group.series for group in groups}
    missing = [series for series in expected_beside(there) if series not in there]
    named = {"failed": failed, "missing": missing, **more}
    return "; ".join(f"{word}: {', '.join(dict.fromkeys(names))}" for word, names in named.items() if names)


def _draw_knee(groups: Sequence[Group], choices: Sequence[Group], folder: Path) -> None:
    """A line per number of bases over the numbers of Gaussians; a star where the automatic choice lies."""
    bases = {each.series: preset_of(each.series).bases or 0 for each in groups if each.series != base_of(each.series)}
    looks = dict(zip(sorted(set(bases.values())), itertools.cycle(BASES_LOOKS), strict=False))
    places = _places(choices)
    figure, axes = figure_of(len(places), _columns(places), _knee_handles(looks))
    for place, axis in zip(places, axes, strict=True):
        here = [group for group in groups if group.place == place]
        _name(axis, place, here, "")
        axis.set_xlabel("scene on disk, MB (log)")
        axis.set_ylabel(DECIBEL)
        for chosen in (each for each in choices if each.place == place):
            variants = [
                each
                for each in here
                if each.rows and each.limit == chosen.limit and base_of(each.series) == chosen.series
            ]
            for number, look in looks.items():
                points = [_size_and_score(each) for each in variants if bases.get(each.series) == number]
                if points:
                    line: dict[str, Any] = {"marker": look.marker, "markersize": 5, "linewidth": 1.3}
                    axis.plot(*zip(*sorted(points), strict=True), color=look.colour, **line)
            star = {"s": 170, "marker": "*", "edgecolors": "white", "zorder": 4}
            axis.scatter(*_size_and_score(chosen), c=look_of(chosen.series).colour, **star)
        _dashed(axis, here, COPY_LINES)
        _finish(axis)
    save(figure, folder, "knee")


def _size_and_score(group: Group) -> tuple[float, float]:
    """Megabytes and decibels."""
    return group.median("scene_bytes") / 1e6, group.median(SCORE)


def _knee_handles(looks: dict[int, Look]) -> list[Any]:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=x.colour, marker=x.marker, label=f"{bases} bases") for bases, x in looks.items()]
    star: dict[str, Any] = {"marker": "*", "markersize": 12, "linestyle": "none"}
    return [*handles, Line2D([], [], color=look_of("fast").colour, label="automatic choice", **star)]


def _handles(groups: Sequence[Group], name: str) -> list[Any]:
    """The legend's entries: every series, and other elements of the chart."""
    from matplotlib.lines import Line2D

    line = "-" if name in OVER_TIME else "none"
    known = {series: place for place, series in enumerate(DEFAULT_SERIES)}
    series = sorted({group.series for group in groups if group.rows}, key=lambda each: (known.get(each, 99), each))
    looks = {each: look_of(each) for each in series}
    handles = [
        Line2D([], [], color=look.colour, marker=look.marker, markerfacecolor=look.face, label=each, linestyle=line)
        for each, look in looks.items()
    ]
    if name in OVER_TIME:
        return handles
    if name != "frames":
        handles.append(Line2D([], [], color=GREY, linewidth=1.0, label="front"))
    for megabytes in LEGEND_MEGABYTES:
        disc: dict[str, Any] = {"marker": "o", "markersize": math.sqrt(AREA_A_MEGABYTE * megabytes)}
        handles.append(Line2D([], [], color=FAINT, linestyle="none", label=f"{megabytes} MB", **disc))
    if name != "pareto-post" and any(map(_has_published, _places(groups))):
        hollow: dict[str, Any] = {"marker": "o", "markerfacecolor": "none"}
        handles.append(Line2D([], [], color=GREY, linestyle="none", label=LABEL, **hollow))
    return handles


def _has_published(place: Place) -> bool:
    """Whether published figures are drawn beside those of a place."""
    clip, holdout = place
    return clip in REAL_CLIPS and holdout == PAPERS_HOLDOUT


def _places(groups: Sequence[Group]) -> list[Place]:
    """Clips with their holdouts, clip by clip; a place without any row keeps its panel."""
    clips, holdouts = (list(dict.fromkeys(each)) for each in zip(*(group.place for group in groups), strict=True))
    return [(clip, holdout) for clip in clips for holdout in holdouts]


def _columns(places: Sequence[Place]) -> int:
    """The number of columns: one per holdout, two if there is only one holdout."""
    holdouts = len({holdout for _, holdout in places})
    return holdouts if holdouts > 1 else min(2, len(places))


def _leave_empty(axis: Any, place: Place) -> None:
    """The empty panel of a place without runs."""
    axis.set_axis_off()
    axis.text(0, 1.0, f"{', '.join(place)}: not measured", transform=axis.transAxes, fontsize=7, color=GREY, va="top")


def _name(axis: Any, place: Place, groups: Sequence[Group], missing: str) -> None:
    """Title, what is missing below it, and the axes that all charts share."""
    sizes = {(row["width"], row["height"]) for group in groups for row in group.rows if row["width"]}
    size = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
    axis.set_title(", ".join(filter(None, (*place, size))), pad=14)
    axis.text(0, 1.015, missing, transform=axis.transAxes, fontsize=7, color=GREY)
    axis.set_xscale("log")


def _finish(axis: Any) -> None:
    """Add margins for marks and labels, and use plain numbers on the logarithmic axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.margins(x=0.14, y=0.1)
    low, high = axis.get_xlim()
    axis.xaxis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5) if high < MAX_FINE_TICKS * low else (1,)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _cut_below(axes: Sequence[Any], ends_db: Sequence[float]) -> None:
    """Cut off the starts of curves, which lie far below all ends."""
    ends = [score for score in ends_db if not math.isnan(score)]
    for axis in axes:
        low, high = axis.get_ylim()
        if ends:
            axis.set_ylim(max(low, min(ends) - SHOWN_BELOW_WORST_DB), high)
