"""Which frames of a damaged video are sound, and what stands in for the others.

A decoder conceals damage: it repeats or guesses what is missing, and every frame that refers to the result is wrong,
too, until the next keyframe.

Symbols: T frames, D decoded frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

MAX_MISSING = 0.3
"""If a larger share of frames is missing and the decoder complains of nothing, packets are fields."""


@dataclass(frozen=True)
class Sample:
    """A packet of the video in the order of decoding. time: of its picture, in units of the stream."""

    time: int | None
    is_keyframe: bool
    is_hidden: bool  # outside of the edit list


@dataclass
class PacketLog:
    """What one pass over a video met."""

    samples: list[Sample] = field(default_factory=list)
    failures: int = 0
    """Packets that the decoder refused."""


@dataclass(frozen=True)
class Shown:
    """The frames of a video in order of display, with places for frames that the decoder did not give.

    times     [T] time stamps in units of the stream; None: unknown
    sources   [T] number of the decoded frame to show: itself, or for a damaged one the nearest sound frame before it,
              at the start the first one; rising
    damaged   indices of damaged and missing frames
    """

    times: tuple[int | None, ...]
    sources: tuple[int, ...]
    damaged: tuple[int, ...] = ()


def frames_to_show(
    times: Sequence[int | None], corrupt: Sequence[int], log: PacketLog, *, one_to_one: bool = True
) -> Shown:
    """What to show of D decoded frames.

    Args:
        times: [D] in order of display.
        corrupt: numbers of the decoded frames that the decoder marks as damaged.
        log: the packets of the same pass.
        one_to_one: whether each packet of a sound video is a frame.
    """
    stamps = [time for time in times if time is not None]
    packed = [sample.time for sample in log.samples if sample.time is not None and not sample.is_hidden]
    numbers = {time: index for index, time in enumerate(stamps)}
    is_rising = all(one < two for one, two in pairwise(stamps))
    if len(stamps) < len(times) or not is_rising or not numbers.keys() <= set(packed):
        first = min(corrupt, default=len(times))
        return _shown(times, [index if index < first else None for index in range(len(times))])
    missing = set(packed) - numbers.keys()
    if not log.failures and not corrupt:  # frames at the ends are missing in sound videos that were cut
        missing = {time for time in missing if one_to_one and stamps[0] < time < stamps[-1]}
        missing = missing if len(missing) <= MAX_MISSING * len(packed) else set()
    unreliable = _unreliable(log, {stamps[index] for index in corrupt} | missing)
    places = sorted(numbers.keys() | missing)
    return _shown(places, [None if time in unreliable else numbers[time] for time in places])


def _unreliable(log: PacketLog, bad: set[int]) -> set[int]:
    """The bad frames, and all that may refer to one: up to the next keyframe, and those shown before that one."""
    unreliable, broken, leading_broken, key_time = set(bad), False, False, 0
    for sample in log.samples:
        if sample.time is None:
            continue
        if sample.is_keyframe:
            leading_broken, broken, key_time = broken, sample.time in bad, sample.time
        broken |= sample.time in bad
        if not sample.is_keyframe and (broken or (leading_broken and sample.time < key_time)):
            unreliable.add(sample.time)
    return unreliable


def _shown(times: Sequence[int | None], own: Sequence[int | None]) -> Shown:
    last = next((each for each in own if each is not None), 0)
    sources = []
    for each in own:
        last = last if each is None else each
        sources.append(last)
    return Shown(tuple(times), tuple(sources), tuple(index for index, each in enumerate(own) if each is None))
