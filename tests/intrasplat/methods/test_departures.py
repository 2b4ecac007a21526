"""`fast` is `paper` with its departures, each of which changes something of its own; the page says what it is worth."""

from __future__ import annotations

import dataclasses
from itertools import chain

import pytest

from intrasplat.methods.fast import DEPARTURES, FAST
from intrasplat.methods.method import Departure, departing
from intrasplat.methods.paper import PAPER
from lab.benchmarks.bm_departures import (
    CSV,
    METHOD,
    OF_TWO_EYES,
    PAGE,
    UNMEASURED,
    clips_of,
    fast_without,
    gains_of,
    leaving_out,
    read,
    with_gains,
    with_table,
)

NAMES = [each.name for each in DEPARTURES]


def values_of(departure: Departure) -> set[str]:
    parts = {"fields": departure.fields, "rates": departure.rates, "loss": departure.loss}
    return {f"{part}.{name}" for part, values in parts.items() for name in values}


def test_fast_is_paper_with_all_departures_and_without_any_it_is_paper() -> None:
    assert departing(PAPER, DEPARTURES, "fast") == FAST
    assert departing(PAPER, (), "paper") == PAPER


@pytest.mark.parametrize("departure", DEPARTURES, ids=lambda departure: departure.name)
def test_a_departure_really_changes_the_preset(departure: Departure) -> None:
    without = fast_without(departure.name)
    assert without.name == f"fast without {departure.name}"
    assert dataclasses.replace(without, name="fast") != FAST
    for name, value in departure.fields.items():
        assert (getattr(FAST, name), getattr(without, name)) == (value, getattr(PAPER, name))
        assert value != getattr(PAPER, name)
    for name, value in departure.rates.items():
        assert (getattr(FAST.rates, name), getattr(without.rates, name)) == (value, getattr(PAPER.rates, name))
        assert value != getattr(PAPER.rates, name)
    for name, value in departure.loss.items():
        assert (getattr(FAST.loss, name), getattr(without.loss, name)) == (value, getattr(PAPER.loss, name))
        assert value != getattr(PAPER.loss, name)


def test_no_two_departures_set_one_value_or_have_one_name() -> None:
    values = [values_of(each) for each in DEPARTURES]
    assert all(values)
    assert len(set().union(*values)) == sum(len(each) for each in values)
    assert len({*NAMES}) == len(NAMES)


def test_what_a_departure_needs_stands_above_it() -> None:
    for place, departure in enumerate(DEPARTURES):
        assert {*departure.needs} <= {*NAMES[:place]}


def test_what_needs_a_departure_goes_with_it() -> None:
    left = [each.name for each in leaving_out(DEPARTURES, "no densification")]
    assert {*NAMES} - {*left} == {"no densification", "warm restarts and averages", "early stopping"}
    with pytest.raises(KeyError):
        fast_without("magic")


def test_the_page_and_the_comments_of_fast_say_what_the_rows_say() -> None:
    rows = read(CSV)
    assert with_table(PAGE.read_text(), rows) == PAGE.read_text(), "run python -m lab.benchmarks.bm_departures"
    assert with_gains(METHOD.read_text(), rows) == METHOD.read_text(), "run python -m lab.benchmarks.bm_departures"
    page = PAGE.read_text()
    assert [name for name in NAMES if f"| {name} |" not in page] == [*UNMEASURED]


def test_every_departure_is_measured_on_two_clips_and_those_of_two_eyes_on_one() -> None:
    rows = read(CSV)
    measured = list(chain.from_iterable(gains_of(rows, clip) for clip in clips_of(rows)))
    wanted = {name: 1 if name in OF_TWO_EYES else 2 for name in NAMES if name not in UNMEASURED}
    assert {name: measured.count(name) for name in wanted} == wanted
