"""The scheduler: which part of which answer is made when, at what detail, and what it costs the pace."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from contract.wire.rendering import RenderRequest
from intrasplat.machine.parts import Parts
from intrasplat.picture import ImageFormat
from worker.pace import MAX_SAVED_S, SHARE, RenderPace
from worker.reply import Reply
from worker.request_queue import FIRST_SPEEDS
from worker.scheduler import MIN_CHARGE_S, Answered, Scheduler

SCENE = "0" * 32
PART_S = 1.0
"""CPU seconds of a part."""
CALLER = b"caller"


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Studio:
    """A scheduler whose answers take their t in CPU seconds, PART_S in each part.

    made: t of each part, in the order in which they were made. left: t of each answer that ended, made or abandoned.
    """

    def __init__(self, pace: RenderPace | None = None, **settings: Any) -> None:
        self.pace = pace or RenderPace(clock=Clock())
        settings |= {
            "cost": lambda request: request.t * FIRST_SPEEDS[0],
            "within": self.within,
            "spent_s": lambda: self.cpu_s,
        }
        self.scheduler = Scheduler(self.answer, self.pace, **settings)
        self.cpu_s = 0.0
        self.made, self.left, self.levels = list[float](), list[float](), list[int]()
        self.parts_under_way = 0

    @contextmanager
    def within(self) -> Iterator[None]:
        assert self.parts_under_way == 0, "a part was begun inside another"
        self.parts_under_way += 1
        try:
            yield
        finally:
            self.parts_under_way -= 1

    def answer(self, request: Any, level: int) -> Parts[Reply]:
        left_s = request.t
        self.levels.append(level)
        try:
            while left_s > 0:
                if request.t == 3:
                    raise ZeroDivisionError
                assert self.parts_under_way == 1
                self.cpu_s += min(left_s, PART_S)
                self.made.append(request.t)
                left_s -= PART_S
                if left_s > 0:
                    yield
        finally:
            self.left.append(request.t)
        return Reply(b"picture", "image/png", request.t)

    def ask(self, *times: float, number: int = 0, image_format: ImageFormat = ImageFormat.JPEG) -> float | None:
        """Ask for each; the last one's refusal."""
        refused = None
        for t in times:
            request = RenderRequest(scene_id=SCENE, t=t, format=image_format)
            refused = self.scheduler.take_in(CALLER, str(number or t).encode(), request)
        return refused

    def finish(self) -> list[float]:
        """Make every part that may be made now; t of each answer, as they came."""
        answered: list[Answered] = []
        while self.scheduler.rest_s() == 0.0:
            if (each := self.scheduler.advance()) is not None:
                answered.append(each)
        return [each.requests[0].request.t for each in answered if isinstance(each.requests[0].request, RenderRequest)]


def test_an_answer_is_made_part_by_part() -> None:
    studio = Studio()
    studio.ask(2.5)
    assert [studio.scheduler.advance() for _ in range(2)] == [None, None]
    answered = studio.scheduler.advance()
    assert answered is not None
    assert isinstance(answered.outcome, Reply)
    assert [each.request_id for each in answered.requests] == [b"2.5"]
    assert studio.scheduler.advance() is None
    assert studio.made == [2.5, 2.5, 2.5]


def test_small_answers_come_between_the_parts_of_a_large_one_and_take_as_long_as_its_last_part() -> None:
    studio = Studio()
    studio.ask(4.0)
    studio.scheduler.advance()
    for number in range(1, 6):
        studio.ask(0.5 + number / 64, number=number)
    studio.finish()
    small = [round(t - 0.5) == 0 for t in studio.made]
    assert small == [False, True, True, False, True, True, False, True, False]


def test_an_answer_that_is_not_small_waits_for_the_one_that_was_begun() -> None:
    studio = Studio()
    studio.ask(4.0)
    studio.scheduler.advance()
    studio.ask(2.0)
    assert studio.finish() == [4.0, 2.0]
    assert studio.made == [4.0] * 4 + [2.0] * 2


def test_what_is_small_beside_a_small_answer_comes_between_the_parts_of_that_one() -> None:
    studio = Studio()
    studio.ask(40.0)
    studio.scheduler.advance()
    studio.ask(5.0)
    studio.scheduler.advance()
    studio.ask(0.25)
    assert studio.finish() == [0.25, 5.0, 40.0]
    assert studio.made[:5] == [40.0, 5.0, 0.25, 5.0, 5.0]


def test_what_its_caller_gives_up_is_abandoned_between_two_parts_or_never_begun() -> None:
    studio = Studio()
    studio.ask(40.0)
    studio.scheduler.advance()
    studio.ask(8.0, 9.0)
    studio.scheduler.advance()
    for given_up in (b"40.0", b"9.0", b"never asked"):
        studio.scheduler.give_up(CALLER, given_up)
    studio.scheduler.give_up(b"another caller", b"8.0")
    assert studio.left == [40.0]
    assert studio.finish() == [8.0]
    assert studio.made == [40.0] + [8.0] * 8


def test_an_error_in_any_part_is_what_the_answer_comes_to_and_the_next_is_made() -> None:
    studio = Studio()
    studio.ask(3.0)
    answered = studio.scheduler.advance()
    assert answered is not None
    assert isinstance(answered.outcome, ZeroDivisionError)
    studio.ask(1.0)
    assert studio.finish() == [1.0]


def test_who_asks_the_same_while_it_is_made_shares_the_answer() -> None:
    studio = Studio()
    studio.ask(2.0, number=1)
    studio.scheduler.advance()
    studio.ask(2.0, number=2)
    answered = studio.scheduler.advance()
    assert answered is not None
    assert [each.request_id for each in answered.requests] == [b"1", b"2"]
    assert studio.scheduler.rest_s() > 1e9


def test_each_part_is_charged_when_it_is_made_and_the_next_waits_until_the_debt_is_paid() -> None:
    clock = Clock()
    studio = Studio(RenderPace(clock=clock))
    with studio.pace.training():
        studio.ask(1.5, image_format=ImageFormat.PNG)
        assert studio.scheduler.advance() is None
        assert studio.scheduler.rest_s() == pytest.approx((PART_S - MAX_SAVED_S) / SHARE)
        studio.scheduler.advance()
        assert studio.made == [1.5]
        clock.now_s += (PART_S - MAX_SAVED_S) / SHARE + 1e-6
        assert studio.scheduler.advance() is not None
        assert studio.pace.rest_s() == pytest.approx(0.5 / SHARE, rel=1e-3)
        assert studio.made == [1.5, 1.5]


def test_an_answer_that_costs_nothing_is_charged_the_least_once_for_each_caller() -> None:
    clock = Clock()
    studio = Studio(RenderPace(clock=clock))
    with studio.pace.training():
        studio.ask(0.0, number=1)
        studio.ask(0.0, number=2)
        studio.pace.charge(MAX_SAVED_S)
        studio.finish()
        assert studio.pace.rest_s() == pytest.approx(2 * MIN_CHARGE_S / SHARE)


def test_a_small_answer_that_is_made_between_parts_waits_for_the_pace_too() -> None:
    clock = Clock()
    studio = Studio(RenderPace(clock=clock))
    with studio.pace.training():
        studio.ask(4.0)
        studio.scheduler.advance()
        studio.ask(0.25)
        assert studio.finish() == []
        clock.now_s += PART_S / SHARE
        assert studio.finish() == [0.25]


def test_whose_turn_is_too_far_off_is_refused_and_small_answers_are_not() -> None:
    studio = Studio(max_wait_s=10.0)
    assert studio.ask(8.0) is None
    studio.scheduler.advance()
    assert studio.ask(7.0) is None
    assert studio.ask(7.5) == pytest.approx(14.0)
    assert studio.ask(0.5) is None


@pytest.mark.parametrize(("others", "level"), [(0, 0), (2, 1), (12, 2)])
def test_the_more_wait_beside_training_the_coarser_they_are_drawn(others: int, level: int) -> None:
    studio = Studio()
    seconds = 0.5 * MAX_SAVED_S
    with studio.pace.training():
        for number in range(1 + others):
            studio.ask(seconds + number * 1e-6)
        studio.scheduler.advance()
    assert studio.levels == [level]


def test_exact_formats_are_never_coarse_and_nothing_is_while_no_job_trains() -> None:
    studio = Studio()
    studio.ask(*(0.05 + number * 1e-6 for number in range(12)))
    studio.scheduler.advance()
    with studio.pace.training():
        studio.ask(0.01, image_format=ImageFormat.PNG)
        while 0.01 not in studio.made:
            studio.scheduler.advance()
    assert studio.levels[0] == studio.levels[studio.made.index(0.01)] == 0


def test_the_end_abandons_what_was_begun() -> None:
    studio = Studio()
    studio.ask(40.0)
    studio.scheduler.advance()
    studio.ask(4.0)
    studio.scheduler.advance()
    studio.scheduler.close()
    assert studio.left == [4.0, 40.0]
