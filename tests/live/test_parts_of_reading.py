"""The clock of a feed, the choice of what is not decoded, the matching of two streams."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import av
import numpy as np
import pytest

from intrasplat.live.clock import SourceClock, Waited
from intrasplat.live.decoding import LATE_S, SLOW_S, LagPolicy, Skip
from intrasplat.live.matching import Matcher
from intrasplat.live.reading import Arrived

STEP_S = 1 / 30


def test_a_clock_begins_at_its_start_and_keeps_gaps() -> None:
    clock = SourceClock(7.0)
    times_s = [clock.place(stamp_s, 1000.0 + stamp_s).offset_s + stamp_s for stamp_s in (100.0, 100.1, 109.0)]
    assert times_s == pytest.approx([7.0, 7.1, 16.0])


def test_a_burst_after_a_break_is_no_jump() -> None:
    clock = SourceClock(0.0)
    places = [clock.place(STEP_S * index, 1000.0 + (5.0 if index > 30 else 0.0)) for index in range(200)]
    assert {place.epoch for place in places} == {0}


@pytest.mark.parametrize("jump_s", [-3600.0, -0.1, 3600.0])
def test_a_jump_begins_an_epoch_at_the_present(jump_s: float) -> None:
    clock = SourceClock(0.0)
    clock.place(5000.0, 1000.0)
    place = clock.place(5000.0 + jump_s, 1000.5)
    assert place.epoch == 1
    assert place.offset_s + 5000.0 + jump_s == pytest.approx(0.5)


def test_streams_that_take_turns_do_not_jump() -> None:
    clock = SourceClock(0.0, streams=2)
    stamps_s = [each for index in range(30) for each in (index * STEP_S, index * STEP_S - 0.2)]
    assert {clock.place(stamp_s, 1000.0 + stamp_s).epoch for stamp_s in stamps_s} == {0}


def packet_at(stamp_s: float, arrived_at: float) -> Arrived:
    packet: av.Packet[Any] = av.Packet(b"packet")
    packet.time_base, packet.pts = Fraction(1, 1000), round(1000 * stamp_s)
    return Arrived(packet, 0, arrived_at, "h264")


def test_packets_that_came_in_while_the_process_started_are_dated_by_their_stamps() -> None:
    waited = Waited(connected_at=1000.0, ready_at=1000.6)
    dated = [waited.dated(packet_at(7.0 + 0.1 * index, 1000.65)).arrived_at for index in range(9)]
    assert dated == pytest.approx([1000.0, 1000.1, 1000.2, 1000.3, 1000.4, 1000.5, 1000.6, 1000.65, 1000.65])


def test_packets_that_come_later_are_dated_as_they_come() -> None:
    waited = Waited(connected_at=1000.0, ready_at=1000.6)
    assert waited.dated(packet_at(7.0, 1002.0)).arrived_at == 1002.0
    assert waited.dated(packet_at(7.1, 1003.0)).arrived_at == 1003.0
    jumping = Waited(connected_at=1000.0, ready_at=1000.6)
    assert jumping.dated(packet_at(7.0, 1000.6)).arrived_at == 1000.0
    assert jumping.dated(packet_at(2.0, 1000.6)).arrived_at == 1000.6


def test_decoding_begins_at_a_key_frame_and_skips_more_the_longer_it_lags() -> None:
    policy = LagPolicy()
    assert policy.choose(0.0, is_key=False, newer_key=False) is Skip.ALL
    assert policy.choose(0.0, is_key=True, newer_key=False) is Skip.NOTHING
    assert policy.choose(0.0, is_key=False, newer_key=False) is Skip.NOTHING
    assert policy.choose(1.1 * SLOW_S, is_key=False, newer_key=False) is Skip.UNREFERENCED
    assert policy.choose(1.1 * LATE_S, is_key=False, newer_key=True) is Skip.ALL
    assert policy.choose(0.0, is_key=False, newer_key=False) is Skip.ALL
    assert policy.choose(1.1 * LATE_S, is_key=True, newer_key=True) is Skip.ALL
    assert policy.choose(1.1 * LATE_S, is_key=True, newer_key=False) is Skip.UNREFERENCED
    assert policy.choose(0.0, is_key=False, newer_key=False) is Skip.NOTHING


@pytest.mark.parametrize("decode_s", [0.02, 0.05, 0.4])
@pytest.mark.parametrize("gop", [1, 15])
def test_the_lag_does_not_grow_however_slow_decoding_is(decode_s: float, gop: int) -> None:
    policy, now_s, lags_s, index = LagPolicy(), 0.0, [], 0
    decoded = 0
    while index < 3000:
        arrived_s = index * STEP_S
        now_s = max(now_s, arrived_s)
        waiting = range(index + 1, int(now_s / STEP_S) + 1)
        skip = policy.choose(now_s - arrived_s, index % gop == 0, any(each % gop == 0 for each in waiting))
        if skip is not Skip.ALL:
            now_s += decode_s
            decoded += 1
            lags_s.append(now_s - arrived_s)
        index += 1
    assert max(lags_s) < LATE_S + gop * STEP_S + 2 * decode_s
    assert np.mean(lags_s[-20:]) < LATE_S + 2 * decode_s
    assert decoded * max(decode_s, STEP_S) > 0.3 * 100.0


def test_frames_are_matched_by_time_whatever_is_lost() -> None:
    matcher: Matcher[str] = Matcher()
    pairs = []
    for index in range(60):
        for stream, offset_s in ((0, 0.0), (1, 0.003)):
            if (stream, index) in {(0, 10), (1, 20), (1, 21), (0, 40)}:
                continue
            pair = matcher.add(stream, index * STEP_S + offset_s, f"{index}")
            pairs += [pair] if pair else []
    assert len(pairs) == 56
    assert all(left == right for _, left, right in pairs)
    assert [time_s for time_s, *_ in pairs] == sorted(time_s for time_s, *_ in pairs)


def test_a_stream_without_a_partner_waits_in_bounded_memory() -> None:
    matcher: Matcher[int] = Matcher()
    for index in range(1000):
        assert matcher.add(0, index * STEP_S, index) is None
    assert matcher.add(1, 999 * STEP_S, 999) == (999 * STEP_S, 999, 999)
    assert matcher.waiting == (0, 0)
