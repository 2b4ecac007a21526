"""A live feed, the whole way: `intrasplat up`, video pushed over HTTP, views of now and before, a cut, a clean end."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from intrasplat_client import Client, FeedState, JobState, NotFound
from lab.demo import started_service
from lab.phantom import PhantomSettings, make_phantom
from tests.live.senders import PhantomSender

WAIT_S = 120.0
"""On a machine that is busy with other tests."""


@pytest.fixture(scope="module")
def sender() -> PhantomSender:
    settings = PhantomSettings(128, 96, 24, "breathing", 0, tools=(), period_frames=24, frame_rate_hz=10.0)
    return PhantomSender(make_phantom(settings))


def eventually(holds: Callable[[], object], what: Callable[[], object]) -> None:
    until_s = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < until_s, what()
        time.sleep(0.1)


def past_s(client: Client, feed_id: str) -> float:
    """How much of the past can be seen; a busy machine shows nothing of a source's first seconds."""
    feed = client.feed(feed_id)
    return 0.0 if feed.source_ends_s is None else feed.source_ends_s - (feed.source_begins_s or 0.0)


def assert_picture(content: bytes, width: int, height: int) -> None:
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape[:2] == (height, width)


class Push(threading.Thread):
    """Pushes video until it is ended."""

    def __init__(self, url: str, sender: PhantomSender) -> None:
        super().__init__(daemon=True)
        self._url, self._sender, self._end = url, sender, threading.Event()
        self.status: int | None = None

    def end(self) -> None:
        self._end.set()
        self.join(WAIT_S)

    def run(self) -> None:
        with contextlib.suppress(httpx.HTTPError):
            self.status = httpx.put(self._url, content=self._pieces(), timeout=WAIT_S).status_code

    def _pieces(self) -> Iterator[bytes]:
        for piece in self._sender.stream():
            if self._end.is_set():
                return
            yield piece


def test_video_pushed_over_http_is_shown_cut_and_deleted(tmp_path: Path, sender: PhantomSender) -> None:
    calibration = tmp_path / "calibration.json"
    calibration.write_text(sender.calibration.model_dump_json())
    data_dir = tmp_path / "data"
    with started_service(data_dir, tmp_path / "service.log") as client:
        feed = client.open_feed(calibration, layout="sbs", width=128, label="room 4")
        push = Push(f"{client.url}{feed.links['video']}", sender)
        push.start()
        eventually(lambda: client.feed(feed.id).state is FeedState.LIVE, lambda: client.feed(feed.id))
        eventually(lambda: past_s(client, feed.id) > 4, lambda: client.feed(feed.id))

        now = client.render(scene=feed.id, format="jpeg")
        assert_picture(now.content, 128, 96)
        assert now.state in ("live", "behind")
        assert now.age_s is not None
        assert now.age_s < WAIT_S
        assert now.source_s is not None
        before = client.render(now.source_s - 2, scene=feed.id, format="jpeg")
        assert before.source_s is not None
        assert before.source_s < now.source_s
        assert_picture(before.content, 128, 96)
        assert_picture(client.recorded(feed.id, "live", masks="off"), 128, 96)
        assert client.export(feed.id, "live", format="splat")
        assert_follows(client, feed.id)

        job = client.cut_feed(feed.id, -3, iterations=20, preset="instant", poses="fixed", mask_source="none")
        assert job.cut.frames > 20
        assert client.pause_feed(feed.id).state is FeedState.PAUSED
        resumed = client.resume_feed(feed.id)
        assert resumed.state is not FeedState.PAUSED
        eventually(lambda: client.feed(feed.id).state is FeedState.LIVE, lambda: client.feed(feed.id))
        push.end()
        assert push.status == 200

        assert os.listdir(data_dir / "feeds" / feed.id)
        receipt = client.end_feed(feed.id)
        assert (receipt.record, receipt.verified) == (True, True)
        assert receipt.bytes > 0
        assert os.listdir(data_dir / "feeds") == []
        with pytest.raises(NotFound):
            client.feed(feed.id)
        assert client.wait(job.id).state is JobState.DONE
        assert_picture(client.render(0.5, scene=job.id, format="jpeg").content, 128, 96)


def assert_follows(client: Client, feed_id: str) -> None:
    """Each newer moment comes by itself."""
    seconds = []
    with connect(f"ws{client.url.removeprefix('http')}/stream", compression=None) as viewer:
        viewer.send(json.dumps({"scene": feed_id, "t": "live", "follow": True, "format": "jpeg"}))
        while len(seconds) < 4:
            message = viewer.recv(timeout=WAIT_S)
            assert isinstance(message, bytes), message
            head = json.loads(message[4 : 4 + int.from_bytes(message[:4], "big")])
            assert head["age_s"] < WAIT_S
            seconds.append(head["source_s"])
    assert seconds == sorted(set(seconds))
