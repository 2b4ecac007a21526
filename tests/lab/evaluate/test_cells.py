"""Which cells a command line means, and what a series' name says."""

from __future__ import annotations

import pytest

from intrasplat.errors import InputError
from intrasplat.methods.registry import PRESETS
from lab.evaluate.cells import (
    DEFAULT_SERIES,
    GRID_BASES,
    GRID_POINTS,
    TABLE_1,
    Cell,
    base_of,
    capacity_grid,
    expected_beside,
    options_of,
    own_preset_of,
    plan,
    preset_of,
)
from lab.evaluate.variants import register_variants

register_variants()


def test_a_series_is_a_preset_with_its_changes_made() -> None:
    changed = preset_of("fast:tracks=false,spread=0.5,start_width=none,bases=9,order=random")
    assert (changed.tracks, changed.spread, changed.start_width) == (False, 0.5, None)
    assert (changed.bases, changed.order) == (9, "random")
    assert not preset_of("fast:warm_restarts=false,min_gain_db=none").warm_restarts
    assert preset_of("fast:start_width=0.1").start_width == 0.1
    assert preset_of("fast:frames_a_step=2").frames_a_step == 2
    assert preset_of("paper") is PRESETS["paper"]
    assert base_of("fast:tracks=false") == "fast"


@pytest.mark.parametrize(
    "series",
    [
        "slow", "fast:speed=3", "fast:rates=1", "fast:densify=1", "fast:name=best", "fast:tracks=maybe",
        "fast:bases=few", "fast:bases", "fast:spread=none", "fast:order=sorted", "paper:points_per_image=9000",
        "fast:points_by_budget=false", "fast:spread=nan", "fast:iterations=20", "fast:budget_s=9",
        "fast:bases=3,bases=5", "fast:bases=" + 400 * "9", "fast:eyes=right", "paper:eyes=left", "fast:both_eyes=false",
    ],
)  # fmt: skip
def test_what_no_preset_has_is_refused_with_its_name(series: str) -> None:
    with pytest.raises(InputError, match=series.split(":")[-1].split("=")[0]):
        preset_of(series)


@pytest.mark.parametrize(
    "series",
    [
        "paper:warm_restarts=true", "paper:min_gain_db=0.1", "fast:warm_restarts=false",
        "fast:frames_a_step=0", "fast:frames_a_step=17",
        "fast:bases=0", "fast:bases=-1", "hexplane:bases=-1", "fast:max_bases=0", "fast:points_per_image=0",
        "fast:opacity=1", "fast:spread=0", "paper:start_width=0", "paper:sh_degree=4",
    ],
)  # fmt: skip
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


def test_a_series_is_one_row_however_it_is_spelt() -> None:
    spelt = ["fast:bases=03,spread=0.50", "fast:spread=.5,bases=3", "fast:"]
    names = [cell.series for cell in plan(["a"], spelt, ["every8"], [0])]
    assert names == ["fast:bases=3,spread=0.5", "fast"]
    assert preset_of(names[0]) == preset_of(spelt[0])
    (free,) = plan(["a"], ["fast:warm_restarts=false,min_gain_db=none"], ["every8"], [0])
    assert free.series == "fast:min_gain_db=none,warm_restarts=false"


@pytest.mark.parametrize(("holdouts", "seeds", "field"), [
    (["every8", "every9"], [0], "options.holdout"), (["1,x"], [0], "options.holdout"),
    (["every8"], [0, -1], "options.seed"),
])  # fmt: skip
def test_what_no_reconstruction_takes_is_refused_before_the_first_cell(
    holdouts: list[str], seeds: list[int], field: str
) -> None:
    with pytest.raises(InputError) as refused:
        plan(["a"], ["fast"], holdouts, seeds)
    assert refused.value.field == field


def test_the_grid_of_capacities_has_every_pair_beside_the_presets_own_choice() -> None:
    own, *fixed = capacity_grid("fast")
    chosen = {(preset_of(series).bases, preset_of(series).points_per_image) for series in fixed}
    assert own == "fast"
    assert chosen == {(bases, points) for bases in GRID_BASES for points in GRID_POINTS}


def test_a_cells_key_tells_its_length() -> None:
    assert Cell("a", "fast", "every8", 0, budget_s=60.0).limit == "60 s"
    assert Cell("a", "fast", "every8", 0, iterations=300).limit == "300 iterations"


def test_the_left_eye_alone_is_a_series_of_its_own_for_presets_that_take_both() -> None:
    cells = plan(["a"], ["fast", "fast:bases=9", "paper"], ["every8"], [0], [60], eyes=["left", "both"])
    assert [cell.series for cell in cells] == [
        "fast:eyes=left",
        "fast",
        "fast:bases=9,eyes=left",
        "fast:bases=9",
        "paper",
    ]
    assert [options_of(cell).eyes for cell in cells] == ["left", "both", "left", "both", "both"]
    assert {options_of(cell).preset for cell in cells[:2]} == {"fast"}
    assert preset_of("fast:eyes=left") is PRESETS["fast"], "its points follow the budget as those of the preset do"


def test_eyes_that_a_series_names_are_kept_and_both_need_no_name() -> None:
    cells = plan(["a"], ["fast:eyes=left", "fast:eyes=both"], ["every8"], [0], [60])
    assert [cell.series for cell in cells] == ["fast:eyes=left", "fast"]
    assert base_of("fast:bases=9,eyes=left") == base_of("fast:eyes=left") == "fast:eyes=left"
    assert capacity_grid("fast:eyes=left")[1] == "fast:bases=3,points_per_image=10000,eyes=left"


def test_a_comparison_is_to_have_the_table_where_a_system_of_it_was_measured_and_else_all_presets() -> None:
    assert expected_beside({"fast", "paper"}) == [*DEFAULT_SERIES]
    assert expected_beside({"fast", "lerplane"}) == [*TABLE_1]
    both = expected_beside({"quality", "lerplane"})
    assert set(both) == {*DEFAULT_SERIES, *TABLE_1}
    assert len(both) == len(set(both))


def test_a_variant_of_paper_is_trained_as_a_preset_of_the_caller_on_the_frames_of_paper() -> None:
    variant = Cell("clip", "hexplane", "every8", 0, budget_s=60.0)
    assert options_of(variant).preset == "paper"
    assert own_preset_of("hexplane") is PRESETS["hexplane"]
    assert own_preset_of("fast") is None
    changed = own_preset_of("fast:bases=9")
    assert changed is not None
    assert changed.bases == 9
