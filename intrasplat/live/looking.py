"""Where a feed's time lies in what its model knows: the window's scene, or a segment of the past."""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from intrasplat.errors import InputError
from intrasplat.live.past import Past
from intrasplat.live.past_segment import PastSegment, arrivals
from intrasplat.live.state import PastRange
from intrasplat.live.times import FIELD, LIVE, FeedTime, FeedTimeKind
from intrasplat.notices import Notice, NoticeCode
from intrasplat.scene.scene import TrainedScene

MAX_STEP_S = 1.0
"""Between used frames that are farther apart nothing is known: the nearest one is shown."""
TOLERANCE_S = 0.05
"""A moment that is shown in place of one that is so near needs no notice."""
FUTURE_S = 60.0
"""A caller's clock may be so far ahead: a time beyond that is in the future."""
WINDOW = -1
"""Number of what the window covers, which is no segment yet."""
Axis = Literal["source_s", "arrived_at"]


@dataclass(frozen=True, eq=False)
class FeedMoment:
    """A moment of a feed, to be rendered.

    scene, t     the scene and its model time
    source_s     the moment, in seconds of the source's clock
    captured_at  UNIX time, s, at which it came in
    age_s        from then until now
    is_live      whether it is the newest moment that the model knows
    is_stale     whether it is, and is older than the feed's greatest age
    notices      time_in_gap: another moment than that which was asked for is shown, the nearest one that is known
    """

    scene: TrainedScene
    t: float
    source_s: float
    captured_at: float
    age_s: float
    is_live: bool
    is_stale: bool
    notices: tuple[Notice, ...] = ()


def range_of(window: PastSegment | None, past: Past) -> PastRange | None:
    """What can be looked at; None: nothing. window: what the newest frames cover."""
    spans = _spans(window, past)
    if not spans:
        return None
    first, last = spans[0], spans[-1]
    return PastRange(first.source_s[0], last.source_s[1], first.arrived_at[0], last.arrived_at[1])


def find_moment(
    asked: FeedTime, window: TrainedScene | None, past: Past, max_age_s: float, *, goes_on: bool = False
) -> FeedMoment | None:
    """The moment of a time; None: nothing is known yet.

    goes_on: whether the model learns what comes in. Then a time after the newest moment gives that moment without a
    notice, if it is at most max_age_s old: the time will be known soon.

    Raises:
        InputError: the time lies before the past that is stored, or in the future.
    """
    newest = None if window is None else PastSegment.of(WINDOW, window)
    while spans := _spans(newest, past):
        newest_s = spans[-1].source_s[1]
        axis: Axis = "arrived_at" if asked.kind is FeedTimeKind.UNIX else "source_s"
        wanted = {FeedTimeKind.LIVE: newest_s, FeedTimeKind.BEFORE_LIVE: newest_s - asked.seconds}.get(
            asked.kind, asked.seconds
        )
        begins = getattr(spans[0], axis)[0]
        if wanted < begins - TOLERANCE_S:
            raise _outside("it lies before the past that is stored.", asked, spans)
        passed_s = max(0.0, time.time() - spans[-1].arrived_at[1])
        if wanted - getattr(spans[-1], axis)[1] > passed_s + FUTURE_S:
            raise _outside("it lies in the future.", asked, spans)
        chosen = _chosen(spans, axis, wanted)
        scene = window if chosen is newest else past.load(chosen)
        if scene is not None:
            return _moment(asked, scene, axis, wanted, newest_s, max_age_s, goes_on)
    return None


def _spans(window: PastSegment | None, past: Past) -> list[PastSegment]:
    """What each scene covers, oldest first."""
    spans = [*past.segments()]
    if window is not None and (not spans or spans[-1].source_s[1] < window.source_s[1]):
        spans.append(window)
    return spans


def _chosen(spans: list[PastSegment], axis: Axis, wanted: float) -> PastSegment:
    """The newest span that begins before a time, or the next one if that is nearer."""
    before = max((i for i, span in enumerate(spans) if getattr(span, axis)[0] <= wanted), default=0)
    after = min(before + 1, len(spans) - 1)
    ends, begins = getattr(spans[before], axis)[1], getattr(spans[after], axis)[0]
    return spans[after] if wanted > ends and begins - wanted < wanted - ends else spans[before]


def _moment(
    asked: FeedTime, scene: TrainedScene, axis: Axis, wanted: float, newest_s: float, max_age_s: float, goes_on: bool
) -> FeedMoment:
    times = {"source_s": np.asarray(scene.frame_times_s), "arrived_at": arrivals(scene)}
    frames, along = np.arange(scene.frame_count), times[axis]
    place = float(np.interp(wanted, along, frames))
    before = min(int(place), scene.frame_count - 1)
    after = min(before + 1, scene.frame_count - 1)
    if times["source_s"][after] - times["source_s"][before] > MAX_STEP_S:
        place = float(before if wanted - along[before] < along[after] - wanted else after)
    shown, source_s, captured_at = (float(np.interp(place, frames, each)) for each in (along, *times.values()))
    age_s, is_live = time.time() - captured_at, source_s >= newest_s
    off_s, notices = abs(shown - wanted), tuple[Notice, ...]()
    is_to_come = goes_on and is_live and age_s <= max_age_s and wanted > shown and off_s <= age_s + TOLERANCE_S
    if off_s > TOLERANCE_S and asked != LIVE and not is_to_come:
        text = f"Nothing is known of this moment: the nearest one is shown, {off_s:.1f} s {_side(shown, wanted)} it."
        notices = (Notice.warning(NoticeCode.TIME_IN_GAP, text),)
    t = place / scene.frame_count
    return FeedMoment(scene, t, source_s, captured_at, age_s, is_live, is_live and age_s > max_age_s, notices)


def _side(shown: float, wanted: float) -> str:
    return "before" if shown < wanted else "after"


def _outside(problem: str, asked: FeedTime, spans: list[PastSegment]) -> InputError:
    first, last = spans[0], spans[-1]
    if asked.kind is FeedTimeKind.UNIX:
        remedy = f"Ask for a time from {_utc(first.arrived_at[0])} to {_utc(last.arrived_at[1])}."
    elif asked.kind is FeedTimeKind.BEFORE_LIVE:
        remedy = f"Ask for -{last.source_s[1] - first.source_s[0]:.1f} to live."
    else:
        remedy = f"Ask for {first.source_s[0]:.1f} to {last.source_s[1]:.1f} s of the source."
    return InputError(FIELD, problem, remedy)


def _utc(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds")
