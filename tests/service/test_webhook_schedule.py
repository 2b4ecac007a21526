"""When a webhook is tried again: as the documentation has it, and not before its receiver wants it."""

from __future__ import annotations

import re
import time
from datetime import UTC, datetime
from email.utils import format_datetime
from itertools import accumulate
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.webhooks import FIRST_WAIT_S, JITTER, MAX_TRIES, MAX_WAIT_S, WAIT_GROWS, asked_wait_s, wait_after
from tests.receiver import Receiver
from tests.service.telling import cancelled, log_of, telling
from tests.test_operations import PAGE

LONG_S = 7200
UNITS_S = {"s": 1, "min": 60, "h": 3600}


def seconds(text: str) -> float:
    """Of a duration as the documentation writes it, such as 1 h 25 min 20 s."""
    return sum(int(count) * UNITS_S[unit] for count, unit in re.findall(r"(\d+) (h|min|s)\b", text))


def test_the_documented_schedule_is_the_one_that_is_kept() -> None:
    rows = re.findall(r"^\| (\d+) \| ([\w ]+) \| ([\w ]+) \|$", PAGE, re.MULTILINE)
    waits_s = [min(FIRST_WAIT_S * WAIT_GROWS**number, MAX_WAIT_S) for number in range(MAX_TRIES - 1)]
    assert [int(number) for number, _, _ in rows] == list(range(1, MAX_TRIES + 1))
    assert [seconds(wait) for _, wait, _ in rows] == [0.0, *waits_s]
    assert [seconds(since) for _, _, since in rows] == [0.0, *accumulate(waits_s)]
    ends = re.search(
        r"given up ([\w ]+) to ([\w ]+) after the job's end; with `Retry-After`, after at most (\d+ h)", PAGE
    )
    assert ends is not None
    bounds_s = [sum(waits_s) * (1 - JITTER), sum(waits_s) * (1 + JITTER), len(waits_s) * MAX_WAIT_S * (1 + JITTER)]
    assert [seconds(each) for each in ends.groups()] == pytest.approx(bounds_s, abs=60.0)


def test_waits_differ_by_a_fifth_at_most_and_are_no_shorter_than_a_receiver_asked() -> None:
    for tries in range(1, MAX_TRIES):
        planned_s = min(FIRST_WAIT_S * WAIT_GROWS ** (tries - 1), MAX_WAIT_S)
        waits_s = [wait_after(tries) for _ in range(99)]
        assert planned_s * (1 - JITTER) <= min(waits_s) < max(waits_s) <= planned_s * (1 + JITTER)
        asked_s = [wait_after(tries, 60.0) for _ in range(99)]
        assert max(planned_s * (1 - JITTER), 60.0) <= min(asked_s)
        assert max(asked_s) <= max(planned_s, 60.0) * (1 + JITTER)


@pytest.mark.parametrize(
    ("text", "wait_s"),
    [
        ("120", 120.0),
        ("0", 0.0),
        ("9" * 5000, MAX_WAIT_S),
        ("Wed, 21 Oct 2015 07:28:00 GMT", 0.0),
        ("Wed Oct 21 07:28:00 2015", 0.0),
        ("Thu, 31 Dec 9999 23:59:59 GMT", MAX_WAIT_S),
        ("-1", None),
        ("1.5", None),
        ("soon", None),
        ("", None),
        ("Wed, 99 Oct 2065 07:28:00 GMT", None),
        ("Wed, 21 Oct 99999999999 07:28:00 GMT", None),
        ("Wed, 21 Oct 2065 07:28:00 +99999999", None),
    ],
)
def test_what_a_receiver_asks_for_is_read_or_passed_over(text: str, wait_s: float | None) -> None:
    for status in (429, 503):
        assert asked_wait_s(httpx.Response(status, headers={"Retry-After": text}), MAX_WAIT_S) == wait_s
    assert asked_wait_s(httpx.Response(500, headers={"Retry-After": text}), MAX_WAIT_S) is None


def failed_once(folder: Path, status: int, retry_after: str) -> tuple[dict[str, Any], float]:
    """The first try of a webhook whose receiver answered so, and when the next is due."""
    with Receiver(status, retry_after=retry_after) as receiver, telling(receiver, folder) as service:
        delivery = log_of(service, cancelled(service, f"{receiver.origin}/"), lambda delivery: bool(delivery["tries"]))
        return delivery["tries"][0], delivery["next_try_at_s"]


@pytest.mark.parametrize("status", [429, 503])
def test_a_receiver_that_asks_for_seconds_is_left_alone_for_as_long(tmp_path: Path, status: int) -> None:
    tried, next_s = failed_once(tmp_path, status, str(LONG_S))
    assert (tried["failure"], tried["status_code"], tried["retry_after_s"]) == ("status", status, LONG_S)
    assert next_s >= tried["at_s"] + LONG_S


def test_a_receiver_that_names_a_time_is_left_alone_until_then(tmp_path: Path) -> None:
    until_s = int(time.time()) + LONG_S
    tried, next_s = failed_once(tmp_path, 503, format_datetime(datetime.fromtimestamp(until_s, UTC), usegmt=True))
    assert 0 < tried["retry_after_s"] <= LONG_S
    assert next_s >= until_s


def test_a_receiver_that_asks_for_days_is_tried_after_hours_and_one_that_fails_has_nothing_to_ask(
    tmp_path: Path,
) -> None:
    tried, next_s = failed_once(tmp_path / "days", 503, str(99 * 86400))
    assert tried["retry_after_s"] == MAX_WAIT_S
    assert next_s < tried["at_s"] + 86400
    tried, next_s = failed_once(tmp_path / "fails", 500, str(LONG_S))
    assert tried["retry_after_s"] is None
    assert next_s < tried["at_s"] + LONG_S
