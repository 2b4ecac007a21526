"""Presets say what they claim: the published numbers, and variants of the published method that differ in one thing."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from typing import get_args

import pytest

from intrasplat.errors import InputError
from intrasplat.methods.method import Preset
from intrasplat.methods.registry import PRESETS, preset_named, register_presets
from intrasplat.names import LABORATORY_PRESETS, PresetName
from intrasplat.splat.optimize import Rate
from tests.intrasplat.methods.literals import LITERALS

VARIANTS = {  # and what they change of `paper`
    "paper-released": {"deformation"},
    "paper-wide": {"start_width"},
    "pfs": {"deformation", "start_width"},
    "hexplane": {"deformation", "bases", "start_width"},
    "without_mapf": {"fusion"},
}


OFFERED = get_args(PresetName)


def differing(one: Preset, other: Preset) -> set[str]:
    names = {field.name for field in dataclasses.fields(Preset)} - {"name"}
    return {name for name in names if getattr(one, name) != getattr(other, name)}


@pytest.mark.parametrize("literal", LITERALS, ids=lambda preset: preset.name)
def test_a_preset_has_the_numbers_it_had_before_it_was_made_of_departures(literal: Preset) -> None:
    assert PRESETS[literal.name] == literal
    assert repr(PRESETS[literal.name]) == repr(literal), "a stopped run is resumed by the text of its preset"


def test_the_contract_offers_these_presets_and_the_laboratory_adds_its_variants() -> None:
    assert tuple(literal.name for literal in LITERALS) == OFFERED
    assert tuple(PRESETS) == (*OFFERED, *LABORATORY_PRESETS)
    assert tuple(VARIANTS) == LABORATORY_PRESETS


@pytest.mark.parametrize("name", OFFERED)
def test_a_preset_is_found_under_its_own_name(name: str) -> None:
    assert preset_named(name).name == name


def test_an_unknown_preset_is_refused_with_those_there_are() -> None:
    with pytest.raises(InputError) as refused:
        preset_named("best")
    assert refused.value.field == "options.preset"
    assert "'best'" in refused.value.problem
    assert all(name in refused.value.remedy for name in PRESETS)


@pytest.mark.parametrize("name", [*OFFERED, *VARIANTS])
def test_a_preset_has_a_length_of_its_own(name: str) -> None:
    preset = PRESETS[name]
    assert (preset.iterations is None) != (preset.budget_s is None)


@pytest.mark.parametrize(("name", "fields"), VARIANTS.items())
def test_an_ablation_differs_from_the_paper_in_what_it_is_named_for_alone(name: str, fields: set[str]) -> None:
    assert differing(PRESETS[name], PRESETS["paper"]) == fields


def test_ours_differ_in_time_and_in_how_many_gaussians_it_pays_for() -> None:
    instant, fast, quality = (PRESETS[name] for name in ("instant", "fast", "quality"))
    for other in (instant, quality):
        assert differing(other, fast) <= {"points_per_image", "budget_s", "min_gain_db", "rates"}
        assert other.points_by_budget
    assert quality.rates == fast.rates
    assert instant.rates.motion_mean.at(0.5) / fast.rates.motion_mean.at(0.5) == pytest.approx(1.6)
    assert (instant.rates.beta1, instant.rates.beta2) == (fast.rates.beta1, fast.rates.beta2)
    budgets = [preset.budget_s or 0.0 for preset in (instant, fast, quality)]
    assert budgets == sorted(set(budgets))


def test_small_is_fast_with_less_to_store() -> None:
    small, fast = PRESETS["small"], PRESETS["fast"]
    assert differing(small, fast) == {"points_per_image", "points_by_budget", "max_bases", "rates", "budget_s"}
    assert small.points_per_image == PRESETS["instant"].points_per_image
    still = dataclasses.replace(fast.rates, motion_log_scale=Rate(0.0))
    assert small.rates == still


def test_warm_restarts_are_ours_alone() -> None:
    assert {name for name, preset in PRESETS.items() if preset.warm_restarts} == {"instant", "fast", "quality", "small"}


def test_an_average_of_models_needs_a_fixed_number_of_gaussians() -> None:
    with pytest.raises(ValueError, match="densification"):
        dataclasses.replace(PRESETS["paper"], warm_restarts=True)
    with pytest.raises(ValueError, match="densification"):
        dataclasses.replace(PRESETS["fast"], densify=PRESETS["paper"].densify)


def test_early_stopping_needs_warm_restarts() -> None:
    with pytest.raises(ValueError, match="needs warm_restarts"):
        dataclasses.replace(PRESETS["paper"], min_gain_db=0.1)
    with pytest.raises(ValueError, match="needs warm_restarts"):
        dataclasses.replace(PRESETS["fast"], warm_restarts=False)
    assert not dataclasses.replace(PRESETS["fast"], warm_restarts=False, min_gain_db=None).warm_restarts


def test_little_time_is_not_spent_on_many_gaussians() -> None:
    assert preset_named("fast", budget_s=6.0).points_per_image == PRESETS["instant"].points_per_image
    assert preset_named("instant", budget_s=60.0).points_per_image == PRESETS["fast"].points_per_image
    assert preset_named("small", budget_s=60.0) == PRESETS["small"]
    assert preset_named("paper", budget_s=6.0) == PRESETS["paper"]


def test_the_paper_is_trained_as_published() -> None:
    paper = PRESETS["paper"]
    assert (paper.deformation, paper.bases, paper.start_width) == ("fdm-gaussian", 17, 0.01)
    assert (paper.iterations, paper.order, paper.sh_degree) == (3000, "random", 3)
    assert paper.fusion.mode == "paper"
    assert paper.densify is not None
    assert paper.densify.from_iteration == 600
    assert (paper.loss.colour_weight, paper.loss.depth_weight) == (1, 1)
    assert not paper.loss.normalised_depth
    assert paper.rates.motion_mean == paper.rates.mean
    # 1.6e-3 falls log-linearly to a hundredth of itself over 4000 steps, of which 3000 are made
    for progress in (0.0, 0.3, 1.0):
        assert paper.rates.mean.at(progress) == pytest.approx(1.6e-3 * 0.01 ** (progress * 3000 / 4000), rel=1e-3)


def test_presets_cannot_be_changed_by_accident() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        PRESETS["fast"].bases = 3  # type: ignore[misc]
    with pytest.raises(TypeError):
        PRESETS["mine"] = PRESETS["fast"]  # type: ignore[index]


def test_a_preset_is_registered_once_and_again_but_no_other_under_its_name() -> None:
    before = dict(PRESETS)
    register_presets(PRESETS["fast"], PRESETS["hexplane"])
    with pytest.raises(ValueError, match="another preset 'fast'"):
        register_presets(dataclasses.replace(PRESETS["fast"], opacity=0.5))
    assert before == PRESETS


def test_a_process_knows_the_variants_only_after_they_are_registered() -> None:
    program = """
from intrasplat.methods.registry import PRESETS
from intrasplat.splat.deformation import MOTIONS
print(*PRESETS, *MOTIONS)
from lab.evaluate.variants import register_variants
print(len(PRESETS), len(MOTIONS))
register_variants()
print(*PRESETS, *MOTIONS)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    before, imported, after = (line.split() for line in done.stdout.splitlines())
    assert before == [*OFFERED, "fdm-gaussian", "shared"]
    assert imported == [str(len(OFFERED)), "2"], "nothing happens at import"
    assert after == [*OFFERED, *LABORATORY_PRESETS, "fdm-gaussian", "shared", "fdm-quartic", "pfs", "hexplane"]
