"""Claims are computed from rows, and from nothing else."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from lab.evaluate.rows import CURVE_FIELDS, CURVES, RUN_FIELDS, RUNS, Results, write_rows
from lab.evaluate.summary import capacities, groups_of, orderings, reach, sooner
from tests.lab.evaluate.made_up import curve_rows, failed_row, run_row

RISING = [(2.0, 100, 30.0), (8.0, 400, 34.0), (32.0, 1600, 36.0)]


def test_a_curve_reaches_a_score_between_its_samples_in_logarithms() -> None:
    assert reach(RISING, 32.0) == pytest.approx((4.0, 200.0))
    assert reach(RISING, 36.0) == pytest.approx((32.0, 1600.0))
    assert reach(RISING, 29.0) == (2.0, 100.0), "before its first sample nothing is known"
    assert reach(RISING, 36.1) == (math.inf, math.inf)


def test_a_curve_that_falls_again_counts_from_when_it_was_there_first() -> None:
    assert reach([*RISING, (40.0, 2000, 33.0)], 34.0) == pytest.approx((8.0, 400.0))


def test_the_headline_compares_medians_over_seeds_at_the_papers_final_score() -> None:
    curves = []
    for seed, final_db in enumerate((33.9, 34.0, 35.0)):
        curves += curve_rows(run_row("paper", final_db, seed=seed), [(10.0, 100, 20.0), (240.0, 3000, final_db)])
    for seed in range(3):
        curves += curve_rows(run_row("fast", 36.0, seed=seed), RISING)
    (found,) = sooner(curves)
    assert (found.target_db, found.their_s, found.their_iterations) == (34.0, 240.0, 3000.0)
    assert found.times_in_seconds == pytest.approx(30.0)
    assert found.times_in_iterations == pytest.approx(7.5)


def test_each_length_of_ours_is_a_comparison_of_its_own() -> None:
    curves = curve_rows(run_row("paper", 33.0), [(240.0, 3000, 33.0)])
    curves += curve_rows(run_row("fast", 36.0, limit="60 s"), [(20.0, 900, 32.0), (60.0, 2800, 36.0)])
    curves += curve_rows(run_row("fast", 33.5, limit="10 s"), [(5.0, 200, 32.0), (10.0, 400, 33.0)])
    long, short = sooner(curves)
    assert (long.our_limit, short.our_limit) == ("60 s", "10 s")
    assert short.times_in_seconds == pytest.approx(24.0)
    assert (long.times_in_seconds or 0.0) < 12.0


def test_a_paper_run_that_over_fits_is_also_compared_from_when_it_was_as_good_first() -> None:
    curves = curve_rows(run_row("paper", 33.0), [(10.0, 100, 30.0), (40.0, 500, 33.0), (240.0, 3000, 33.0)])
    curves += curve_rows(run_row("paper", 33.0, seed=1), [(10.0, 100, 30.0), (60.0, 500, 34.0), (240.0, 3000, 33.0)])
    (found,) = sooner(curves + curve_rows(run_row("fast", 36.0), [(8.0, 300, 33.0), (60.0, 2800, 36.0)]))
    assert found.their_s == 240.0
    assert 38.0 < found.their_first_s < 50.0
    assert found.times_from_their_first == pytest.approx(found.their_first_s / 8.0)


def test_the_papers_longest_runs_are_what_counts_as_its_final_score() -> None:
    curves = curve_rows(run_row("paper", 33.0, limit="3000 iterations"), [(240.0, 3000, 33.0)])
    curves += curve_rows(run_row("paper", 25.0, limit="6 s"), [(6.0, 70, 25.0)])
    (found,) = sooner(curves + curve_rows(run_row("fast", 36.0), RISING))
    assert (found.target_db, found.their_s, found.their_iterations) == (33.0, 240.0, 3000.0)


def test_what_never_gets_there_is_said_not_to() -> None:
    curves = curve_rows(run_row("paper", 39.0), [(240.0, 3000, 39.0)]) + curve_rows(run_row("fast", 36.0), RISING)
    (found,) = sooner(curves)
    assert (found.our_s, found.times_in_seconds, found.times_in_iterations) == (None, None, None)
    assert sooner(curve_rows(run_row("fast", 36.0), RISING)) == [], "without the paper there is no headline"


def test_a_summary_holds_medians_spread_and_what_failed() -> None:
    rows = [run_row("fast", score, seed=seed) for seed, score in enumerate((36.0, 36.4, 36.1))]
    fast, hexplane = (group.summary() for group in groups_of([*rows, failed_row("hexplane")]))
    assert (fast["psnr_tissue_db"], fast["spread_db"], fast["seeds"], fast["failed"]) == ("36.1", "0.400", 3, 0)
    assert (hexplane["psnr_tissue_db"], hexplane["seeds"], hexplane["failed"]) == ("", 0, 1)


def test_the_automatic_choice_is_compared_seed_by_seed_with_the_best_of_the_grid() -> None:
    rows = [run_row("fast", score, seed=seed) for seed, score in enumerate((30.0, 31.0))]
    rows += [run_row("fast:bases=9", score, seed=seed) for seed, score in enumerate((30.1, 31.3))]
    rows += [run_row("fast:bases=3", score, seed=seed) for seed, score in enumerate((29.0, 29.0))]
    rows += [run_row("fast:bases=33", 40.0, limit="9 s"), run_row("paper:bases=3", 40.0)]
    (found,) = capacities(groups_of(rows))
    assert found.best.series == "fast:bases=9"
    assert found.seeds == 2
    assert found.difference_db == pytest.approx(-0.2)
    assert found.deviation_db == pytest.approx(0.1 * math.sqrt(2))


def test_it_is_also_compared_with_the_best_that_takes_no_more_bytes() -> None:
    sizes = {"fast": 2e6, "fast:bases=3": 1e6, "fast:bases=9": 2e6, "fast:bases=17": 3e6}
    scores = {"fast": 30.0, "fast:bases=3": 29.0, "fast:bases=9": 29.8, "fast:bases=17": 31.0}
    rows = [run_row(series, scores[series], scene_bytes=str(size)) for series, size in sizes.items()]
    (found,) = capacities(groups_of(rows))
    assert (found.best.series, found.difference_db) == ("fast:bases=17", pytest.approx(-1.0))
    assert found.at_bytes_db == pytest.approx(0.2)
    (found,) = capacities(groups_of([rows[0], rows[-1]]))
    assert math.isnan(found.at_bytes_db)


@pytest.mark.parametrize(
    ("scores", "verdict"),
    [
        ({"paper": 38.0, "without_mapf": 37.0, "hexplane": 36.0, "pfs": 35.0}, "confirmed"),
        ({"paper": 38.0, "pfs": 37.0, "hexplane": 36.0, "without_mapf": 35.0}, "FDM first, as in the paper; 3 of 6"),
        ({"pfs": 38.0, "paper": 37.0, "without_mapf": 36.0, "hexplane": 35.0}, "contradicted: pfs first; 3 of 6"),
        ({"paper": 38.0, "pfs": 37.0}, "not decided: without_mapf, hexplane missing"),
    ],
)
def test_the_papers_ablation_is_confirmed_or_contradicted_in_words(scores: dict[str, float], verdict: str) -> None:
    (found,) = orderings(groups_of([run_row(series, score) for series, score in scores.items()]))
    assert found.verdict.startswith(verdict)
    assert list(found.scores_db) == sorted(scores, key=lambda series: -scores[series])


def test_rows_of_stereo_clips_from_before_both_eyes_taught_are_of_the_left_eye(tmp_path: Path) -> None:
    stereo = {"clip": "d4d-a-stereo", "seconds": '{"decode_s": 2.0, "stereo_s": 2.2}'}
    old = [run_row("fast", 38.6, **stereo), run_row("paper", 37.0, **stereo), run_row("fast", 40.0)]
    fields = [name for name in RUN_FIELDS if name != "psnr_right_db"]
    write_rows(tmp_path / RUNS, fields, old)
    write_rows(tmp_path / CURVES, CURVE_FIELDS, [row for run in old for row in curve_rows(run, RISING)])
    results = Results(tmp_path)
    assert [row["series"] for row in results.runs] == ["fast:eyes=left", "paper", "fast"]
    assert [row["series"] for row in results.curves[::3]] == ["fast:eyes=left", "paper", "fast"]
    results.add(run_row("fast", 37.5, psnr_right_db=36.0, **stereo), [])
    assert [row["series"] for row in Results(tmp_path).runs] == ["fast:eyes=left", "paper", "fast", "fast"]
