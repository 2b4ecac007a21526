"""Laws of the schedule: cycles double, rates fall in each, and only a gain that is too small ends a run early."""

from __future__ import annotations

import itertools
import json
import math

import pytest

from intrasplat.train.schedule import (
    AVERAGED,
    CLOSING_SHARE,
    MIN_CLOSING_EPOCHS,
    MIN_CYCLE_EPOCHS,
    MIN_CYCLE_ITERATIONS,
    MIN_FRAMES_FOR_VALIDATION,
    RESTART,
    VALIDATION_EVERY,
    Schedule,
    validation_frames,
)

LENGTHS = (1, 7, 250, 499, 500, 501, 999, 1000, 1001, 1733, 2900, 4095)
MIN_GAIN_DB = 0.25
DECIDING = 1003
"""Iterations of three cycles, 250, 501 and 1003 long in all: the shortest run that has something to decide."""


def begun(schedule: Schedule) -> list[int]:
    return [0, *schedule.ends[:-1]]


def after(schedule: Schedule, *scores: float) -> Schedule:
    for score in scores:
        schedule = schedule.with_score(score)
    return schedule


@pytest.mark.parametrize("warm_restarts", [False, True])
@pytest.mark.parametrize("planned", LENGTHS)
def test_ends_ascend_to_the_planned_one(planned: int, warm_restarts: bool) -> None:
    schedule = Schedule(planned, warm_restarts)
    assert list(schedule.ends) == sorted(set(schedule.ends))
    assert schedule.iterations == schedule.ends[-1] == planned


@pytest.mark.parametrize("planned", LENGTHS)
def test_every_cycle_but_the_first_is_as_long_as_all_before_it(planned: int) -> None:
    ends = Schedule(planned, warm_restarts=True).ends
    assert all(end - before in (before, before + 1) for before, end in itertools.pairwise(ends))
    assert ends[0] >= min(planned, MIN_CYCLE_ITERATIONS)
    assert ends[0] < 2 * MIN_CYCLE_ITERATIONS


def test_without_warm_restarts_a_run_is_one_cycle() -> None:
    assert Schedule(4000).ends == (4000,)
    assert Schedule(4000).cycle(4000) == (0, 4000)


@pytest.mark.parametrize("planned", LENGTHS)
def test_every_iteration_belongs_to_one_cycle(planned: int) -> None:
    schedule = Schedule(planned, warm_restarts=True)
    found = [schedule.cycle(iteration) for iteration in range(1, planned + 1)]
    expected = [
        (start, end) for start, end in zip(begun(schedule), schedule.ends, strict=True) for _ in range(end - start)
    ]
    assert found == expected


@pytest.mark.parametrize("schedule", [Schedule(2003, True), Schedule(2003), after(Schedule(2003, True, 9.0), 30, 31)])
def test_rates_fall_to_the_end_of_a_cycle_and_rise_after_it(schedule: Schedule) -> None:
    for start, end in zip(begun(schedule), schedule.ends, strict=True):
        progress = [schedule.progress(iteration) for iteration in range(start + 1, end + 1)]
        assert progress == sorted(set(progress))
        assert progress[-1] == 1
        first = RESTART if start else 0.0
        assert first < progress[0] == pytest.approx(first + (1 - first) / (end - start))


@pytest.mark.parametrize("planned", [each for each in LENGTHS if each >= AVERAGED])
def test_the_mean_that_ends_a_cycle_is_of_as_many_models_as_said_and_of_its_last(planned: int) -> None:
    schedule = Schedule(planned, warm_restarts=True)
    for start, end in zip(begun(schedule), schedule.ends, strict=True):
        averaged = [iteration for iteration in range(start + 1, end + 1) if schedule.averages(iteration)]
        assert len(averaged) == AVERAGED
        assert averaged[-1] == end
        assert end - averaged[0] <= max(AVERAGED, (end - start) / 8)


def test_the_mean_that_ends_a_stopped_run_is_of_as_many_models() -> None:
    schedule = after(Schedule(4000, True, MIN_GAIN_DB), 30.0, 30.1)
    start, end = schedule.ends[-2:]
    assert sum(map(schedule.averages, range(start + 1, end + 1))) == AVERAGED


def test_without_warm_restarts_nothing_is_averaged() -> None:
    assert not any(map(Schedule(600).averages, range(1, 601)))


def scored_to_the_end(schedule: Schedule, scores: list[float]) -> Schedule:
    """What a run makes of its schedule when the validation frames score so, one after another."""
    iteration, waiting = 0, iter(scores)
    while iteration < schedule.iterations:
        iteration += 1
        if schedule.scores_validation(iteration):
            schedule = schedule.with_score(next(waiting))
    assert next(waiting, None) is None
    return schedule


def test_scores_that_grow_by_enough_never_stop_a_run() -> None:
    planned = Schedule(4003, True, MIN_GAIN_DB)
    rising = [30.0 + MIN_GAIN_DB * place for place in range(len(planned.ends) - 1)]
    schedule = scored_to_the_end(planned, rising)
    assert schedule.stopped_at is None
    assert schedule.ends == planned.ends
    assert schedule.notices == ()


@pytest.mark.parametrize("stopping", [1, 2, 3])
def test_the_first_doubling_that_gains_too_little_is_the_last(stopping: int) -> None:
    planned = Schedule(4003, True, MIN_GAIN_DB)
    scores = [30.0 + place for place in range(stopping)]
    schedule = scored_to_the_end(planned, [*scores, scores[-1] + 0.2])
    assert schedule.stopped_at == planned.ends[stopping]
    assert schedule.ends == (*planned.ends[: stopping + 1], schedule.iterations)
    assert schedule.iterations == round(planned.ends[stopping] * (1 + CLOSING_SHARE)) < planned.iterations


@pytest.mark.parametrize("planned", LENGTHS)
def test_a_stopped_run_is_never_longer_than_planned(planned: int) -> None:
    schedule = Schedule(planned, True, MIN_GAIN_DB)
    for count in range(len(schedule.ends)):
        assert after(schedule, *[30.0] * count).iterations <= planned


def test_what_came_before_a_score_stays_as_it_was() -> None:
    before = Schedule(4003, True, MIN_GAIN_DB).with_score(30.0)
    stopped = before.with_score(30.1)
    assert stopped.stopped_at == before.ends[1]
    for iteration in range(1, before.ends[1] + 1):
        for law in (Schedule.cycle, Schedule.progress, Schedule.averages, Schedule.withholds_validation):
            assert law(stopped, iteration) == law(before, iteration)


def test_validation_frames_are_withheld_until_the_last_cycle() -> None:
    schedule = Schedule(4003, True, MIN_GAIN_DB)
    last = schedule.ends[-2]
    assert all(map(schedule.withholds_validation, range(1, last + 1)))
    assert not any(map(schedule.withholds_validation, range(last + 1, 4004)))


def test_validation_frames_are_withheld_until_a_stop() -> None:
    schedule = after(Schedule(4003, True, MIN_GAIN_DB), 30.0, 30.1)
    assert schedule.stopped_at is not None
    assert all(map(schedule.withholds_validation, range(1, schedule.stopped_at + 1)))
    closing = range(schedule.stopped_at + 1, schedule.iterations + 1)
    assert closing
    assert not any(map(schedule.withholds_validation, closing))
    assert not any(map(schedule.scores_validation, closing))


@pytest.mark.parametrize(
    "schedule",
    [
        Schedule(4003, True),
        Schedule(4003, False, MIN_GAIN_DB),
        *(Schedule(n, True, MIN_GAIN_DB) for n in (7, 499, 999)),
    ],
)
def test_a_run_with_nothing_to_decide_leaves_nothing_out(schedule: Schedule) -> None:
    for iteration in range(1, schedule.iterations + 1):
        assert not schedule.withholds_validation(iteration)
        assert not schedule.scores_validation(iteration)


def test_the_shortest_run_that_can_stop_spares_its_last_cycle() -> None:
    planned = Schedule(DECIDING, True, MIN_GAIN_DB)
    assert len(planned.ends) == 3
    assert scored_to_the_end(planned, [30.0, 30.0]).iterations == round(501 * 1.25)


@pytest.mark.parametrize("frames", [28, 63, 83, 84, 200, 1000])
@pytest.mark.parametrize("planned", [1003, 1733, 4003, 30_000])
def test_no_run_stops_before_it_has_seen_its_frames_or_closes_without_some(planned: int, frames: int) -> None:
    schedule = Schedule(planned, True, MIN_GAIN_DB, frames)
    assert schedule.ends[0] >= min(planned, MIN_CYCLE_EPOCHS * frames)
    for count in range(2, len(schedule.ends)):
        stopped = after(schedule, *[30.0] * count)
        assert stopped.stopped_at is not None
        assert stopped.stopped_at >= 2 * MIN_CYCLE_EPOCHS * frames
        assert planned >= stopped.iterations >= stopped.stopped_at + MIN_CLOSING_EPOCHS * frames


@pytest.mark.parametrize("planned", LENGTHS)
def test_a_clip_that_250_steps_show_three_times_needs_no_longer_cycles(planned: int) -> None:
    assert Schedule(planned, True, MIN_GAIN_DB, epoch=83).ends == Schedule(planned, True, MIN_GAIN_DB).ends


@pytest.mark.parametrize("scores", [(), (30.0, 31.5), (30.0, 30.1), (30.0, math.nan)])
def test_a_schedule_is_told_again_by_its_settings(scores: tuple[float, ...]) -> None:
    schedule = after(Schedule(4003, True, MIN_GAIN_DB, 83), *scores)
    again = Schedule.of(json.loads(json.dumps(schedule.settings, allow_nan=False)))
    assert again.settings == schedule.settings
    assert (again.ends, again.stopped_at) == (schedule.ends, schedule.stopped_at)


def test_scores_that_are_no_numbers_stop_nothing() -> None:
    planned = Schedule(DECIDING, True, MIN_GAIN_DB)
    for scores in ((math.nan, math.nan), (30.0, math.nan), (math.nan, 30.0)):
        assert after(planned, *scores).ends == planned.ends


def test_a_stop_is_told_in_words() -> None:
    schedule = after(Schedule(4000, True, MIN_GAIN_DB), 30.0, 31.0, 31.13)
    assert [each.text for each in schedule.notices] == [
        "Training ended after 1250 of 4000 iterations that the time allowed: doubling the first 500 gained 0.13 dB "
        f"on validation frames, less than {MIN_GAIN_DB} dB.",
    ]
    assert after(Schedule(4000, True), 30.0, 30.0).notices == ()


@pytest.mark.parametrize("count", range(MIN_FRAMES_FOR_VALIDATION, MIN_FRAMES_FOR_VALIDATION + 2 * VALIDATION_EVERY))
def test_validation_frames_lie_between_others(count: int) -> None:
    frames = [3 * place + 5 for place in range(count)]
    found = validation_frames(frames)
    assert len(found) >= 2
    assert set(found) < set(frames[1:-1])
    assert all(later - one == 3 * VALIDATION_EVERY for one, later in itertools.pairwise(found))


def test_few_frames_have_no_validation_frames() -> None:
    assert validation_frames(range(MIN_FRAMES_FOR_VALIDATION - 1)) == ()
    assert validation_frames([]) == ()


@pytest.mark.parametrize("min_gain_db", [None, MIN_GAIN_DB])
def test_in_the_opening_rates_are_full_and_validation_frames_stay_out(min_gain_db: float | None) -> None:
    schedule = Schedule(300, True, min_gain_db, opening=15)
    assert [schedule.progress(iteration) for iteration in (1, 15)] == [0.0, 0.0]
    assert schedule.progress(16) == Schedule(300, True).progress(16)
    assert schedule.withholds_validation(15) == (min_gain_db is not None)
    assert not schedule.withholds_validation(16)


@pytest.mark.parametrize(("fitting", "last"), [(700, 1700), (2000, 3000), (9000, 3000), (100, 1500)])
def test_the_last_cycle_has_the_iterations_that_fit_within_bounds(fitting: int, last: int) -> None:
    planned = Schedule(2000, warm_restarts=True)
    assert planned.fitted_at == 1000
    fitted = planned.with_last_cycle(fitting)
    assert fitted.ends == (250, 500, 1000, last)
    assert fitted.iterations == last
    assert fitted.fitted_at is None  # once
    assert fitted.progress(last) == 1.0
    assert fitted.progress(1000) == 1.0
    assert Schedule.of(fitted.settings) == fitted


def test_a_run_that_ends_early_or_in_one_cycle_is_not_fitted() -> None:
    stopped = Schedule(2000, warm_restarts=True, min_gain_db=0.25).with_score(30.0).with_score(30.0)
    assert stopped.fitted_at is None
    assert Schedule(400, warm_restarts=True).fitted_at is None
