"""The moments of a feed that a caller's t names."""

from __future__ import annotations

from contract.wire.feeds import FeedOptions, FeedRecord, FeedReport, FeedView
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
