"""Which cells a command line means, and what a series' name says."""

from __future__ import annotations

import pytest

from contract.errors import InputError
from worker.evaluate.cells import GRID_BASES, GRID_POINTS, Cell, base_of, capacity_grid, plan, preset_of
from worker.presets import PRESETS


def test_a_series_is_a_preset_with_its_changes_made() -> None:
    changed = preset_of("fast:tracks=false,spread=0.5,start_width=none,bases=9,order=random,budget_s=9")
    assert (changed.tracks, changed.spread, changed.start_width) == (False, 0.5, None)
    assert (changed.bases, changed.order, changed.budget_s) == (9, "random", 9.0)
    assert not preset_of("fast:cycles=false,worth_db=none").cycles
    assert preset_of("fast:start_width=0.1").start_width == 0.1
    assert preset_of("fast:frames_a_step=2").frames_a_step == 2
    assert preset_of("paper") is PRESETS["paper"]
    assert base_of("fast:tracks=false") == "fast"


@pytest.mark.parametrize(
    "series",
    [
        "slow", "fast:speed=3", "fast:rates=1", "fast:densify=1", "fast:name=best", "fast:tracks=maybe",
        "fast:bases=few", "fast:bases", "fast:spread=none", "fast:order=sorted", "paper:points_per_image=9000",
        "fast:points_by_budget=false",
    ],
)  # fmt: skip
def test_what_no_preset_has_is_refused_with_its_name(series: str) -> None:
    with pytest.raises(InputError, match=series.split(":")[-1].split("=")[0]):
        preset_of(series)


@pytest.mark.parametrize(
    "series",
    ["paper:cycles=true", "paper:worth_db=0.1", "fast:cycles=false", "fast:frames_a_step=0", "fast:frames_a_step=17"],
)
def test_changes_that_do_not_go_together_are_refused(series: str) -> None:
    with pytest.raises(InputError, match=series) as refused:
        preset_of(series)
    assert refused.value.field == "--series"


def test_a_preset_trains_as_long_as_it_says_unless_told_otherwise() -> None:
    fast, paper = plan(["clip"], ["fast", "paper"], ["every8"], [0])
    assert (fast.budget_s, fast.iterations) == (PRESETS["fast"].budget_s, None)
    assert (paper.budget_s, paper.iterations) == (None, 3000)
    assert [cell.limit for cell in plan(["clip"], ["paper"], ["every8"], [0], [6, 15])] == ["6 s", "15 s"]


def test_the_plan_is_every_combination_and_no_two_cells_share_a_key() -> None:
    cells = plan(["a", "b"], ["fast", "paper"], ["every8", "blocks8"], [0, 1, 2], iterations=[10, 20])
    assert len({cell.key for cell in cells}) == len(cells) == 2 * 2 * 2 * 3 * 2
    assert [cell.clip for cell in cells] == sorted(cell.clip for cell in cells), "each clip is opened once"


def test_the_grid_of_capacities_has_every_pair_beside_the_presets_own_choice() -> None:
    own, *fixed = capacity_grid("fast")
    chosen = {(preset_of(series).bases, preset_of(series).points_per_image) for series in fixed}
    assert own == "fast"
    assert chosen == {(bases, points) for bases in GRID_BASES for points in GRID_POINTS}


def test_a_cells_key_tells_its_length() -> None:
    assert Cell("a", "fast", "every8", 0, budget_s=60.0).limit == "60 s"
    assert Cell("a", "fast", "every8", 0, iterations=300).limit == "300 iterations"
