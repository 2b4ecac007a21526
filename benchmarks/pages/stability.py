"""The part of docs/results/index.md that `intrasplat stability` has the rows for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from benchmarks.pages.markdown import number
from worker.evaluate.atlas import WORST_FIRST, count_outcomes, map_name, places_of, series_in
from worker.evaluate.conditions import CLEAN, CONDITIONS, SEVERITIES
from worker.evaluate.rows import Row, read_rows
from worker.evaluate.stability import MAX_DEPTH_LOSS_MM, MAX_LOSS_DB, STABILITY

_COMPARED = (3, 5)
"""The severities at which methods are compared."""
_PLACES = len(CONDITIONS) * len(_COMPARED)
_INTRODUCTION = f"""
## Where methods break, and whether they say so

`intrasplat stability --out docs/results` ([{STABILITY}]({STABILITY})) spoils a synthetic clip in {len(CONDITIONS)}
ways, {len(SEVERITIES)} severities each, reconstructs it and judges it by the truth. Harmed is what loses more than
{MAX_LOSS_DB:g} dB to the clean clip, or {MAX_DEPTH_LOSS_MM:g} mm of depth. Silent is the defect: harmed, and
the report has no warning that the clean clip's has not. What the user is told of each stands in
[stability.md](stability.md), how it is judged in [evaluation.md](../decisions/evaluation.md). Each method is compared
with itself on the clean clip (a pull and a cut with the same motion, calm), so a map shows what a mishap costs a method
and not which method is better: one that has hardly learnt loses little. The table counts severities
{" and ".join(map(str, _COMPARED))}, beside the score on the clean clip. The report of a method from another paper has
the checks of the clip that ours have: they are this program's, not its authors'.

| | clean, dB | measured | {" | ".join(WORST_FIRST)} | map |
|---|---|---|{"---|" * len(WORST_FIRST)}---|
"""
_MAP = """
![Decibels lost of each condition at five severities, marked where the user was told and where not](stability-fast.png)
"""
_WHY_SILENT = {
    ("wrong_baseline",): """
**Why a wrong baseline is silent.** Depth is focal length times baseline over disparity: a wrong baseline scales every
distance, and the tissue's motion with it, and changes no pixel of either eye. The rows of the eyes match as well, the
scene renders as well, so no check of one stereo pair's pictures can find it; only a length known beforehand could,
such as an instrument's width, and none is asked for. Every report on stereo names the baseline it took among its
assumptions, right or wrong alike, so that does not count as told here: compare it with your endoscope's.
""",
    ("fast_pull", "cutting"): """
**Why fast pulls and cuts are silent.** Much of what they lose lies behind the instrument, which moves as the tissue
does and hides a few hundredths of the judged picture while the tissue there goes on unseen; a calm clip's instrument
rests, and what it hides throughout is not judged. No score of training or of held-out frames looks there: none has a
picture of it. What the frames do show loses 1 to 4 dB beside the calm clip and stays near what a clip that breathes
comes to, and the speed of visible tissue is no sign either: good clips, the real one among them, move as fast.
A warning wherever an instrument hides tissue that
moves would stand in every report. It is told by the pixel instead: in a render, `confidence` falls where tissue was
hidden for part of the clip. What is shown behind an instrument is a guess.
""",
}
"""By the conditions, why nothing is said; shown where one of them is silent."""


def stability_sections(results: Path) -> list[str]:
    """Markdown; none where there are no rows."""
    rows = read_rows(results / STABILITY)
    if not rows:
        return []
    lines, silent = [], set()
    for series in series_in(rows):
        places = places_of(rows, series)
        counted = count_outcomes({key: place for key, place in places.items() if key[1] in _COMPARED})
        silent |= {condition for (condition, _), place in places.items() if place.outcome == "silent"}
        measured = f"{sum(counted.values())} of {_PLACES}"
        counts = " | ".join(str(counted.get(outcome, 0)) for outcome in WORST_FIRST)
        name = f"{map_name(series)}.png"
        shown = f"[{name}]({name})" if (results / name).exists() else ""
        lines.append(f"| {series} | {_clean_db(rows, series)} | {measured} | {counts} | {shown} |\n")
    drawn = [_MAP] if (results / "stability-fast.png").exists() else []
    return [_INTRODUCTION, *lines, *drawn, *(why for names, why in _WHY_SILENT.items() if silent & {*names})]


def _clean_db(rows: Sequence[Row], series: str) -> str:
    """The mean of all seeds on the clean clip."""
    found = [row["psnr_db"] for row in rows if (row["series"], row["condition"]) == (series, CLEAN)]
    return number(fmean(map(float, found)) if found and all(found) else None, 1)
