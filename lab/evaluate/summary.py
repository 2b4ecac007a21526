"""What the rows say together: medians over seeds, and each claim computed from them.

Symbols: a place is a clip with a way of holding out; a group is all seeds of a series with a limit at a place.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median, stdev

from lab.evaluate.cells import base_of
from lab.evaluate.published import ABLATION
from lab.evaluate.rows import COPIES, SCORES, SIZE, SPEED, TRUTH, Row

Place = tuple[str, str]
MEDIANS = tuple(name for name in (*SCORES, *COPIES, *TRUTH, *SIZE, *SPEED) if name != "seconds")
SUMMARY_FIELDS = ("clip", "holdout", "series", "limit", "seeds", "failed", "spread_db", *MEDIANS)


@dataclass(frozen=True)
class Group:
    """The runs of one series with one limit at one place; rows are those that ended well."""

    clip: str
    holdout: str
    series: str
    limit: str
    rows: tuple[Row, ...]
    errors: tuple[str, ...]

    @property
    def place(self) -> Place:
        return self.clip, self.holdout

    def median(self, name: str) -> float:
        """Over seeds; NaN where nothing was measured."""
        known = [float(row[name]) for row in self.rows if row[name]]
        return median(known) if known else math.nan

    def by_seed(self, name: str) -> dict[str, float]:
        """The figure of each seed."""
        return {row["seed"]: float(row[name]) for row in self.rows if row[name]}

    def summary(self) -> dict[str, object]:
        """SUMMARY_FIELDS; spread_db is the largest psnr_tissue of any seed less the smallest."""
        found = self.by_seed("psnr_tissue_db").values()
        place = {"clip": self.clip, "holdout": self.holdout, "series": self.series, "limit": self.limit}
        counts = {"seeds": len(self.rows), "failed": len(self.errors)}
        spread = {"spread_db": f"{max(found) - min(found):.3f}" if found else ""}
        medians = {name: self.median(name) for name in MEDIANS}
        shown = {name: "" if math.isnan(value) else f"{value:.6g}" for name, value in medians.items()}
        return {**place, **counts, **spread, **shown}


def groups_of(runs: Sequence[Row]) -> list[Group]:
    """The groups in the order in which their first rows stand."""
    found: dict[tuple[str, str, str, str], list[Row]] = {}
    for row in runs:
        found.setdefault((row["clip"], row["holdout"], row["series"], row["limit"]), []).append(row)
    return [
        Group(*key, tuple(row for row in rows if not row["error"]), tuple(row["error"] for row in rows if row["error"]))
        for key, rows in found.items()
    ]


@dataclass(frozen=True)
class Sooner:
    """How soon preset fast, in runs of our_limit, first reaches the final psnr_tissue of preset paper at a place.

    All figures are medians over seeds: "our" ones of fast, None if it does not get there; "their" ones of the longest
    runs of paper. their_first_s is when paper is first as good as at its end: early in a run that over-fits.
    """

    clip: str
    holdout: str
    target_db: float
    their_s: float
    their_iterations: float
    their_first_s: float
    our_limit: str
    our_s: float | None = None
    our_iterations: float | None = None

    @property
    def times_in_seconds(self) -> float | None:
        return None if self.our_s is None else self.their_s / self.our_s

    @property
    def times_from_their_first(self) -> float | None:
        return None if self.our_s is None else self.their_first_s / self.our_s

    @property
    def times_in_iterations(self) -> float | None:
        return None if self.our_iterations is None else self.their_iterations / self.our_iterations


Point = tuple[float, float, float]
"""t_train_s, iteration, psnr_tissue_db."""


def sooner(curves: Sequence[Row]) -> list[Sooner]:
    """The headline: for each place where both ran and each limit of fast, how soon fast is as good as paper's end."""
    runs = _curves_by_run(curves)
    found = []
    for place in dict.fromkeys((clip, holdout) for clip, holdout, *_ in runs):
        of_theirs, of_ours = (_by_limit(runs, (*place, series)) for series in ("paper", "fast"))
        if not of_theirs:
            continue
        their_s, their_iterations, target_db, longest = max(
            ((*_median_end(alike), alike) for alike in of_theirs.values()), key=lambda end: end[1]
        )
        first_s = median(min(reach(points, target_db)[0], points[-1][0]) for points in longest)
        for limit, alike in of_ours.items():
            our_s, our_iterations = (
                median(values) for values in zip(*(reach(p, target_db) for p in alike), strict=True)
            )
            row = Sooner(*place, target_db, their_s, their_iterations, first_s, limit)
            there = math.isfinite(our_s)
            found.append(replace(row, our_s=our_s, our_iterations=our_iterations) if there else row)
    return found


def reach(points: Sequence[Point], target_db: float) -> tuple[float, float]:
    """Seconds and iterations at which a curve first reaches target_db, infinite if it does not.

    Between two samples both are interpolated, their logarithms being linear in dB; a curve that begins above the target
    counts from its first sample.
    """
    before: Point | None = None
    for point in points:
        if point[2] >= target_db:
            if before is None:
                return point[0], point[1]
            share = (target_db - before[2]) / (point[2] - before[2])
            seconds, iterations = (
                math.exp((1 - share) * math.log(a) + share * math.log(b))
                for a, b in zip(before[:2], point[:2], strict=True)
            )
            return seconds, iterations
        before = point
    return math.inf, math.inf


def _curves_by_run(curves: Sequence[Row]) -> dict[tuple[str, str, str, str, str], list[Point]]:
    runs: dict[tuple[str, str, str, str, str], list[Point]] = {}
    for row in curves:
        point = (float(row["t_train_s"]), float(row["iteration"]), float(row["psnr_tissue_db"]))
        runs.setdefault((row["clip"], row["holdout"], row["series"], row["seed"], row["limit"]), []).append(point)
    return {key: sorted(points) for key, points in runs.items()}


def _by_limit(
    runs: Mapping[tuple[str, str, str, str, str], list[Point]], series: tuple[str, str, str]
) -> dict[str, list[list[Point]]]:
    """The curves of all seeds of a series at a place, by their length."""
    found: dict[str, list[list[Point]]] = {}
    for key, points in runs.items():
        if key[:3] == series:
            found.setdefault(key[4], []).append(points)
    return found


def _median_end(alike: Sequence[Sequence[Point]]) -> Point:
    seconds, iterations, psnr_db = (median(values) for values in zip(*(points[-1] for points in alike), strict=True))
    return seconds, iterations, psnr_db


@dataclass(frozen=True)
class Capacity:
    """The automatic choice compared with the best of the grid at a place.

    difference_db is the mean over seeds of chosen - best, each seed with itself; deviation_db the standard deviation of
    these differences, estimated from the seeds there are; NaN of one.
    The best is the grid's highest mean of the same held-out frames, so that it is flattered and the choice is not.
    at_bytes_db is the difference from the best of those of the grid that take no more bytes; NaN if all take more.
    """

    chosen: Group
    best: Group
    seeds: int
    difference_db: float
    deviation_db: float
    at_bytes_db: float


def capacities(groups: Sequence[Group]) -> list[Capacity]:
    """For each place, preset and limit with variants, how the preset's own choice compares."""
    found = []
    for chosen in groups:
        if chosen.series != base_of(chosen.series) or not chosen.by_seed("psnr_tissue_db"):
            continue
        grid = [
            group
            for group in groups
            if (*group.place, group.limit) == (*chosen.place, chosen.limit)
            and group.series != chosen.series
            and base_of(group.series) == chosen.series
            and group.by_seed("psnr_tissue_db")
        ]
        if not grid:
            continue
        best, pairs = _best_beside(chosen, grid)
        as_small = [each for each in grid if each.median("scene_bytes") <= chosen.median("scene_bytes")]
        if pairs:
            deviation_db = stdev(pairs) if len(pairs) > 1 else math.nan
            at_bytes_db = fmean(_best_beside(chosen, as_small)[1] or [math.nan]) if as_small else math.nan
            found.append(Capacity(chosen, best, len(pairs), fmean(pairs), deviation_db, at_bytes_db))
    return found


def _best_beside(chosen: Group, grid: Sequence[Group]) -> tuple[Group, list[float]]:
    """The group of the grid with the highest mean score (of equals the smallest), and chosen - best in dB by seed."""
    best = max(grid, key=lambda each: (fmean(each.by_seed("psnr_tissue_db").values()), -each.median("scene_bytes")))
    of_chosen, of_best = chosen.by_seed("psnr_tissue_db"), best.by_seed("psnr_tissue_db")
    return best, [of_chosen[seed] - of_best[seed] for seed in of_chosen if seed in of_best]


@dataclass(frozen=True)
class Ordering:
    """The paper's ablation on a clip of ours: median psnr_tissue of each series, best first; None where it is missing.

    agreeing and pairs count the pairs of series that stand in the paper's order.
    """

    place: Place
    scores_db: dict[str, float]
    missing: tuple[str, ...]
    agreeing: int
    pairs: int

    @property
    def verdict(self) -> str:
        """In words, whether the paper's order is confirmed here."""
        if self.missing:
            return f"not decided: {', '.join(self.missing)} missing"
        leader = next(iter(self.scores_db))
        if self.agreeing == self.pairs:
            return "confirmed"
        first = "FDM first, as in the paper" if leader == "paper" else f"contradicted: {leader} first"
        return f"{first}; {self.agreeing} of {self.pairs} pairs in its order"


def orderings(groups: Sequence[Group]) -> list[Ordering]:
    """For each place where at least two series of the paper's ablation were run, in which order they stand."""
    found = []
    for place in dict.fromkeys(group.place for group in groups if group.series in ABLATION):
        here = [group for group in groups if group.place == place and group.series in ABLATION and group.rows]
        here.sort(key=lambda group: group.median("iterations"))  # the longest run of a series is the one that counts
        medians = {group.series: group.median("psnr_tissue_db") for group in here}
        known = {name: score for name, score in medians.items() if not math.isnan(score)}
        if len(known) < 2:
            continue
        ordered = dict(sorted(known.items(), key=lambda each: -each[1]))
        pairs = [pair for pair in itertools.combinations(ABLATION, 2) if set(pair) <= set(known)]
        agreeing = sum((known[a] > known[b]) == (ABLATION[a] > ABLATION[b]) for a, b in pairs)
        missing = tuple(name for name in ABLATION if name not in known)
        found.append(Ordering(place, ordered, missing, agreeing, len(pairs)))
    return found
