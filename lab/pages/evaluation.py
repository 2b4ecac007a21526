"""The part of docs/results/index.md, and of README.md, from the rows of `python -m lab evaluate`.

Every sentence with a figure is generated from rows; the other sentences do not depend on them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mode

from lab.evaluate.cells import GRID_BASES, GRID_POINTS, OURS, PUBLISHED, base_of, expected_beside
from lab.evaluate.charts import clip_alone
from lab.evaluate.command import SUMMARY
from lab.evaluate.published import ABLATION
from lab.evaluate.rows import CURVES, RUNS, Results, Row
from lab.evaluate.summary import Capacity, Group, Sooner, capacities, groups_of, orderings, sooner
from lab.pages.markdown import number, origin, source, table
from lab.pages.post import post_table

CAPACITY = "capacity"
"""The folder beside runs.csv that holds the grid of capacities."""
COPIED = ("copy_blend_db", "copy_flow_db")
"""The columns of what copying the neighbouring frames scores."""
MARKS = ("<!-- evaluation -->", "<!-- /evaluation -->")
"""Everything between them in README.md is replaced."""
_CHARTS = {
    "curves": """
### Quality over time

One line is one run, the strong one the seed that ends in the middle; dashed is what copying the neighbouring frames
scores. A copy has no other pose, no depth and nothing behind the instrument.

![Held-out psnr_tissue against seconds of training, one panel a clip and way of holding out](curves.png)
""",
    "pareto": """
### Seconds against decibels

Medians over seeds, discs are scenes on disk, and the line joins what nothing is both sooner and better than. Hollow
marks are published, for other clips on other hardware in `psnr_paper`, so no distance from them is a measurement.

![Final psnr_tissue against seconds of training](pareto.png)
""",
    "frames": """
### Images a second against decibels

Each image is rendered at its own time, the median of forty; encoding and sending come on top. `hexplane` has no kernels
of its own and moves its Gaussians in torch.

![Final psnr_tissue against images rendered a second at the clip's size](frames.png)
""",
}
_INTRODUCTION = """
## Speed against accuracy

Every preset on every clip: {count}
"""
_SOONER = """
### How much sooner

`fast` against the score that `paper` ends with, medians over seeds, of the first moment at which a curve reaches it
([how](../decisions/evaluation.md#claims-come-from-rows-and-motion-is-judged-where-the-picture-is-made)).
{claim}
"""
_TRUTH = """
### What copying cannot do

Synthetic clips know the truth ([truth.py](../../lab/evaluate/truth.py) defines each column): a view 10 degrees beside
the endoscope, with the `bound` that its highlights set; the tissue behind the instrument; depth; and the error of
points that moved by 1 mm or more, beside how far they moved. Held out: {holdout}. {hidden}
"""
_ABLATION = """
### The paper's ablation, on our clips

psnr_tissue after each variant's own number of iterations; the first row is published (`psnr_paper`, other clips).
{count}
"""
_PARSIMONY = """
### Every preset on every clip

Medians over seeds; sizes and seconds are those with {holdout}. MB is the scene on disk: ours in whole numbers, the
published method as floats ([why](../decisions/scenes.md)).
"""
_CAPACITY = """
### The automatic choice against a grid of fixed ones

{bases} bases x {points} points an image with equal iterations; the star in the chart is the preset's choice. The best
of the grid is chosen on the frames that score it, which flatters it. {within}

![Held-out psnr_tissue against the scene's bytes for every fixed capacity, and the automatic choice](capacity/knee.png)
"""
_COMPARED = ("fast", "paper")
"""The series of the table of truth."""


def sections(folder: Path, pictures: Path) -> list[str]:
    """Markdown of everything that has rows in `folder`, with the charts in `pictures`; nothing without rows."""
    results = Results(folder)
    groups = [group for group in groups_of(results.runs) if group.series == base_of(group.series)]
    parts = []
    if any(group.rows for group in groups):
        parts += [_INTRODUCTION.format(count=_counted(results.runs)), source("make evaluate", RUNS, CURVES, SUMMARY)]
        parts += [_headline(sooner(results.curves)), _presets(groups)]
        parts += [text for name, text in _CHARTS.items() if (pictures / f"{name}.png").exists()]
        parts += [_truth(groups), _ablation(groups), origin(results.runs)]
    grid = Results(folder / CAPACITY)
    if found := capacities(groups_of(grid.runs)):
        parts += [_capacity(found), origin(grid.runs)]
    return parts


def write_readme(readme: Path, folder: Path, pictures: Path) -> None:
    """Put one chart and two small tables between the marks; without rows or chart the README stays as it is."""
    results, chart = Results(folder), pictures / "pareto-one-clip.png"
    text = readme.read_text()
    if not results.runs or not chart.exists() or any(mark not in text for mark in MARKS):
        return
    groups = groups_of(results.runs)
    page = (pictures / "index.md").relative_to(readme.parent)
    picture = f"![Seconds against held-out decibels, for every preset]({chart.relative_to(readme.parent)})"
    scores = (
        f"Held-out psnr_tissue of `{clip_alone(groups)}`, a real da Vinci clip, on two cores ([all results]({page})):"
    )
    waiting = post_table(folder)
    parts = [picture, f"{scores}\n{_scores(groups)}"]
    if waiting:
        parts.append(f"Seconds since the POST of the same clip as raw stereo to a warm worker:\n{waiting}")
    before, rest = text.split(MARKS[0])
    after = rest.split(MARKS[1])[1]
    body = "\n\n".join([MARKS[0], *(part.rstrip("\n") for part in parts), MARKS[1]])
    readme.write_text(f"{before}{body}{after}")


def _scores(groups: Sequence[Group]) -> str:
    """For README: each preset's score of the one clip for each way of holding out, and that of copying."""
    here = [group for group in groups if group.clip == clip_alone(groups) and group.rows]
    holdouts = list(dict.fromkeys(group.holdout for group in here))
    rows = []
    for series in (*OURS, PUBLISHED):
        usual = [group for group in here if (group.series, group.limit) == (series, _longest_limit(here, series))]
        if usual:
            scores = {group.holdout: group.median("psnr_tissue_db") for group in usual}
            seconds = number(usual[0].median("t_train_s"), 0)
            rows.append([series, seconds, *(number(scores.get(holdout), 1) for holdout in holdouts)])
    copies = []
    for holdout in holdouts:
        known = [group.median(name) for group in here if group.holdout == holdout for name in COPIED]
        copies.append(number(max((each for each in known if not math.isnan(each)), default=None), 1))
    rows.append(["copying", "–", *copies])
    return table(["preset", "training, s", *(f"{holdout}, dB" for holdout in holdouts)], rows)


def _longest_limit(groups: Sequence[Group], series: str) -> str:
    """The limit of the series' longest runs."""
    found = [group for group in groups if group.series == series]
    timed = [group for group in found if group.rows]
    return max(timed, key=lambda group: group.median("t_train_s")).limit if timed else found[0].limit if found else ""


def _usual_limit(found: Sequence[Sooner], holdout: str) -> str:
    """The limit that most clips were given with this holdout."""
    return mode(each.our_limit for each in found if each.holdout == holdout)


def _claim(found: Sequence[Sooner]) -> str:
    """A sentence for each way of holding out, on the runs of the limit that most clips were given."""
    sentences = []
    for holdout in dict.fromkeys(each.holdout for each in found):
        usual = _usual_limit(found, holdout)
        here = [each for each in found if (each.holdout, each.our_limit) == (holdout, usual)]
        reached = [each for each in here if each.our_s]
        said = f"With {holdout}, `fast` reaches the score that `paper` ends with on {len(reached)} of {len(here)} clips"
        if reached:
            seconds = _span(each.times_in_seconds or math.nan for each in reached)
            iterations = _span(each.times_in_iterations or math.nan for each in reached)
            first = _span(each.times_from_their_first or math.nan for each in reached)
            said += (
                f": {seconds} times sooner than `paper` ends, {first} times sooner than `paper` first reaches it, and "
                f"in {iterations} times fewer iterations"
            )
        sentences.append(f"{said}.")
    return " ".join(sentences)


def _headline(found: Sequence[Sooner]) -> str:
    header = ["clip", "held out", "paper, dB", "paper, s", "fast, s", "iterations", "times sooner", "than paper first"]
    rows = [
        [each.clip, each.holdout, f"{each.target_db:.2f}", f"{each.their_s:.0f}", number(each.our_s, 1),
         number(each.our_iterations, 0), number(each.times_in_seconds, 1),
         number(each.times_from_their_first, 1)]
        for each in found if each.our_limit == _usual_limit(found, each.holdout)
    ]  # fmt: skip
    return _SOONER.format(claim=_claim(found)) + table(header, rows) if rows else ""


def _truth(groups: Sequence[Group]) -> str:
    """A row a clip and series of _COMPARED, for the first way of holding out."""
    names = {"psnr_view10_db": 1, "bound10_db": 1, "psnr_hidden_db": 1, "depth_error_mm": 2, "moving_error_mm": 2,
             "moving_mm": 2}  # fmt: skip
    known = [group for group in groups if not math.isnan(group.median("psnr_view10_db")) and group.series in _COMPARED]
    if not known:
        return ""
    holdout = known[0].holdout
    header = ["clip", "series", "10°, dB", "bound", "hidden, dB", "depth, mm", "moving, mm", "moved by, mm"]
    rows = [
        [group.clip, group.series, *(number(group.median(name), digits) for name, digits in names.items())]
        for group in sorted(known, key=lambda group: (group.clip, _COMPARED.index(group.series)))
        if group.holdout == holdout
    ]
    return _TRUTH.format(holdout=holdout, hidden=_hidden(known)) + table(header, rows)


def _hidden(groups: Sequence[Group]) -> str:
    """Where the paper's preset shows more of what the instrument hides than the default does."""
    score = {(group.place, group.series): group.median("psnr_hidden_db") for group in groups}
    both = [place for place in dict.fromkeys(group.place for group in groups)
            if {(place, "fast"), (place, "paper")} <= set(score)]  # fmt: skip
    worse = [
        f"{', '.join(place)} ({score[place, 'fast']:.1f} dB, `paper` {score[place, 'paper']:.1f})"
        for place in both
        if score[place, "fast"] < score[place, "paper"]
    ]
    said = f"`fast` is worse than `paper` behind the instrument in {len(worse)} of {len(both)} such pairs"
    return f"{said}{': ' if worse else ''}{'; '.join(worse)}. What is shown there is a guess in either."


def _ablation(groups: Sequence[Group]) -> str:
    found = orderings(groups)
    rows = [["*published*", "EndoNeRF", *(f"*{score:.2f}*" for score in ABLATION.values()), ""]]
    for each in found:
        scores = [number(each.scores_db.get(name, math.nan), 2) for name in ABLATION]
        rows.append([*each.place, *scores, each.verdict])
    if not found:
        return ""
    decided = [each for each in found if not each.missing]
    confirmed = sum(each.agreeing == each.pairs for each in decided)
    first = sum(next(iter(each.scores_db)) == "paper" for each in decided)
    said = (
        f"The paper's whole order holds on {confirmed} of {len(decided)} clips; FDM with MAPF is first, as in the "
        f"paper, on {first}."
    )
    return _ABLATION.format(count=said) + table(["clip", "held out", *ABLATION, "the order"], rows)


def _presets(groups: Sequence[Group]) -> str:
    """A row a clip and preset, of its longest runs; sizes and seconds are those of the first way of holding out."""
    usual = [group for group in groups if group.limit == _longest_limit(groups, group.series)]
    shown = [group for group in usual if group.series.partition(":")[0] in (*OURS, PUBLISHED) or group.errors]
    clips, holdouts = (list(dict.fromkeys(each)) for each in zip(*(group.place for group in groups), strict=True))
    found = {(group.clip, group.series, group.holdout): group for group in shown}
    rows, not_run = [], []
    for clip in clips:
        for key in dict.fromkeys(key[:2] for key in found if key[0] == clip):
            here = [found.get((*key, holdout)) for holdout in holdouts]
            rows.append([*key, *_size(next(each for each in here if each)), *map(_score, here)])
        there = {group.series for group in groups if group.clip == clip}
        absent = [series for series in expected_beside(there) if series not in there]
        not_run += [f"{clip}: {', '.join(absent)}"] if absent else []
    header = ["clip", "series", *_SIZES, *(f"{holdout}, dB" for holdout in holdouts)]
    said = f"\nNot run. {'; '.join(not_run)}.\n" if not_run else ""
    return _PARSIMONY.format(holdout=f"`{holdouts[0]}`") + table(header, rows) + said


_SIZES = ("Gaussians", "MB", "t_train_s", "images/s")


def _size(group: Group) -> list[str]:
    return [
        number(group.median("gaussians"), 0),
        number(group.median("scene_bytes") / 1e6, 2),
        number(group.median("t_train_s"), 1),
        number(group.median("render_fps"), 0),
    ]


def _score(group: Group | None) -> str:
    """`38.07`; or why there is none."""
    if group is None:
        return "–"
    return number(group.median("psnr_tissue_db"), 2) if group.rows else f"failed: {group.errors[0]}"


def _capacity(found: Sequence[Capacity]) -> str:
    header = ["clip", "held out", "chosen, dB", "best of the grid", "its dB", "difference", "chosen, MB", "best, MB",
              "difference from the best at no more bytes"]  # fmt: skip
    rows = [
        [*each.chosen.place, number(each.chosen.median("psnr_tissue_db"), 2),
         each.best.series.partition(":")[2].replace(",", ", "), number(each.best.median("psnr_tissue_db"), 2),
         f"{each.difference_db:+.2f}", number(each.chosen.median("scene_bytes") / 1e6, 2),
         number(each.best.median("scene_bytes") / 1e6, 2),
         "none so small" if math.isnan(each.at_bytes_db) else f"{each.at_bytes_db:+.2f}"]
        for each in found
    ]  # fmt: skip
    best = sum(each.difference_db >= -0.1 for each in found)
    at_bytes = sum(each.at_bytes_db >= -0.1 for each in found)
    within = (
        f"Within 0.1 dB of the best or above it: {best} of {len(found)}; of the best that takes no more bytes: "
        f"{at_bytes} of {len(found)}."
    )
    said = _CAPACITY.format(bases=_listed(GRID_BASES), points=_listed(GRID_POINTS), within=within)
    return said + source("make capacity", f"{CAPACITY}/{RUNS}") + table(header, rows)


def _counted(runs: Sequence[Row]) -> str:
    failed = sum(bool(row["error"]) for row in runs)
    presets = {row["series"] for row in runs}
    ours = ", ".join(f"`{name}`" for name in OURS if name in presets)
    return (
        f"{len(runs)} runs, {failed} of them failed; ours are {ours}, all others the published method and its variants."
    )


def _listed(values: Sequence[int]) -> str:
    return f"{', '.join(map(str, values[:-1]))} or {values[-1]}"


def _span(values: Iterable[float]) -> str:
    found = sorted(values)
    return f"{found[0]:.1f}" if len(found) == 1 else f"{found[0]:.1f} to {found[-1]:.1f}"
