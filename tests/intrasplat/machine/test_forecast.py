"""The seconds that a reconstruction still takes, told from its first report on."""

from __future__ import annotations

import pytest

from intrasplat.machine.forecast import IN_BUDGET, USUAL_S, TimeEstimate
from intrasplat.machine.hooks import Progress

FRAMES, MEGAPIXELS = 100, 30.0
STAGES = [stage for stage in USUAL_S if stage != "publish"]


def run_through(pace: float, budget_s: float | None = None, iterations: int | None = None) -> list[tuple[float, float]]:
    """Seconds left as told, and as they turn out, at ten moments of each stage of a machine of this pace."""
    now_s = 0.0
    forecast = TimeEstimate(iterations, budget_s, clock=lambda: now_s)
    took_s = {stage: pace * (fixed + each * MEGAPIXELS) for stage, (fixed, each) in USUAL_S.items()}
    if budget_s is None:
        assert iterations is not None
        took_s["train"] = pace * iterations * 0.036
    else:
        took_s["train"] = budget_s - sum(took_s[stage] for stage in IN_BUDGET)
    end_s, told = sum(took_s.values()), []
    for stage in STAGES:
        for tenth in range(10):
            known = (FRAMES, MEGAPIXELS) if stage == "stereo" else (0, 0.0)
            left_s = (1 - tenth / 10) * took_s[stage] if stage == "train" and tenth else None
            progress = Progress(stage, tenth / 10, seconds_left=left_s, frames=known[0], megapixels=known[1])
            found_s = forecast.completed(progress).seconds_left
            assert found_s is not None
            told.append((found_s, end_s - now_s))
            now_s += took_s[stage] / 10
    return told


@pytest.mark.parametrize("pace", [0.7, 1.0, 2.0])
@pytest.mark.parametrize("length", [{"budget_s": 6.0}, {"budget_s": 60.0}, {"iterations": 600}])
def test_from_the_first_tenth_on_it_is_right_within_a_quarter_of_the_whole(
    pace: float, length: dict[str, float]
) -> None:
    told = run_through(pace, **length)  # type: ignore[arg-type]
    whole_s = told[0][1]
    late = [(found, left) for found, left in told if left < 0.9 * whole_s]
    assert max(abs(found - left) for found, left in late) < 0.25 * whole_s


def test_a_stage_that_it_does_not_know_is_told_as_it_is() -> None:
    progress = Progress("score", 0.5)
    assert TimeEstimate(None, 60.0).completed(progress) is progress


def test_compilation_changes_nothing_wherever_it_comes() -> None:
    forecast = TimeEstimate(None, 60.0, clock=lambda: 0.0)
    for stage in ("decode", "stereo", "start"):
        before_s = forecast.completed(Progress(stage, 1.0)).seconds_left
        assert forecast.completed(Progress("compile", 0.3)).seconds_left == before_s
