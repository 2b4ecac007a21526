"""The part of docs/results/index.md on the four systems of the paper's table 1: the rows of `make table1`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

from lab.evaluate.published import RESULTS, Published
from lab.evaluate.rows import CURVES, RUNS, Results
from lab.evaluate.summary import Group, Place, groups_of
from lab.pages.markdown import number, origin, source, table
from lab.rivals import RIVAL_SYSTEMS

TABLE_1 = "table1"
"""The folder beside runs.csv that holds the rows, and their charts."""
SYSTEMS = {"paper": "Deform3DGS", "endogaussian": "EndoGaussian", "lerplane": "LerPlane", "endonerf": "EndoNeRF"}
"""By series: what the paper calls it. In the paper's order: each has more dB and more images a second than the next."""
_INTRODUCTION = """
## The paper's table 1 under one clock

EndoNeRF, LerPlane and EndoGaussian, written anew from the papers, beside Deform3DGS (`paper`) and `fast`, on the same
frames and by the same scores; the longest run of each ([what had to differ, and what the rows show](../rivals.md)).
Hollow marks in the charts are published, on other hardware and data.

![Held-out psnr_tissue against seconds of training, for each system](table1/curves.png)

![Final psnr_tissue against seconds of training](table1/pareto.png)

![Final psnr_tissue against images rendered a second](table1/frames.png)
"""
_ORDERS = """
The paper has each system ahead of the next in dB (`psnr_paper`, subtracted) and in images a second (divided): a
difference below 0, or a quotient below 1, contradicts it, and `*` marks two machines. Two rivals are compared after the
longest limit that both have had.
"""
_COLUMNS = {
    "t_train_s": ("s", 0), "psnr_tissue_db": ("dB", 1), "render_fps": ("images/s", 2),
    "psnr_view10_db": ("10°, dB", 1),
}  # fmt: skip
"""By column of runs.csv: its name and digits."""
_SHOWN_HOLDOUT = "every8"
"""The tables show this way of holding out; the rows have blocks8 as well."""
_Pair = tuple[Published | Group | None, Published | Group | None]


def table1_sections(folder: Path) -> list[str]:
    """The section; nothing without rows."""
    results = Results(folder / TABLE_1)
    groups = [group for group in groups_of(results.runs) if group.rows]
    if not groups:
        return []
    places = list(dict.fromkeys(group.place for group in groups))
    shown = [place for place in places if place[1] == _SHOWN_HOLDOUT]
    rows = []
    for place in shown:
        here = _in_order(groups, place)
        longest = [_last(here, series) for series in dict.fromkeys(group.series for group in here)]
        rows += [_row(group) for group in longest if group]
    header = ["clip", "series", *(name for name, _ in _COLUMNS.values()), "MB"]
    by_system = [f"\nHeld out: {_SHOWN_HOLDOUT}; the rows have the others.\n", table(header, rows)] if rows else []
    command = source("make table1", f"{TABLE_1}/{RUNS}", f"{TABLE_1}/{CURVES}")
    return [_INTRODUCTION, command, *by_system, *_orders(groups, shown), origin(results.runs)]


def _row(group: Group) -> list[str]:
    figures = [number(group.median(name), digits) for name, (_, digits) in _COLUMNS.items()]
    return [group.clip, group.series, *figures, number(group.median("scene_bytes") / 1e6, 1)]


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
        measured.append([place[0], *_compared(in_db, in_images)])
    if not comparable:
        return []
    published = []
    for data in dict.fromkeys(each.data for each in RESULTS):
        methods = {each.method: each for each in RESULTS if each.data == data}
        known = [(methods[SYSTEMS[a]], methods[SYSTEMS[b]]) for a, b in pairs]
        published.append([f"published, {data} data", *_compared(known, known)])
    header = ["clip", *(f"{a} – {b}, dB" for a, b in pairs), *(f"{a} / {b}, images" for a, b in pairs)]
    return [_ORDERS, table(header, published + measured)]


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
