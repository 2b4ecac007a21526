"""The moments of a feed that a caller's t names."""

from __future__ import annotations

import pytest

from contract.wire.feeds import FeedOptions, FeedRecord, FeedReport, FeedTime, FeedView, feed_time
from intrasplat.errors import InputError
from intrasplat.live.state import FeedReason, FeedState

RECORD = FeedRecord(
    feed_id="0" * 32,
    options=FeedOptions(source="rtsp://user:secret@camera/1", label="room 4"),
    calibration="{}",
    calibration_name="calibration.json",
    created_at_s=10.0,
    owner="worker-1.a",
    report=FeedReport(state=FeedState.STALLED, reason=FeedReason.SILENT, since_s=90.0, model_age_s=3.0, used_fps=2.0),
    reported_at_s=100.0,
)


def test_a_view_ages_and_shows_no_password() -> None:
    view = FeedView.of(RECORD, 104.5)
    assert (view.id, view.label, view.state, view.reason) == ("0" * 32, "room 4", FeedState.STALLED, FeedReason.SILENT)
    assert view.model_age_s == 7.5
    assert view.options.source == "rtsp://camera/1"
    assert "secret" not in view.model_dump_json()


def test_a_feed_that_nobody_follows_says_so() -> None:
    view = FeedView.of(RECORD.model_copy(update={"owner": None}), 105.0)
    assert (view.state, view.reason, view.since_s) == (FeedState.CONNECTING, FeedReason.NO_WORKER, 100.0)
    assert (view.used_fps, view.model_age_s) == (0.0, 8.0)
    fresh = RECORD.model_copy(update={"owner": None, "report": None, "reported_at_s": None})
    assert FeedView.of(fresh, 11.0).since_s == 10.0


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("live", FeedTime(before_live_s=0)),
        ("-12.5", FeedTime(before_live_s=12.5)),
        ("31.4", FeedTime(source_s=31.4)),
        ("0", FeedTime(source_s=0)),
        ("1970-01-01T00:01:00Z", FeedTime(at_s=60)),
        ("1970-01-01T01:01:00.5+01:00", FeedTime(at_s=60.5)),
    ],
)
def test_a_moment_is_live_seconds_or_a_time(text: str, time: FeedTime) -> None:
    assert feed_time(text) == time


@pytest.mark.parametrize("text", ["", "now", "nan", "1e9", "-9999999", "2026-05-04T10:20:30", "1960-01-01T00:00:00Z"])
def test_other_texts_are_refused_with_a_remedy(text: str) -> None:
    with pytest.raises(InputError) as refused:
        feed_time(text)
    assert refused.value.field == "t"
    assert "live" in refused.value.remedy
