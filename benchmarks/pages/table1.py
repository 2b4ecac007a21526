"""The part of docs/results/index.md on the four systems of the paper's table 1: the rows of `make table1`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

from benchmarks.pages.markdown import number, origin, table
from worker.evaluate.published import RESULTS, Published
from worker.evaluate.rivals import RIVAL_SYSTEMS
from worker.evaluate.rows import Results
from worker.evaluate.summary import Group, Place, groups_of

TABLE_1 = "table1"
"""The folder beside runs.csv that holds the rows, and their charts."""
SYSTEMS = {"paper": "Deform3DGS", "endogaussian": "EndoGaussian", "lerplane": "LerPlane", "endonerf": "EndoNeRF"}
"""By series: what the paper calls it. In the paper's order: each has more dB and more images a second than the next."""
_INTRODUCTION = """
## The paper's table 1 under one clock

`make table1` ([table1/runs.csv](table1/runs.csv), [curves.csv](table1/curves.csv)): EndoNeRF, LerPlane and EndoGaussian
written anew from descriptions of their methods, beside Deform3DGS (`paper`) and `fast`, on the same frames, by the same
scores and clock. [rivals.md](../rivals.md) lists what had to differ and why,
and [what the rows show](../rivals.md#what-the-rows-show) of the paper's order. `d4d-a-320x256` is
`d4d-a` at half its size. Hollow marks are published.

![Held-out psnr_tissue against seconds of training, for each system](table1/curves.png)

![Final psnr_tissue against seconds of training](table1/pareto.png)

![Final psnr_tissue against images rendered a second](table1/frames.png)

`dB` is psnr_tissue of held-out frames, `s` the seconds of training; dashed lines in the charts are what copying the
neighbouring frames scores. `limit` is the most that a run may take: `fast` stops when it gains no more, and a rival at
its published iterations. `10°` is the score of a camera moved 10 degrees about the tissue, `bound` what colours that do
not depend on the viewpoint can reach there, `hidden` the score behind the instrument; `moving` is the motion error of
points that have moved, `moved by` how far ([worker/evaluate/truth.py](../../worker/evaluate/truth.py)). On a processor
EndoNeRF and LerPlane are scored at every 5th pixel of every 5th row, so that their bound differs. On any device they
draw nothing nearer or farther than the training frames' depths and 5 % of their range. `MB` is what is stored of a
scene; of a rival four bytes for each number that it learns, although EndoNeRF also needs the training frames' depth to
render. At most 45 whole pictures are rendered, fewer if 30 s pass first; images a second are the median without the
first five, or of five or fewer the last one's. EndoNeRF draws its samples about the measured depth of the training
frames nearest in time, which is exact on phantoms: its depth error is mostly the motion between frames. A dash: SSIM
needs neighbouring pixels, which a lattice does not have; `d4d-a` has no ground truth; nothing moves on `phantom:still`;
LerPlane and EndoNeRF do not tell where a point goes.
"""
_ORDERS = """
The paper's table has each system ahead of the next in dB and in images a second:
{systems}.
The first three columns subtract the next system's `psnr_paper`, the paper's own score, after the longest run of each;
two rivals are compared after the longest limit that both have had. The last three divide images a second. A difference
below 0, or a quotient below 1, contradicts the paper's order, but with one seed some tenths of a dB tell nothing. `*`:
the two ran on different machines, one of which renders more images a second, and makes more steps in a limit of time.
"""
_COLUMNS = {
    "t_train_s": ("s", 0), "psnr_tissue_db": ("dB", 1), "ssim": ("SSIM", 3), "iterations": ("steps", 0),
    "render_fps": ("images/s", 2), "psnr_view10_db": ("10°, dB", 1), "bound10_db": ("bound", 1),
    "psnr_hidden_db": ("hidden, dB", 1), "depth_error_mm": ("depth, mm", 2),
    "moving_error_mm": ("moving, mm", 2), "moving_mm": ("moved by, mm", 2),
}  # fmt: skip
"""By column of runs.csv: its name and digits."""
_Pair = tuple[Published | Group | None, Published | Group | None]


def table1_sections(folder: Path) -> list[str]:
    """The section; nothing without rows."""
    results = Results(folder / TABLE_1)
    groups = [group for group in groups_of(results.runs) if group.rows]
    if not groups:
        return []
    places = list(dict.fromkeys(group.place for group in groups))
    rows = [_row(group) for place in places for group in _in_order(groups, place)]
    header = ["clip", "held out", "series", "limit", *(name for name, _ in _COLUMNS.values()), "MB"]
    return [_INTRODUCTION, table(header, rows), *_orders(groups, places), origin(results.runs)]


def _row(group: Group) -> list[str]:
    figures = [number(group.median(name), digits) for name, (_, digits) in _COLUMNS.items()]
    return [*group.place, group.series, group.limit, *figures, number(group.median("scene_bytes") / 1e6, 1)]


def _in_order(groups: Sequence[Group], place: Place) -> list[Group]:
    """The groups of a place, system by system, short runs first."""
    order = ["fast", *SYSTEMS]
    here = [group for group in groups if group.place == place and group.series in order]
    return sorted(here, key=lambda group: (order.index(group.series), group.median("t_train_s")))


def _orders(groups: Sequence[Group], places: Sequence[Place]) -> list[str]:
    """Each system beside the next; nothing where no two ran at one place."""
    pairs = list(itertools.pairwise(SYSTEMS))
    measured, comparable = [], False
    for place in places:
        here = _in_order(groups, place)
        in_db = [_longest(here, a, b) for a, b in pairs]
        in_images = [(_last(here, a), _last(here, b)) for a, b in pairs]
        comparable |= any(None not in pair for pair in in_images)
        measured.append([*place, *_compared(in_db, in_images)])
    if not comparable:
        return []
    published = []
    for data in dict.fromkeys(each.data for each in RESULTS):
        methods = {each.method: each for each in RESULTS if each.data == data}
        known = [(methods[SYSTEMS[a]], methods[SYSTEMS[b]]) for a, b in pairs]
        published.append([f"published, {data} data", "", *_compared(known, known)])
    header = ["clip", "held out", *(f"{a} – {b}, dB" for a, b in pairs), *(f"{a} / {b}, images" for a, b in pairs)]
    return [_ORDERS.format(systems=", ".join(SYSTEMS.values())), table(header, published + measured)]


def _longest(here: Sequence[Group], a: str, b: str) -> tuple[Group | None, Group | None]:
    """The longest runs of two systems at a place; of two rivals the longest of a length that both have had."""
    if a in RIVAL_SYSTEMS and b in RIVAL_SYSTEMS:
        limits_b = {group.limit for group in here if group.series == b}
        both = [group for group in here if group.series == a and group.limit in limits_b]
        here = [group for group in here if both and group.limit == both[-1].limit]
    return _last(here, a), _last(here, b)


def _last(here: Sequence[Group], series: str) -> Group | None:
    """The longest run of a system."""
    return next((group for group in reversed(here) if group.series == series), None)


def _compared(in_db: Sequence[_Pair], in_images: Sequence[_Pair]) -> list[str]:
    """Differences in dB of pairs, then quotients of images a second; dashes where one of the two is missing."""
    differences = [_cell(_db(a) - _db(b), a, b) for a, b in in_db]
    return differences + [_cell(_images_a_second(a) / _images_a_second(b), a, b) for a, b in in_images]


def _cell(found: float, a: Published | Group | None, b: Published | Group | None) -> str:
    """A comparison of the two, marked where they ran on different machines."""
    mark = "" if math.isnan(found) or _machines(a) == _machines(b) else " *"
    return number(found, 1) + mark


def _db(found: Published | Group | None) -> float:
    if found is None:
        return math.nan
    return found.psnr_paper_db if isinstance(found, Published) else found.median("psnr_paper_db")


def _machines(found: Published | Group | None) -> set[str]:
    """Without the day; published figures of one table are of one machine."""
    if not isinstance(found, Group):
        return set()
    return {row["machine"].rpartition(", ")[0] for row in found.rows}


def _images_a_second(found: Published | Group | None) -> float:
    if found is None:
        return math.nan
    return (found.fps or math.nan) if isinstance(found, Published) else found.median("render_fps")
