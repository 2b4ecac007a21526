"""Pace: a single render at once, a share of the time for those who ask without pause, no limit while nothing trains."""

from __future__ import annotations

import pytest

from worker.pace import MAX_SAVED_S, MIN_USE, SHARE, RenderPace

VIEW_S = 0.05
ROUNDING_S = 1e-9


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def views_within(seconds: float, view_s: float, clock: Clock, pace: RenderPace) -> int:
    """How many are made by somebody who asks without pause."""
    end_s, made = clock.now_s + seconds, 0
    while clock.now_s < end_s:
        rest_s = pace.rest_s()
        clock.now_s += rest_s
        if rest_s < ROUNDING_S:
            clock.now_s += view_s
            pace.charge(view_s)
            made += 1
    return made


@pytest.mark.parametrize("view_s", [0.004, 0.05, 2.0])
def test_views_without_pause_take_their_share_of_the_time_and_what_was_saved(view_s: float) -> None:
    clock = Clock()
    pace, seconds = RenderPace(clock=clock), 100.0
    with pace.training():
        spent_s = view_s * views_within(seconds, view_s, clock, pace)
    assert spent_s == pytest.approx(SHARE * seconds + MAX_SAVED_S, abs=2 * view_s)


def test_a_lone_view_is_made_at_once_and_the_next_after_a_rest() -> None:
    clock = Clock()
    pace = RenderPace(clock=clock)
    with pace.training():
        for _ in range(3):
            assert pace.rest_s() == 0.0
            clock.now_s += MAX_SAVED_S + VIEW_S
            pace.charge(MAX_SAVED_S + VIEW_S)
            assert 0.0 < pace.rest_s() < VIEW_S / SHARE
            clock.now_s += (MAX_SAVED_S + VIEW_S) / SHARE


def test_a_debt_with_a_limit_is_paid_within_that_limit_however_long_a_view_took() -> None:
    clock = Clock()
    pace = RenderPace(clock=clock, max_debt_s=0.5 * SHARE)
    with pace.training():
        clock.now_s += 13.0
        pace.charge(13.0)
        assert pace.rest_s() == pytest.approx(0.5)
        clock.now_s += 0.5
        assert pace.rest_s() == pytest.approx(0.0, abs=1e-9)


def test_with_a_limited_debt_long_views_rest_as_long_as_it_allows() -> None:
    clock = Clock()
    pace = RenderPace(clock=clock, max_debt_s=0.5 * SHARE)
    with pace.training():
        assert views_within(100.0, 1.0, clock, pace) == pytest.approx(100 / 1.5, abs=2)


def test_renders_are_not_rationed_while_nothing_trains() -> None:
    clock = Clock()
    pace = RenderPace(clock=clock)
    with pace.training():
        views_within(1.0, VIEW_S, clock, pace)
    assert views_within(1.0, VIEW_S, clock, pace) == pytest.approx(1.0 / VIEW_S, abs=1)


def test_what_was_rendered_before_a_job_is_not_held_against_those_who_watch_it() -> None:
    clock = Clock()
    pace = RenderPace(clock=clock)
    views_within(5.0, VIEW_S, clock, pace)
    with pace.training():
        assert pace.rest_s() == 0.0


def test_rations_end_with_a_job_that_fails() -> None:
    clock = Clock()
    pace = RenderPace(clock=clock)

    def fail() -> None:
        with pace.training():
            pace.charge(10.0)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert pace.rest_s() == 0.0


def test_every_core_gives_its_share_and_waiting_for_one_costs_nothing() -> None:
    clock = Clock()
    pace = RenderPace(4, clock)
    assert pace.rate == 4
    with pace.training():
        assert pace.rate == pytest.approx(4 * SHARE)
        clock.now_s += 10.0
        pace.charge(0.05)  # of a render that waited for a core all the time
        assert pace.rest_s() == 0.0
        pace.charge(MAX_SAVED_S + 0.08)
        assert pace.rest_s() == pytest.approx(0.08 / (4 * SHARE))


def test_where_training_gets_less_of_the_cores_renders_do_too_but_never_nothing() -> None:
    clock, used_s = Clock(), [0.0]
    pace = RenderPace(2, clock, lambda: used_s[0])
    with pace.training():
        pace.charge(MAX_SAVED_S + 1.0)
        for _ in range(10):
            clock.now_s += 0.1
            used_s[0] += 0.1  # half of what two cores give
            pace.rest_s()
        assert pace.rest_s() == pytest.approx((1.0 - SHARE) / pace.rate)
        clock.now_s += 1.0
        assert pace.rest_s() == pytest.approx((1.0 - SHARE - 2 * MIN_USE * SHARE) / pace.rate)


def test_after_a_rest_one_large_view_can_be_made_in_full() -> None:
    clock = Clock()
    pace = RenderPace(clock=clock)
    with pace.training():
        assert pace.affords(MAX_SAVED_S)
        assert pace.affords(10 * MAX_SAVED_S)
        pace.charge(MAX_SAVED_S / 2)
        assert not pace.affords(10 * MAX_SAVED_S)
        assert pace.affords(MAX_SAVED_S / 3)
