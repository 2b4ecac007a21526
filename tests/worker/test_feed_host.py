"""The supervisor's side of live feeds, with processes that need no torch."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from contract.queue.feeds import FeedClaim
from contract.wire.feeds import FeedRecord, FeedReport, FeedWish
from intrasplat.errors import UnavailableError
from intrasplat.intake.limits import MAX_CALIBRATION_BYTES
from intrasplat.live.state import FeedReason, FeedState
from tests.worker.feeds import FEED_STANDIN, Hosted, eventually, feed_record
from worker import feed_child, feed_process
from worker.feed_child import FeedChild
from worker.feed_orders import WishFeed
from worker.feeds import endpoints_of, following
from worker.orders import line_of

Start = Callable[..., Hosted]


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Start]:
    """Starts a host."""
    with ExitStack() as stack:

        def start(**settings: object) -> Hosted:
            hosted = Hosted(tmp_path, command=FEED_STANDIN, **settings)  # type: ignore[arg-type]
            stack.enter_context(following(hosted.host))
            return hosted

        yield start


def process_ids(hosted: Hosted, feed_id: str) -> list[int]:
    """The processes that have followed a feed, one after the other."""
    path = hosted.files.folder(feed_id) / "patient"
    return [int(each) for each in path.read_text().split()] if path.exists() else []


def is_alive(process_id: int) -> bool:
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_feed_is_claimed_followed_announced_and_paused(started: Start) -> None:
    hosted = started()
    record = hosted.open(feed_record(None))
    eventually(lambda: hosted.state(record.feed_id) == "live")
    assert hosted.endpoint(record.feed_id).endswith(f"worker-1-feed-{record.feed_id}.sock")
    address = hosted.queue.workers()[0]
    assert (address.feed_id, address.renders_only, address.job_id) == (record.feed_id, True, None)
    hosted.queue.wish_feed(record.feed_id, FeedWish.PAUSE)
    eventually(lambda: hosted.state(record.feed_id) == "paused")
    hosted.queue.wish_feed(record.feed_id, FeedWish.RUN)
    eventually(lambda: hosted.state(record.feed_id) == "live")


def test_no_more_feeds_are_followed_than_there_are_places_and_the_next_one_waits(started: Start) -> None:
    hosted = started()
    first, second = hosted.open(feed_record(None)), hosted.open(feed_record(None))
    eventually(lambda: hosted.state(first.feed_id) == "live")
    time.sleep(1.2)
    assert hosted.state(second.feed_id) is None
    hosted.queue.wish_feed(first.feed_id, FeedWish.END)
    eventually(lambda: hosted.state(second.feed_id) == "live")
    assert hosted.queue.feed(first.feed_id) is None


def test_an_end_leaves_no_process_no_file_and_no_record(started: Start) -> None:
    hosted = started()
    record = hosted.open(feed_record(None))
    eventually(lambda: hosted.state(record.feed_id) == "live")
    (process_id,) = process_ids(hosted, record.feed_id)
    hosted.queue.wish_feed(record.feed_id, FeedWish.END)
    eventually(lambda: hosted.queue.feed(record.feed_id) is None)
    assert not is_alive(process_id)
    assert not hosted.files.folder(record.feed_id).exists()
    eventually(lambda: hosted.queue.workers() == [])


def test_what_another_worker_left_to_end_is_ended_without_a_free_place(started: Start) -> None:
    hosted = started(places=0)
    record = hosted.open(feed_record(None))
    claimed = hosted.queue.claim_feed("worker-2.b")
    assert claimed is not None
    (hosted.files.make(record.feed_id, record.created_at_s) / "patient").write_text("")
    hosted.queue.release_feed(FeedClaim(record.feed_id, claimed.epoch, "worker-2.b"))
    hosted.queue.wish_feed(record.feed_id, FeedWish.END)
    eventually(lambda: hosted.queue.feed(record.feed_id) is None)
    assert hosted.files.ids() == []


def test_files_that_cannot_be_deleted_are_tried_again_before_the_record_goes(
    started: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    hosted = started()
    record = hosted.open(feed_record(None))
    eventually(lambda: hosted.state(record.feed_id) == "live")
    remove, refused = hosted.files.remove, [0]

    def fails(feed_id: str) -> None:
        refused[0] += 1
        if refused[0] < 3:
            raise UnavailableError("The disk is read-only.", "Wait.")
        remove(feed_id)

    monkeypatch.setattr(hosted.files, "remove", fails)
    hosted.queue.wish_feed(record.feed_id, FeedWish.END)
    eventually(lambda: refused[0] == 1)
    assert hosted.queue.feed(record.feed_id) is not None
    eventually(lambda: hosted.queue.feed(record.feed_id) is None)
    assert hosted.files.ids() == []


def test_files_of_a_feed_that_ended_elsewhere_are_deleted(tmp_path: Path) -> None:
    hosted = Hosted(tmp_path, command=FEED_STANDIN, places=0)
    known, gone = hosted.open(feed_record(None)), feed_record(None)
    for each in (known, gone):
        (hosted.files.make(each.feed_id, each.created_at_s) / "patient").write_text("")
    hosted.host.step()
    assert hosted.files.ids() == [known.feed_id]


def test_files_of_a_feed_whose_record_cannot_be_read_stay(tmp_path: Path) -> None:
    hosted = Hosted(tmp_path, command=FEED_STANDIN, places=0)
    record = hosted.open(feed_record(None))
    hosted.files.make(record.feed_id, record.created_at_s)
    hosted.queue.stored_feeds.unreadable.add(record.feed_id)
    hosted.host.step()
    assert hosted.files.ids() == [record.feed_id]


def test_a_feed_that_is_opened_again_under_its_id_has_no_earlier_past(started: Start) -> None:
    hosted, ended = started(), feed_record(None)
    folder = hosted.files.make(ended.feed_id, ended.created_at_s)  # ended on another machine a moment ago
    (folder / "earlier").write_text("")
    again = hosted.open(ended.model_copy(update={"created_at_s": ended.created_at_s + 1}))
    eventually(lambda: hosted.state(again.feed_id) == "live")
    assert not (folder / "earlier").exists()
    (folder / "own").write_text("")
    assert hosted.files.make(again.feed_id, again.created_at_s) == folder
    assert (folder / "own").exists()


def test_a_killed_process_is_replaced_and_the_feed_says_so_meanwhile(started: Start) -> None:
    hosted = started()
    record = hosted.open(feed_record(None))
    eventually(lambda: hosted.state(record.feed_id) == "live")
    os.kill(process_ids(hosted, record.feed_id)[0], signal.SIGKILL)
    eventually(lambda: hosted.state(record.feed_id) == "stalled")
    report = hosted.report(record.feed_id)
    assert report is not None
    assert (report.reason, report.received_fps, report.begins_s) == (FeedReason.FAULT, 0.0, 1.0)
    assert report.model_age_s is not None
    eventually(lambda: hosted.state(record.feed_id) == "live")
    assert len(process_ids(hosted, record.feed_id)) == 2


def test_a_paused_feed_is_paused_in_its_next_process(started: Start) -> None:
    hosted = started()
    record = hosted.open(feed_record(None))
    hosted.queue.wish_feed(record.feed_id, FeedWish.PAUSE)
    eventually(lambda: hosted.state(record.feed_id) == "paused")
    os.kill(process_ids(hosted, record.feed_id)[0], signal.SIGKILL)
    eventually(lambda: len(process_ids(hosted, record.feed_id)) == 2)
    eventually(lambda: hosted.state(record.feed_id) == "paused")


@pytest.mark.parametrize("label", ["silent", "dies", "stuck"])
def test_a_process_that_hangs_or_ends_again_and_again_is_replaced(
    started: Start, label: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed_child, "MAX_LOST_S" if label == "stuck" else "MAX_SILENCE_S", 0.5)
    hosted = started()
    record = hosted.open(feed_record(None, label=label))
    eventually(lambda: len(process_ids(hosted, record.feed_id)) == 3)


def test_that_a_source_was_away_does_not_count_against_its_process(started: Start) -> None:
    hosted = started()
    record = hosted.open(feed_record(None, label="returns"))
    eventually(lambda: (report := hosted.report(record.feed_id)) is not None and report.model_age_s == 0.2)
    assert len(process_ids(hosted, record.feed_id)) == 1


def test_a_feed_that_another_worker_claimed_is_left_to_it_with_its_files(tmp_path: Path) -> None:
    hosted = Hosted(tmp_path, command=FEED_STANDIN)
    record = hosted.open(feed_record(None))
    with following(hosted.host):
        eventually(lambda: hosted.state(record.feed_id) == "live")
        (process_id,) = process_ids(hosted, record.feed_id)
        assert hosted.queue.claim_feed("worker-1.b") is not None  # as a worker of the same name does at its start
        eventually(lambda: not is_alive(process_id))
        assert hosted.files.ids() == [record.feed_id]
        eventually(lambda: hosted.host.followed == ())


def test_a_feed_whose_source_has_ended_ends_after_the_time_that_its_past_is_kept(started: Start) -> None:
    hosted = started()
    record = hosted.open(feed_record(None, label="ended", keep_s=60))
    eventually(lambda: hosted.state(record.feed_id) is not None or hosted.queue.feed(record.feed_id) is None)
    eventually(lambda: hosted.queue.feed(record.feed_id) is None)
    kept = hosted.open(feed_record(None, label="ended", keep_s=7200))
    eventually(lambda: hosted.state(kept.feed_id) == FeedState.ENDED)
    time.sleep(1.2)
    assert hosted.queue.feed(kept.feed_id) is not None


def test_a_worker_that_ends_lets_its_feeds_be_claimed_at_once(tmp_path: Path) -> None:
    hosted = Hosted(tmp_path, command=FEED_STANDIN)
    record = hosted.open(feed_record(None))
    with following(hosted.host):
        eventually(lambda: hosted.state(record.feed_id) == "live")
    assert hosted.queue.workers() == []
    claimed = hosted.queue.claim_feed("worker-2.b")
    assert claimed is not None
    assert hosted.files.ids() == [record.feed_id]


def test_processes_answer_at_ports_after_that_of_the_worker(tmp_path: Path) -> None:
    assert endpoints_of("w", tmp_path, "tcp://10.0.0.1:5570")[:2] == ("tcp://10.0.0.1:5571", "tcp://10.0.0.1:5572")
    assert endpoints_of("w", tmp_path, "tcp://10.0.0.1:65535") == ()


def child_of(hosted: Hosted, record: FeedRecord, command: Sequence[str]) -> FeedChild:
    return FeedChild(record, hosted.files.make(record.feed_id, record.created_at_s), (), command, None)


def test_a_feed_that_is_taken_over_is_not_reported_as_another_worker_left_it(tmp_path: Path) -> None:
    left = FeedReport(state=FeedState.LIVE, since_s=1.0, received_fps=30.0, model_age_s=0.2, ends_s=time.time() - 100)
    record = feed_record(None).model_copy(update={"report": left})
    report = child_of(Hosted(tmp_path), record, FEED_STANDIN).report()
    assert (report.state, report.reason, report.received_fps) == (FeedState.CONNECTING, None, 0.0)
    assert report.since_s == pytest.approx(time.time(), abs=10)
    assert report.model_age_s == pytest.approx(100, abs=10)


def test_a_process_that_reads_no_orders_yet_does_not_hold_up_the_others(tmp_path: Path) -> None:
    record = feed_record(None).model_copy(update={"calibration": " " * MAX_CALIBRATION_BYTES})
    child = child_of(Hosted(tmp_path), record, (sys.executable, "-c", "import time; time.sleep(60)"))
    looking = threading.Thread(target=child.look, daemon=True)
    looking.start()
    looking.join(10)
    try:
        assert not looking.is_alive()
    finally:
        child.kill()


def test_a_feed_whose_folder_the_disk_refuses_is_left_to_other_workers(
    started: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    hosted = started()
    hosted.queue.stored_feeds._lease_s = 600.0  # without a release nobody could claim the feed again
    refused: list[str] = []

    def refuse(feed_id: str) -> Path:
        refused.append(feed_id)
        raise UnavailableError("The disk is read-only.", "Mount it again.")

    with monkeypatch.context() as patched:
        patched.setattr(type(hosted.files), "make", lambda _, feed_id, __: refuse(feed_id))
        record = hosted.open(feed_record(None))
        eventually(lambda: len(refused) >= 2)
    eventually(lambda: hosted.state(record.feed_id) == "live")


def test_a_wish_that_cannot_be_obeyed_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)

    class Refusing:
        def wish(self, wish: FeedWish) -> None:
            raise OSError(f"the disk refuses to {wish}")

        def close(self) -> None:
            pass

    feed_process._Wishes(io.BytesIO(line_of(WishFeed(wish=FeedWish.PAUSE))), Refusing())  # type: ignore[arg-type]
    eventually(lambda: 1 in codes)
