"""The part of docs/results/index.md, and of README.md, that `intrasplat evaluate` has the rows for.

Every sentence with a figure in it is made from rows; the others hold whatever the rows say.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mode

from benchmarks.pages.markdown import number, origin, table
from benchmarks.pages.post import post_claim
from benchmarks.pages.right_eye import RIGHT_EYE_CHARTS, both_eyes, right_eye_claim, two_eyes
from worker.evaluate.cells import GRID_BASES, GRID_POINTS, OURS, base_of, expected_beside
from worker.evaluate.charts import clip_alone
from worker.evaluate.published import ABLATION, RESULTS, Published
from worker.evaluate.rows import Results, Row
from worker.evaluate.summary import Capacity, Group, Sooner, capacities, groups_of, orderings, sooner

CAPACITY = "capacity"
"""The folder beside runs.csv that holds the grid of capacities."""
MARKS = ("<!-- evaluation -->", "<!-- /evaluation -->")
"""Everything between them in README.md is replaced."""
_ONE_MINUTE = (
    Published("LerPlane", "EndoNeRF", 22.75, 60, None),
    Published("EndoGaussian", "EndoNeRF", 35.81, 60, None),
    Published("Deform3DGS", "EndoNeRF", 37.90, 60, None),
)
"""Table 2 of the paper of published.py: about one minute of training each."""

_CHARTS = {
    "curves": """
### Quality over time

![Held-out psnr_tissue against seconds of training, one panel a clip and way of holding out](curves.png)

Each line is one run, the strong one the seed that ends in the middle; the clock counts what
[conventions](../conventions.md) call `t_train_s`, so neither compilation nor the scoring of held-out frames nor, after
the last step, storing (`finish_s` and `shrink_s` of the column `seconds`). Rates fall and rise in cycles, and so do the
curves of ours; each ends with the score of the stored scene. Dashed is what copying the neighbouring frames scores:
where a curve stays below, a copy is the better picture from the endoscope's own pose, and has no other pose, no depth
and nothing behind the instrument.

![Held-out SSIM against seconds of training](curves-ssim.png)

![Median depth error of held-out frames against seconds of training](curves-depth.png)

SSIM weighs structure, decibels every error alike. Depth is compared with what training was given for its own frames:
true depth on synthetic clips, stereo's on recorded ones, so that there it shows agreement and not truth.
""",
    "curves-post": """
![Held-out psnr_tissue against seconds since the request](curves-post.png)

The same curves by the clock of the user, `t_post_s`: it also counts decoding, stereo and compilation before training,
and the scoring of held-out frames in it. A point is the moment of its step; the stored scene follows some seconds
after the last one. Curves that were measured before points had this clock are not drawn.
""",
    "pareto": """
### Seconds against decibels

![Final psnr_tissue against seconds of training; discs are the scenes' sizes, hollow marks are published](pareto.png)

A mark is the median of all seeds, its disc the scene on disk, and the line joins what nothing is both sooner and better
than. `hexplane` has no kernels of its own here and moves its Gaussians in torch, so its seconds say more about that
than about the method. The hollow marks are what papers print for other clips on other hardware, in `psnr_paper`, which
is higher: they say where the field stands, and no distance from them to ours is a measurement.
""",
    "pareto-post": """
![Final psnr_tissue against seconds from the request to the scene](pareto-post.png)

By the clock of the user, `t_post_s`, the scene is there some seconds later: decoding, stereo, compilation and storing
come on top. Papers print no such seconds. {scored_first}
""",
    **RIGHT_EYE_CHARTS,
    "frames": """
### Images a second against decibels

![Final psnr_tissue against images rendered a second at the clip's size](frames.png)

Each image is deformed, projected and blended at its own time, the median of forty, with the machine's other work
beside it; encoding and sending come on top. `hexplane` is slow for the reason given above.
""",
}
_INTRODUCTION = """
## Speed against accuracy

`make evaluate` ([runs.csv](runs.csv), a row a run with its command, which looks for `d4d_endonerf` in the folder
`INTRASPLAT_DATA` names; [curves.csv](curves.csv); [summary.csv](summary.csv), medians over seeds). `intrasplat evaluate
--redraw --out docs/results` draws all charts anew from the rows, as PNG and SVG. {count}
"""
_TRUTH = """
### What copying cannot do

Synthetic clips know the truth ([truth.py](../../worker/evaluate/truth.py) defines each column). Views are 10 and 15
degrees off the endoscope's, judged where a training frame saw the tissue. Highlights lie elsewhere for every eye, and a
clip from one place cannot tell where: `bound` is what a perfect shape with the colours the endoscope sees would score,
`baked` is the score against exactly that. `hidden` is behind the instrument. `motion` is the median end-point error
over all tissue, `moving` that over what has moved by 1 mm or more, beside how far it has: a model that does not move at
all would score that.
"""
_ABLATION = """
### The paper's ablation, on our clips

Median psnr_tissue after each preset's own number of iterations; the first row is what the paper prints (`psnr_paper`,
its own clips). Differences of a tenth of a decibel are within what another seed gives.
"""
_PARSIMONY = """
### No more than a scene needs

Floats are those of the model for each Gaussian; bytes those of the scene on disk: ours in whole numbers
([why](../decisions/scenes.md)), the published method and its variants as floats, as published.
`loss` is what storing it costs on held-out frames against the model as training left it, in dB; `spread` is the best
seed less the worst. Sizes, seconds and loss are those with {holdout}. Rates, iterations and start differ between
presets as well, so a row is not the effect of its size alone: the grid of capacities varies nothing else.
"""
_CAPACITY = """
### The automatic choice against a grid of fixed ones

`make capacity` ([capacity/runs.csv](capacity/runs.csv)): {bases} bases x {points} points an image, everything
else equal, the same number of iterations.

![Held-out psnr_tissue against the scene's bytes for every fixed capacity, and the automatic choice](capacity/knee.png)

The star is the preset: its bases are chosen from training frames alone, its points are the most that fast ever takes;
each line adds Gaussians at a fixed number of bases. The best of the grid is picked by the very frames it is scored on,
so that it is flattered and the choice is not.
"""


def sections(folder: Path) -> list[str]:
    """Markdown of everything that has rows in folder; nothing without rows."""
    results = Results(folder)
    groups = [group for group in groups_of(results.runs) if group.series == base_of(group.series)]
    parts = []
    if any(group.rows for group in groups):
        parts += [_INTRODUCTION.format(count=_counted(results.runs)), _headline(sooner(results.curves))]
        said = {"scored_first": _scored_first(results.runs)}
        parts += [text.format(**said) for name, text in _CHARTS.items() if (folder / f"{name}.png").exists()]
        parts += [both_eyes(groups), _truth(groups), _ablation(groups), _parsimony(groups), _published()]
    grid = Results(folder / CAPACITY)
    if found := capacities(groups_of(grid.runs)):
        parts += [
            _CAPACITY.format(bases=_listed(GRID_BASES), points=_listed(GRID_POINTS)),
            _capacity(found),
            origin(grid.runs),
        ]
    return [*parts, origin(results.runs)] if results.runs else parts


def write_readme(readme: Path, folder: Path) -> None:
    """Put the chart and the headline between the marks; without rows the README stays as it is."""
    results = Results(folder)
    found, chart = sooner(results.curves), folder / "pareto-one-clip.png"
    text = readme.read_text()
    if not found or not chart.exists() or any(mark not in text for mark in MARKS):
        return
    place = chart.relative_to(readme.parent)
    picture = f"![Seconds of training, and since the request, against held-out decibels, for every preset]({place})"
    clip = clip_alone(groups_of(results.runs))
    caption = (
        f"*Held-out frames of `{clip}`, medians over seeds, by both clocks: `t_train_s` and, since the request, "
        "`t_post_s`. Discs show the scene's size on disk; the line joins the best trade-offs; dashed and dotted lines "
        "are copies of the neighbouring frames; hollow marks are published, on other hardware and data. "
        "[docs/conventions.md](docs/conventions.md) defines clocks, every8, blocks8 and psnr_tissue.*"
    )
    usual = [each for each in found if each.our_limit == _usual_limit(found, each.holdout)]
    page = f"[All charts and figures]({folder.relative_to(readme.parent)}/index.md)"
    before, rest = text.split(MARKS[0])
    after = rest.split(MARKS[1])[1]
    claims = filter(None, (_claim(usual), right_eye_claim(two_eyes(folder) or groups_of(results.runs)), f"{page}."))
    parts = (MARKS[0], picture, caption, post_claim(folder), " ".join(claims), MARKS[1])
    body = "\n\n".join(filter(None, parts))
    readme.write_text(f"{before}{body}{after}")


_METHOD = (
    "Medians over the seeds that were run (one seed of a published method), on one kind of machine and this program's "
    "kernels, at the commits named below the last table of this part. The moment is that of the first crossing: a "
    "curve may fall below the score again before its end, and one that over-fits, as `paper` does where many frames "
    "are held out in a row, passes its last score long before. Between two samples of a curve the moment is "
    "interpolated, the logarithm of time being linear in dB, and a curve that is there at its first sample counts "
    "from that one: it was sooner. Samples are scored on at most sixteen of the held-out frames, ends on all."
)


def _usual_limit(found: Sequence[Sooner], holdout: str) -> str:
    """The limit that most clips were given with this holdout."""
    return mode(each.our_limit for each in found if each.holdout == holdout)


def _claim(found: Sequence[Sooner]) -> str:
    """The headline for each way of holding out, for runs of the limit that most clips were given."""
    sentences = []
    for holdout in dict.fromkeys(each.holdout for each in found):
        usual = _usual_limit(found, holdout)
        here = [each for each in found if (each.holdout, each.our_limit) == (holdout, usual)]
        reached = [each for each in here if each.our_s]
        said = f"With {holdout}, `fast` reaches the score that `paper` ends with on {len(reached)} of {len(here)} clips"
        if reached:
            seconds = _span(each.times_in_seconds or math.nan for each in reached)
            first = _span(each.times_from_their_first or math.nan for each in reached)
            iterations = _span(each.times_in_iterations or math.nan for each in reached)
            said += (
                f": {seconds} times sooner than `paper` ends, {first} times sooner than `paper` first reaches "
                f"it, and in {iterations} times fewer iterations"
            )
        others = [
            f"`{each.clip}` {each.times_in_seconds:.1f} times sooner when given {each.our_limit} instead of {usual}"
            for each in found
            if each.holdout == holdout and each.our_limit != usual and each.times_in_seconds
        ]
        said += f"; {', '.join(others)}" if others else ""
        sentences.append(f"{said}.")
    return " ".join(sentences)


def _headline(found: Sequence[Sooner]) -> str:
    header = ["clip", "held out", "dB that paper ends with", "paper, s", "iterations", "paper first there, s",
              "fast given", "fast, s", "iterations", "times sooner, s", "than paper first", "iterations"]  # fmt: skip
    rows = [
        [each.clip, each.holdout, f"{each.target_db:.2f}", f"{each.their_s:.0f}", f"{each.their_iterations:.0f}",
         f"{each.their_first_s:.1f}", each.our_limit, number(each.our_s, 1), number(each.our_iterations, 0),
         number(each.times_in_seconds, 1), number(each.times_from_their_first, 1),
         number(each.times_in_iterations, 1)]
        for each in found
    ]  # fmt: skip
    if not rows:
        return ""
    return f"\n### How much sooner\n\n{_claim(found)} {_METHOD}\n{table(header, rows)}"


def _truth(groups: Sequence[Group]) -> str:
    names = {"psnr_view10_db": 1, "bound10_db": 1, "psnr_baked10_db": 1, "psnr_view15_db": 1, "bound15_db": 1,
             "psnr_baked15_db": 1, "psnr_hidden_db": 1, "depth_error_mm": 2, "motion_error_mm": 2,
             "moving_error_mm": 2, "moving_mm": 2}  # fmt: skip
    known = [group for group in groups if not math.isnan(group.median("psnr_view10_db"))]
    header = ["clip", "held out", "series", "limit", "10°, dB", "bound", "baked", "15°, dB", "bound", "baked",
              "hidden, dB", "depth, mm", "motion, mm", "moving, mm", "moved by, mm"]  # fmt: skip
    rows = [
        [
            *group.place,
            group.series,
            group.limit,
            *(number(group.median(name), digits) for name, digits in names.items()),
        ]
        for group in known
    ]
    return f"{_TRUTH}{table(header, rows)}\n{_hidden(known)}\n" if rows else ""


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
        f"Clips where all four were run: {len(decided)}. Of them confirm the paper's whole order: {confirmed}; have "
        f"FDM with MAPF first, as the paper has: {first}."
    )
    return f"{_ABLATION}\n{said}\n{table(['clip', 'held out', *ABLATION, 'the order'], rows)}"


def _parsimony(groups: Sequence[Group]) -> str:
    """A row a clip, series and limit; sizes and seconds are those of the first way of holding out."""
    clips, holdouts = (list(dict.fromkeys(each)) for each in zip(*(group.place for group in groups), strict=True))
    found = {(group.clip, group.series, group.limit, group.holdout): group for group in groups}
    rows, not_run = [], []
    for clip in clips:
        keys = dict.fromkeys(key[:3] for key in found if key[0] == clip)
        for key in keys:
            here = [found.get((*key, holdout)) for holdout in holdouts]
            rows.append([*key, *_size(next(each for each in here if each)), *map(_score, here)])
        there = {key[1] for key in keys}
        absent = [series for series in expected_beside(there) if series not in there]
        not_run += [f"{clip}: {', '.join(absent)}"] if absent else []
    header = ["clip", "series", "limit", *_SIZES, *(f"{holdout}, dB" for holdout in holdouts)]
    said = f"\nNot run. {'; '.join(not_run)}.\n" if not_run else ""
    return _PARSIMONY.format(holdout=f"`{holdouts[0]}`") + table(header, rows) + said


_SIZES = ("Gaussians", "bases", "floats", "MB", "loss", "t_train_s", "step, ms", "images/s", "seeds")


def _size(group: Group) -> list[str]:
    return [
        *(number(group.median(name), 0) for name in ("gaussians", "bases", "floats_a_gaussian")),
        number(group.median("scene_bytes") / 1e6, 2),
        number(group.median("stored_loss_held_out_db"), 3),
        *(number(group.median(name), 1) for name in ("t_train_s", "step_ms")),
        number(group.median("render_fps"), 0),
        str(len(group.rows)),
    ]


def _score(group: Group | None) -> str:
    """`38.07 (spread 0.11; training frames +0.92)`; or why there is none."""
    if group is None:
        return "–"
    if not group.rows:
        return f"failed: {group.errors[0]}"
    found, trained = group.median("psnr_tissue_db"), group.median("train_psnr_tissue_db")
    spread = f"spread {group.summary()['spread_db']}" if len(group.rows) > 1 else ""
    gap = "" if math.isnan(trained) else f"training frames {trained - found:+.2f}"
    said = "; ".join(filter(None, (spread, gap)))
    return f"{number(found, 2)} ({said})" if said else number(found, 2)


def _published() -> str:
    def cells(rows: Iterable[Published], table: str) -> list[list[str]]:
        return [
            [table, each.data, each.method, f"{each.psnr_paper_db:.2f}", f"{each.train_s:.0f}", number(each.fps, 2)]
            for each in rows
        ]

    said = (
        "\n### Published figures\n\nYang et al., Deform3DGS, MICCAI 2024, one NVIDIA RTX A5000: other hardware, other "
        "data, `psnr_paper`. Nothing here was measured by us.\n"
    )
    rows = cells(RESULTS, "1") + cells(_ONE_MINUTE, "2: about a minute each")
    return said + table(["table", "data", "method", "psnr_paper", "training, s", "images/s"], rows)


def _capacity(found: Sequence[Capacity]) -> str:
    header = ["clip", "held out", "preset", "limit", "chosen, dB", "best of the grid", "its dB", "difference",
              "deviation", "seeds", "chosen, MB", "best, MB", "difference from the best at no more bytes"]  # fmt: skip
    rows = [
        [*each.chosen.place, each.chosen.series, each.chosen.limit, number(each.chosen.median("psnr_tissue_db"), 2),
         each.best.series.partition(":")[2], number(each.best.median("psnr_tissue_db"), 2),
         f"{each.difference_db:+.2f}", number(each.deviation_db, 2), str(each.seeds),
         number(each.chosen.median("scene_bytes") / 1e6, 2), number(each.best.median("scene_bytes") / 1e6, 2),
         "none so small" if math.isnan(each.at_bytes_db) else f"{each.at_bytes_db:+.2f}"]
        for each in found
    ]  # fmt: skip
    within = [each for each in found if each.difference_db >= -0.1]
    smaller = sum(each.chosen.median("scene_bytes") <= each.best.median("scene_bytes") for each in within)
    at_bytes = sum(each.at_bytes_db >= -0.1 for each in found)
    said = (
        f"\nWithin 0.1 dB of the best or above it: {len(within)} of {len(found)}, of them {smaller} at no more bytes. "
        f"Within 0.1 dB of the best that takes no more bytes than the choice, or above it: {at_bytes} of {len(found)}; "
        "where that difference is +0.00 the choice is itself a point of the grid, and none with fewer bytes is better. "
        "The dB are medians; a difference is the mean, and a deviation the standard deviation, of the differences seed "
        "by seed."
    )
    return f"{said}\n{table(header, rows)}"


def _counted(runs: Sequence[Row]) -> str:
    failed = sum(bool(row["error"]) for row in runs)
    presets = {row["series"] for row in runs}
    ours = ", ".join(f"`{name}`" for name in OURS if name in presets)
    return (
        f"{len(runs)} runs, {failed} of them failed; ours are {ours}, all others the published method and its variants."
    )


def _scored_first(runs: Sequence[Row]) -> str:
    """How many of the runs are from when a scene was scored before it was published; their reports lack a clock."""
    ended = [json.loads(row["seconds"]) for row in runs if row["t_post_s"] and row["seconds"]]
    earlier = sum("t_first_view_s" not in seconds for seconds in ended)
    what = "were measured when a scene was scored before it was published: there `t_post_s` contains `score_s`"
    return f"{earlier} of {len(ended)} runs {what}." if earlier else ""


def _listed(values: Sequence[int]) -> str:
    return f"{', '.join(map(str, values[:-1]))} or {values[-1]}"


def _span(values: Iterable[float]) -> str:
    found = sorted(values)
    return f"{found[0]:.1f}" if len(found) == 1 else f"{found[0]:.1f} to {found[-1]:.1f}"
