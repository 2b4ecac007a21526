"""A feed of a small phantom: its states, its views of now and of the past, and what it goes through."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from intrasplat.errors import InputError
from intrasplat.live import model
from intrasplat.live.feed import Feed
from intrasplat.live.follow import Follower
from intrasplat.live.spec import SourceSpec
from intrasplat.live.state import FeedReason, FeedState, PastRange, StateClock
from intrasplat.live.times import FeedTime
from intrasplat.names import Detail
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.view.render import render_frame
from tests.live.conftest import FEED, Follow, phantom, until, until_known
from tests.live.senders import PhantomSender, Stream, in_real_time

ON: Detail = "on"
OFF: Detail = "off"


def test_a_feed_becomes_live_and_shows_the_newest_moment(followed: Follow, sender: PhantomSender) -> None:
    feed = followed()
    assert feed.report().state is FeedState.CONNECTING
    assert feed.moment() is None
    until(lambda: feed.report().state is FeedState.LIVE, feed.report)
    until_known(feed, 1.0)
    report, view = feed.report(), feed.moment()
    assert view is not None
    assert view.is_live
    assert not view.is_stale
    assert view.age_s < 1.5
    assert report.model is not None
    assert (report.model.width, report.model.height) == (128, 96)
    until(lambda: feed.report().numbers.used_fps > 2, feed.report)
    assert report.numbers.dropped > 10
    assert report.numbers.model_age_s == pytest.approx(view.age_s, abs=0.5)
    best_db = max(psnr_tissue(render_frame(view.scene, view.t).rgb, frame.left, frame.tissue) for frame in _frames())
    assert best_db > 22


def test_time_without_a_picture_is_no_time_without_a_scene(followed: Follow, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model, "NO_SCENE_S", 0.3)
    monkeypatch.setattr(model, "POLL_S", 0.05)
    feed, reasons, add = followed(), list[FeedReason | None](), Follower.add
    until_known(feed, 0.5)
    feed.pause()
    time.sleep(0.5)

    def watched(follower: Follower, *given: Any) -> Any:
        reasons.append(feed.report().reason)
        return add(follower, *given)

    monkeypatch.setattr(Follower, "add", watched)
    feed.resume()
    until(lambda: len(reasons) > 0)
    assert reasons[0] is not FeedReason.NO_SCENE


def test_a_model_that_ends_is_known_until_it_is_a_segment(followed: Follow, monkeypatch: pytest.MonkeyPatch) -> None:
    feed, seen, write_off = followed(), list[PastRange | None](), Follower.write_off
    until_known(feed, 0.5)
    feed.pause()
    known = feed.report().past

    def watched(follower: Follower) -> None:
        seen.append(feed.report().past)
        write_off(follower)
        seen.append(feed.report().past)

    monkeypatch.setattr(Follower, "write_off", watched)
    feed.close()
    assert seen == [known, known]


def test_the_newest_picture_is_that_of_the_source_and_counts_as_no_used_one(followed: Follow) -> None:
    feed = followed()
    until_known(feed, 1.0)
    before = feed.report().numbers
    pictures, late_s = [], []
    for _ in range(20):
        picture, view = feed.picture(), feed.moment()
        assert picture is not None
        assert view is not None
        late_s.append(picture.arrived_at - view.captured_at)
        pictures.append(picture)
        time.sleep(0.05)
    assert min(late_s) >= -0.2  # the model may take the next one between both
    assert pictures[0].left.shape == (96, 128, 3)
    assert len({each.sequence for each in pictures}) >= 8
    assert time.time() - pictures[-1].arrived_at < 0.5
    after = feed.report().numbers
    assert after.dropped > before.dropped
    feed.pause()
    paused = feed.picture()
    assert paused is not None
    assert feed.picture() is paused


@pytest.mark.parametrize("end", [Feed.pause, Feed.close])
def test_the_last_picture_is_there_after_the_end_though_nobody_looked_before(
    followed: Follow, end: Callable[[Feed], None]
) -> None:
    feed = followed()
    until_known(feed, 1.0)
    end(feed)
    picture, past = feed.picture(), feed.report().past
    assert picture is not None
    assert past is not None
    assert picture.arrived_at >= past.ends_at - 1e-3
    assert feed.picture() is picture


def test_a_picture_without_tissue_is_not_shown(followed: Follow, monkeypatch: pytest.MonkeyPatch) -> None:
    feed = followed()
    until_known(feed, 1.0)
    assert feed.picture() is not None
    assert feed._watch is not None
    monkeypatch.setattr(feed._watch, "is_out", True)
    assert feed.picture() is None


def _frames() -> Iterator[object]:
    return (phantom().frame(index) for index in range(24))


def test_every_way_to_name_a_moment_shows_the_same_one(followed: Follow) -> None:
    feed = followed(replace(FEED, keep_s=60.0))
    until_known(feed, 2.5)

    def is_shown_as_newest() -> bool:
        now = feed.moment(FeedTime.at(time.time()))
        return now is not None and (now.is_live, now.notices) == (True, ())

    until(is_shown_as_newest)
    feed.pause()
    live = feed.moment()
    assert live is not None
    ago = feed.moment(FeedTime.before_live(1.2))
    assert ago is not None
    for same in (FeedTime.of_source(live.source_s - 1.2), FeedTime.at(ago.captured_at)):
        shown = feed.moment(same)
        assert shown is not None
        assert shown.source_s == pytest.approx(ago.source_s, abs=0.02)
        assert not shown.is_live
        assert shown.notices == ()
    assert ago.source_s == pytest.approx(live.source_s - 1.2, abs=0.02)
    assert ago.captured_at == pytest.approx(live.captured_at - 1.2, abs=0.2)
    with pytest.raises(InputError) as refused:
        feed.moment(FeedTime.before_live(100.0))
    assert refused.value.field == "t"
    later = feed.moment(FeedTime.of_source(live.source_s + 30.0))
    assert later is not None
    assert later.source_s == live.source_s
    assert [each.code for each in later.notices] == ["time_in_gap"]


def test_a_feed_that_is_away_keeps_its_last_model_which_grows_old(followed: Follow) -> None:
    feed = followed(replace(FEED, max_age_s=0.4))
    until_known(feed, 0.5)
    feed.pause()
    time.sleep(1.6)
    report, view = feed.report(), feed.moment()
    assert (report.state, report.reason) == (FeedState.PAUSED, FeedReason.BY_HAND)
    assert view is not None
    assert view.is_stale
    assert report.numbers.model_age_s is not None
    assert report.numbers.model_age_s > 0.5
    known_s = view.source_s
    feed.resume()
    newer_s = feed.wait_for_newer(known_s, 15.0)
    assert newer_s is not None
    until(lambda: feed.report().state in (FeedState.LIVE, FeedState.BEHIND), feed.report)
    gap = feed.moment(FeedTime.of_source(known_s + 0.4))
    assert gap is not None
    assert [each.code for each in gap.notices] == ["time_in_gap"]
    assert gap.source_s == pytest.approx(known_s, abs=0.01) or gap.source_s >= newer_s - 0.5


def test_a_calibration_that_does_not_fit_is_a_clear_state(sender: PhantomSender) -> None:
    wrong = sender.calibration.model_copy(update={"width": 64, "height": 96})
    with Feed(SourceSpec(sender.url, layout="sbs"), wrong, FEED) as feed:
        until(lambda: feed.report().reason is FeedReason.CALIBRATION, feed.report)
        assert feed.report().state is FeedState.STALLED


def test_a_fault_of_the_follower_is_a_state_and_another_one_begins(
    followed: Follow, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = followed()
    until_known(feed, 0.5)
    add = Follower.add

    def fail(*_: object) -> None:
        raise RuntimeError("no more")

    monkeypatch.setattr(Follower, "add", fail)
    until(lambda: feed.report().reason is FeedReason.FAULT, feed.report)
    assert feed.report().state is FeedState.STALLED
    known = feed.moment()
    assert known is not None
    monkeypatch.setattr(Follower, "add", add)
    assert feed.wait_for_newer(known.source_s, 15.0) is not None
    until(lambda: feed.report().state in (FeedState.LIVE, FeedState.BEHIND), feed.report)


def test_the_past_is_there_again_after_a_restart(followed: Follow, tmp_path: Path) -> None:
    settings = replace(FEED, segments=tmp_path / "segments")
    feed = followed(settings)
    until_known(feed, 2.0)
    feed.close()
    before = feed.report().past
    assert before is not None
    again = followed(settings)
    there = again.report().past
    assert there is not None
    assert (there.begins_s, there.ends_s) == pytest.approx((before.begins_s, before.ends_s), abs=1e-4)
    assert there.ends_at == pytest.approx(before.ends_at, abs=1e-3)
    old, new = (each.moment(FeedTime.of_source(before.begins_s + 0.3)) for each in (feed, again))
    assert old is not None
    assert new is not None
    for detail, most in ((OFF, 0.1), (ON, 2.0)):  # it is stored as float16; recorded pictures are coded again
        first, other = (render_frame(each.scene, each.t, detail=detail).rgb.astype(int) for each in (old, new))
        assert np.abs(first - other).mean() <= most
    newer_s = again.wait_for_newer(before.ends_s, 15.0)
    assert newer_s is not None
    after = again.report().past
    assert after is not None
    assert after.ends_s - before.ends_s == pytest.approx(after.ends_at - before.ends_at, abs=0.5)
    assert again.report().numbers.stored_bytes > 1000


def test_a_pushed_stream_is_followed(sender: PhantomSender) -> None:
    with Feed(SourceSpec(None, layout="sbs"), sender.calibration, FEED) as feed:
        enough = threading.Event()
        pushing = threading.Thread(target=_push, args=(feed, sender, enough))
        pushing.start()
        known_s = feed.wait_for_newer(0.5, 15.0)
        enough.set()
        pushing.join()
        assert known_s is not None, feed.report()
        assert feed.report().model is not None


def _push(feed: Feed, sender: PhantomSender, enough: threading.Event) -> None:
    stream = Stream()
    for index in in_real_time():
        feed.write(stream.frame(sender.pictures[index % 20]))
        if enough.is_set():
            break
    feed.end_push()


def test_a_source_that_is_none_is_refused_and_leaves_nothing_behind(sender: PhantomSender, tmp_path: Path) -> None:
    before = threading.active_count()
    with pytest.raises(InputError):
        Feed(SourceSpec("ftp://nowhere"), sender.calibration, replace(FEED, segments=tmp_path))
    assert threading.active_count() == before


def test_the_last_state_that_was_found_is_that_of_now(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, later = StateClock(FeedState.CONNECTING), list[threading.Thread]()

    def interrupted() -> float:
        if not later:  # another thread finds the next state while this one notes the first
            later.append(threading.Thread(target=clock.since, args=(FeedState.STALLED, None)))
            later[0].start()
            later[0].join(0.1)
        return 1.0

    monkeypatch.setattr("intrasplat.live.state.time.time", interrupted)
    clock.since(FeedState.LIVE, None)
    later[0].join()
    assert clock._found[0] is FeedState.STALLED
