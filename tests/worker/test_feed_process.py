"""Feeds of a small phantom, followed by real processes: shown, pushed, cut, killed, ended."""

from __future__ import annotations

import os
import secrets
import signal
import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from contract.runtime.settings import Settings
from contract.wire.feeds import FeedRecord, FeedWish
from contract.wire.rendering import CutRequest, ExportRequest, PushRequest, RecordedRequest, WorkerReply
from intrasplat.live.state import FeedReason
from intrasplat.live.times import LIVE, FeedTime
from intrasplat.picture import RecordedMasks
from lab.phantom import Phantom, PhantomSettings, make_phantom
from tests.live.senders import PhantomSender
from tests.worker.feeds import Asker, Hosted, eventually, feed_record, render_request
from tests.worker.test_supervisor import WorkerProcesses
from worker.feeds import following
from worker.hosted_feed import HostedFeed

MAX_BACK_S = 20.0
"""On a machine that is busy with other tests; measured alone it is below 6 s."""


@cache
def phantom() -> Phantom:
    return make_phantom(PhantomSettings(128, 96, 24, "breathing", 0, tools=(), period_frames=24, frame_rate_hz=10.0))


@pytest.fixture
def sender() -> Iterator[PhantomSender]:
    with PhantomSender(phantom()).serving() as serving:
        yield serving


def children_of(process_id: int) -> list[int]:
    """Children of all its threads."""
    tasks = Path(f"/proc/{process_id}/task").iterdir()
    return [int(each) for task in tasks for each in (task / "children").read_text().split()]


def running(process_id: int, command: str) -> list[int]:
    """Children that run `python -m worker <command>`."""
    lines = {each: Path(f"/proc/{each}/cmdline").read_bytes().split(b"\0") for each in children_of(process_id)}
    return [each for each, line in lines.items() if line[-3:-1] == [b"worker", command.encode()]]


def asker_of(hosted: Hosted, record: FeedRecord) -> Asker:
    eventually(lambda: hosted.state(record.feed_id) == "live", lambda: hosted.report(record.feed_id))
    return Asker(hosted.endpoint(record.feed_id))


def test_a_feed_is_shown_cut_paused_killed_and_ended(tmp_path: Path, sender: PhantomSender) -> None:
    hosted = Hosted(tmp_path, feed_hosts=(sender.url,))
    record = hosted.open(feed_record(sender.url, sender.calibration))
    feed_id = record.feed_id
    with following(hosted.host):
        asker = asker_of(hosted, record)
        eventually(lambda: hosted.known_s(feed_id) > 3, lambda: hosted.report(feed_id))

        newest = shown(asker.ask(render_request(feed_id)))
        assert newest.feed is not None
        assert newest.feed.is_newest
        assert newest.feed.age_s == pytest.approx(time.time() - newest.feed.captured_at_s, abs=0.5)
        assert newest.clip_size == (128, 96)
        again, body = asker.ask(render_request(feed_id, newer_than_s=newest.feed.source_s + 1000))
        assert (again.error, body) == (None, b"")
        assert again.feed is not None

        before = shown(asker.ask(render_request(feed_id, FeedTime.before_live(1.0), eye="right")))
        assert before.feed is not None
        assert not before.feed.is_newest
        moment = FeedTime.of_source(before.feed.source_s)
        same = shown(asker.ask(render_request(feed_id, moment, layer="depth")))
        assert same.feed is not None
        assert same.feed.captured_at_s == pytest.approx(before.feed.captured_at_s, abs=0.05)
        refused, _ = asker.ask(render_request(feed_id, FeedTime.before_live(3600)))
        assert refused.error is not None
        assert (refused.error.kind, refused.error.field) == ("input", "t")
        recorded, picture = asker.ask(RecordedRequest(scene_id=feed_id, t=0, moment=moment))
        assert recorded.feed is not None
        assert cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR).shape == (96, 128, 3)
        live, picture = asker.ask(RecordedRequest(scene_id=feed_id, t=0, moment=LIVE, masks=RecordedMasks.OFF))
        assert live.feed is not None
        assert live.feed.is_newest
        assert live.feed.age_s == pytest.approx(time.time() - live.feed.captured_at_s, abs=0.5)
        assert live.feed.captured_at_s > newest.feed.captured_at_s
        assert cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR).shape == (96, 128, 3)
        assert len(exported(asker, feed_id)) > 10_000

        (process_id,) = running(os.getpid(), "feed")
        eventually(lambda: hosted.known_s(feed_id) > 8)
        assert check_cut(asker, hosted, feed_id) > 100
        hosted.queue.wish_feed(feed_id, FeedWish.PAUSE)
        eventually(lambda: hosted.state(feed_id) == "paused")
        assert children_of(process_id) == []
        shown(asker.ask(render_request(feed_id)))
        hosted.queue.wish_feed(feed_id, FeedWish.RUN)
        eventually(lambda: hosted.state(feed_id) == "live")

        os.kill(children_of(process_id)[0], signal.SIGKILL)  # of the one that reads the source
        eventually(lambda: hosted.state(feed_id) != "live")
        check_back(hosted, feed_id)
        os.kill(process_id, signal.SIGKILL)
        eventually(lambda: hosted.state(feed_id) == "stalled")
        check_back(hosted, feed_id)
        asker.close()
        asker = asker_of(hosted, record)
        past = shown(asker.ask(render_request(feed_id, moment)))
        assert past.feed is not None
        assert past.feed.captured_at_s == pytest.approx(before.feed.captured_at_s, abs=0.05)
        asker.close()

        hosted.queue.wish_feed(feed_id, FeedWish.END)
        eventually(lambda: hosted.queue.feed(feed_id) is None)
        assert running(os.getpid(), "feed") == []
        assert not hosted.files.folder(feed_id).exists()
        assert list(hosted.run_dir.iterdir()) == []


def shown(answer: tuple[WorkerReply, bytes]) -> WorkerReply:
    """The head of an answer that is a picture."""
    head, body = answer
    assert head.error is None, head.error
    assert cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR) is not None
    return head


def exported(asker: Asker, feed_id: str) -> bytes:
    request = ExportRequest(scene_id=feed_id, attempt=0, moment=LIVE, export_id=secrets.token_hex(16))
    parts, more = [], True
    while more:
        head, body = asker.ask(request.model_copy(update={"part": len(parts)}))
        assert head.error is None
        assert head.feed is not None
        parts.append(body)
        more = head.more
    return b"".join(parts)


def check_cut(asker: Asker, hosted: Hosted, feed_id: str) -> int:
    """Cut all that is recorded; the number of frames of the file."""
    report = hosted.report(feed_id)
    assert report is not None
    assert report.begins_s is not None
    assert report.ends_s is not None
    begins, ends = FeedTime.at(report.begins_s), FeedTime.at(report.ends_s)
    request = CutRequest(scene_id=feed_id, begins=begins, ends=ends, export_id=secrets.token_hex(16))
    content, part, found, more = b"", 0, None, True
    while more:
        head, body = asker.ask(request.model_copy(update={"part": part}))
        assert head.error is None, head.error
        content, part, more = content + body, part + 1, head.more
        found = found or head.cut
        assert head.media_type == "video/mp4"
    assert found is not None
    assert found.from_s == pytest.approx(report.begins_s, abs=0.5)
    assert found.to_s <= report.ends_s + 0.5
    assert content[4:8] == b"ftyp"
    nothing, _ = asker.ask(
        request.model_copy(update={"begins": FeedTime.at(1.0), "ends": FeedTime.at(2.0), "export_id": "0" * 32})
    )
    assert nothing.error is not None
    assert (nothing.error.kind, nothing.error.field) == ("input", "from")
    return found.frames


def check_back(hosted: Hosted, feed_id: str) -> None:
    """It is live again soon, with its past."""
    before, began_s = hosted.report(feed_id), time.monotonic()
    eventually(lambda: hosted.state(feed_id) == "live", lambda: hosted.report(feed_id))
    assert time.monotonic() - began_s < MAX_BACK_S
    report = hosted.report(feed_id)
    assert before is not None
    assert report is not None
    assert report.begins_s == pytest.approx(before.begins_s, abs=0.1)


def push(record: FeedRecord, push_id: str, *, pictures: bool = False, is_last: bool = False) -> PushRequest:
    return PushRequest(scene_id=record.feed_id, push_id=push_id, pictures=pictures, is_last=is_last)


def test_what_is_pushed_is_followed_and_a_new_push_takes_the_place_of_the_one_before(
    tmp_path: Path, sender: PhantomSender
) -> None:
    hosted = Hosted(tmp_path)
    record = hosted.open(feed_record(None, sender.calibration))
    first, second, third = (secrets.token_hex(16) for _ in range(3))
    with following(hosted.host):
        asker = Asker(hosted.endpoint(record.feed_id))
        for index, content in enumerate(sender.stream()):
            reply, _ = asker.ask(push(record, first), content)
            assert reply.error is None, reply.error
            assert index < 1200, hosted.report(record.feed_id)
            if hosted.known_s(record.feed_id) > 1:
                break
        reply, _ = asker.ask(push(record, second), next(sender.stream()))
        assert reply.error is None
        late, _ = asker.ask(push(record, first), b"late")
        assert late.error is not None
        assert (late.error.kind, late.error.field) == ("input", "push")
        last, _ = asker.ask(push(record, second, is_last=True), b"")
        assert last.error is None

        ends_s = hosted.known_s(record.feed_id)
        for index, content in enumerate(sender.jpegs()):
            assert index < 600, hosted.report(record.feed_id)
            half = len(content) // 2
            for piece in (content[:half], content[half:]):
                reply, _ = asker.ask(push(record, third, pictures=True), piece)
                assert reply.error is None, reply.error
            if hosted.known_s(record.feed_id) > ends_s + 1:
                break
        asker.close()


@pytest.mark.parametrize(
    ("source", "reason"),
    [("tcp://127.0.0.1:9", "host_refused"), ("/etc/hostname", "host_refused"), (None, "calibration")],
)
def test_a_feed_that_cannot_be_followed_says_why(tmp_path: Path, source: str | None, reason: str) -> None:
    hosted = Hosted(tmp_path, feed_devices=("/dev/video0",))
    record = hosted.open(feed_record(source, None if source is None else phantom().settings.calibration))
    with following(hosted.host):
        eventually(lambda: hosted.state(record.feed_id) == "ended", lambda: hosted.report(record.feed_id))
        report = hosted.report(record.feed_id)
        assert report is not None
        assert report.reason is not None
        assert report.reason.value == reason
        assert report.text
        asker = Asker(hosted.endpoint(record.feed_id))
        reply, _ = asker.ask(render_request(record.feed_id))
        assert reply.error is not None
        assert reply.error.kind == "input"
        asker.close()


def test_a_calibration_of_another_size_is_named_as_it_was_sent(tmp_path: Path, sender: PhantomSender) -> None:
    record = feed_record(sender.url, sender.calibration.model_copy(update={"width": 640, "height": 240}))
    settings = Settings(data_dir=tmp_path, feed_hosts=(sender.url,), feed_private="yes")
    feed = HostedFeed(record, tmp_path, settings)
    feed.begin()
    try:
        eventually(lambda: feed.report().reason is FeedReason.CALIBRATION, feed.report)
        text = feed.report().text
    finally:
        feed.close()
    assert "calibration.json: " in text
    assert "640x240 pixels an eye, and the eyes have 128x96" in text


def niceness_of(worker_id: int, command: str) -> int:
    """The niceness of the child that runs `python -m worker <command>`."""
    return os.getpriority(os.PRIO_PROCESS, running(worker_id, command)[0])


class FeedWorkers(WorkerProcesses):
    """Workers that may follow feeds of this machine."""

    hosts: tuple[str, ...] = ()

    def settings(self, name: str = "worker-1") -> Settings:
        return super().settings(name).model_copy(update={"feed_hosts": self.hosts, "feed_private": "yes"})


def test_a_worker_that_is_killed_and_started_again_goes_on_with_its_feed(tmp_path: Path, sender: PhantomSender) -> None:
    bench = FeedWorkers(tmp_path)
    bench.hosts = (sender.url,)
    try:
        record = bench.queue.open_feed(feed_record(sender.url, sender.calibration), 1, 1)

        def followed_by() -> str | None:
            known = bench.queue.feed(record.feed_id)
            is_live = known is not None and known.report is not None and known.report.state == "live"
            return known.owner if known is not None and is_live else None

        command = [sys.executable, "-m", "worker", "consume"]
        with bench.worker(command=command) as first:
            eventually(followed_by)
            owner = followed_by()
            eventually(lambda: niceness_of(first.pid, "feed") < niceness_of(first.pid, "device"))
            first.kill()
            first.wait()
        began = bench.queue.feed(record.feed_id)
        with bench.worker(command=command):
            eventually(lambda: followed_by() not in (None, owner))
            again = bench.queue.feed(record.feed_id)
            bench.queue.wish_feed(record.feed_id, FeedWish.END)
            eventually(lambda: bench.queue.feed(record.feed_id) is None)
        assert began is not None
        assert again is not None
        assert again.epoch == began.epoch + 1
        assert list((tmp_path / "feeds").iterdir()) == []
    finally:
        bench.close()
