"""What comes and goes while a feed is live: pushed video and pictures, and views of every newer moment."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from contract.access.keys import DEFAULT_SCOPES, KeyFile, KeyScope
from contract.wire.rendering import MAX_PUSH_BYTES, PushRequest, RenderRequest
from intrasplat.live.state import FeedState
from tests.service.feed_worker import FeedWorker, following, wait_until
from tests.service.live import LiveService, live_service
from tests.service.test_feeds import MAY_ALL, RECTIFIED
from tests.service.test_stream import ask, problem, view

TIMEOUT_S = 10.0
MP4 = b"\0\0\0\x08ftyp"


@pytest.fixture
def service(tmp_path: Path) -> Iterator[LiveService]:
    with live_service(tmp_path, feed_hosts=("rtsp://camera.example.org",)) as service:
        yield service


@pytest.fixture
def worker(service: LiveService) -> Iterator[FeedWorker]:
    with following(service.queue, service.store.run_dir) as worker:
        yield worker


def opened(service: LiveService, options: str = "{}", **arguments: Any) -> str:
    files = {"calibration": ("a.json", RECTIFIED.encode())}
    response = httpx.post(f"{service.url}/feeds", files=files, data={"options": options}, **arguments)
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


def pushed(worker: FeedWorker) -> bytes:
    return b"".join(worker.pushed.values())


@contextmanager
def connected(service: LiveService, path: str, **arguments: Any) -> Iterator[ClientConnection]:
    with connect(f"ws://127.0.0.1:{service.port}{path}", compression=None, **arguments) as socket:
        yield socket


def send_until_closed(socket: ClientConnection) -> None:
    until_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < until_s:
        socket.send(picture(b"jpeg"))
        socket.recv(timeout=TIMEOUT_S)


def picture(content: bytes, at_s: float = 5.0) -> bytes:
    return struct.pack("<dI", at_s, len(content)) + content


def test_pushed_video_comes_in_order_and_while_it_is_sent(service: LiveService, worker: FeedWorker) -> None:
    feed_id, pieces = opened(service), [bytes([0x47, number]) * 50_000 for number in range(6)]
    came = list[bytes]()

    def body() -> Iterator[bytes]:
        for piece in pieces:
            yield piece
            wait_until(lambda: len(pushed(worker)) == 100_000 * (len(came) + 1))  # before more is sent
            came.append(piece)

    response = httpx.put(f"{service.url}/feeds/{feed_id}/video", content=body(), timeout=TIMEOUT_S)
    assert response.json() == {"bytes": 600_000}
    assert came == pieces
    assert pushed(worker) == b"".join(pieces)
    requests = [each for each in worker.asked if isinstance(each, PushRequest)]
    assert len({each.push_id for each in requests}) == 1
    assert [each.is_last for each in requests] == [False] * (len(requests) - 1) + [True]
    assert max(map(len, worker.bodies)) <= MAX_PUSH_BYTES


def test_a_push_waits_for_the_feeds_process(service: LiveService) -> None:
    feed_id, answers = opened(service), list[httpx.Response]()
    push = threading.Thread(
        target=lambda: answers.append(httpx.put(f"{service.url}/feeds/{feed_id}/video", content=MP4, timeout=TIMEOUT_S))
    )
    push.start()
    time.sleep(0.3)
    with following(service.queue, service.store.run_dir) as worker:
        push.join()
        assert pushed(worker) == MP4
    assert answers[0].status_code == 200


def test_a_push_ends_with_its_reason(service: LiveService, worker: FeedWorker) -> None:
    source = opened(service, '{"source": "rtsp://camera.example.org/1"}')
    assert httpx.put(f"{service.url}/feeds/{source}/video", content=b"x").status_code == 409
    feed_id = opened(service)

    def body() -> Iterator[bytes]:
        yield MP4
        wait_until(lambda: worker.pushed)
        worker.replaced.update(worker.pushed)
        for _ in range(100):
            yield b"moof"
            time.sleep(0.01)

    response = httpx.put(f"{service.url}/feeds/{feed_id}/video", content=body(), timeout=TIMEOUT_S)
    assert (response.status_code, response.json()["field"]) == (409, "push")


def test_what_is_no_video_is_refused_and_ends_no_other_push(service: LiveService, worker: FeedWorker) -> None:
    url = f"{service.url}/feeds/{opened(service)}/video"
    for pieces in ([b"hello"], [b"this is not a video"], [b"this ", b"is not", b" a video"]):
        response = httpx.put(url, content=pieces, timeout=TIMEOUT_S)
        assert (response.status_code, response.json()["field"]) == (422, "body")
    assert not worker.asked
    assert httpx.put(url, content=[MP4[:5], MP4[5:] + b"moov"], timeout=TIMEOUT_S).json() == {"bytes": 12}
    assert pushed(worker) == MP4 + b"moov"


def test_a_push_that_waits_for_a_worker_ends_with_its_caller(service: LiveService) -> None:
    feed_id = opened(service)

    def pushes() -> bool:
        return "intrasplat_feed_pushes 1.0" in httpx.get(f"{service.url}/metrics").text

    head = f"PUT /feeds/{feed_id}/video HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n4\r\nG123\r\n"
    with socket.create_connection(("127.0.0.1", service.port)) as caller:
        caller.sendall(head.encode())
        wait_until(pushes)
    wait_until(lambda: not pushes(), timeout_s=5.0)
    with connected(service, f"/feeds/{feed_id}/pictures") as caller:
        caller.send(picture(b"jpeg"))
        wait_until(pushes)
    wait_until(lambda: not pushes(), timeout_s=5.0)


def test_a_silent_push_is_ended(tmp_path: Path) -> None:
    with (
        live_service(tmp_path, upload_silence_s=0.2) as service,
        following(service.queue, service.store.run_dir) as worker,
    ):
        feed_id, go_on = opened(service), threading.Event()

        def body() -> Iterator[bytes]:
            yield MP4
            go_on.wait(TIMEOUT_S)

        with httpx.Client() as client:
            done = threading.Timer(1.0, go_on.set)
            done.start()
            response = client.put(f"{service.url}/feeds/{feed_id}/video", content=body(), timeout=TIMEOUT_S)
        assert response.status_code == 408
        wait_until(lambda: any(isinstance(each, PushRequest) and each.is_last for each in worker.asked))


def test_pictures_are_handed_on_and_counted(service: LiveService, worker: FeedWorker) -> None:
    stream = picture(b"a" * 70_000) + picture(b"b") + picture(b"c" * 5)
    with connected(service, f"/feeds/{opened(service)}/pictures") as socket:
        for start in range(0, len(stream), 60_000):
            socket.send(stream[start : start + 60_000])
        assert [json.loads(socket.recv(timeout=TIMEOUT_S))["taken"] for _ in range(3)] == [1, 2, 3]
    assert pushed(worker) == stream
    assert all(each.pictures for each in worker.asked if isinstance(each, PushRequest))
    wait_until(lambda: worker.asked[-1].is_last)


def test_a_picture_that_was_cut_off_by_the_feeds_process_comes_again_whole(
    service: LiveService, worker: FeedWorker
) -> None:
    worker.losses = [2]  # the third part of the push is lost, which is in the second picture
    first, second = picture(b"a"), picture(b"b" * 70_000)
    with connected(service, f"/feeds/{opened(service)}/pictures") as socket:
        for piece in (first, second[:60_000], second[60_000:]):
            socket.send(piece)
        assert [json.loads(socket.recv(timeout=TIMEOUT_S))["taken"] for _ in range(2)] == [1, 2]
    pushes = list(worker.pushed.values())
    assert pushes == [first + second[:MAX_PUSH_BYTES], second]


def test_a_push_of_mpeg_ts_goes_on_with_another_process_and_one_of_mp4_ends(
    service: LiveService, worker: FeedWorker
) -> None:
    worker.losses = [1]
    url = f"{service.url}/feeds/{opened(service)}/video"
    stream = b"\x47" * (3 * MAX_PUSH_BYTES)
    assert httpx.put(url, content=stream, timeout=TIMEOUT_S).json() == {"bytes": len(stream)}
    assert len(worker.pushed) == 2
    assert pushed(worker) == stream
    worker.losses = [len(worker.bodies) + 1]
    assert httpx.put(url, content=b"ftyp" * MAX_PUSH_BYTES, timeout=TIMEOUT_S).status_code == 503


@pytest.mark.parametrize(
    ("message", "code"), [("hello", 1003), (struct.pack("<dI", 1.0, 0), 1007), (struct.pack("<dI", 1.0, 2**31), 1007)]
)
def test_what_is_no_picture_ends_the_connection(
    service: LiveService, worker: FeedWorker, message: str | bytes, code: int
) -> None:
    with connected(service, f"/feeds/{opened(service)}/pictures") as socket:
        socket.send(message)
        assert problem(socket)["status"] == 422
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=TIMEOUT_S)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == code


def test_pictures_need_a_key_with_the_scope(tmp_path: Path) -> None:
    with (
        live_service(tmp_path, hosts=("camera.example.org",)) as service,
        following(service.queue, service.store.run_dir) as worker,
    ):
        keys = KeyFile(service.store.data_dir)
        _, may = keys.create("ward-1", MAY_ALL)
        _, views = keys.create("ward-1", DEFAULT_SCOPES)
        _, other = keys.create("ward-2", {KeyScope.FEEDS})
        feed_id = opened(service, headers={"Authorization": f"Bearer {may}"})
        path = f"/feeds/{feed_id}/pictures"
        for key, status in [(views, 403), (other, 404), ("isp_wrong", 401)]:
            with (
                pytest.raises(InvalidStatus) as refused,
                connected(service, path, additional_headers={"Authorization": f"Bearer {key}"}),
            ):
                pass
            assert refused.value.response.status_code == status
        for first, status in [({"authorize": views}, 403), ({"authorize": other}, 404), ({}, 401)]:
            with connected(service, path) as socket:
                socket.send(json.dumps(first))
                assert problem(socket)["status"] == status
        with connected(service, path) as socket:
            socket.send(json.dumps({"authorize": may}))
            socket.send(picture(b"jpeg"))
            assert json.loads(socket.recv(timeout=TIMEOUT_S)) == {"taken": 1}
            keys.revoke(may.split("_")[1])
            with pytest.raises(ConnectionClosed):
                send_until_closed(socket)
        assert worker.pushed


def test_a_followed_feed_sends_every_newer_moment_until_the_next_request(
    service: LiveService, worker: FeedWorker
) -> None:
    feed_id = opened(service)
    wait_until(lambda: any(each.feed_id == feed_id for each in service.queue.workers()))
    with connected(service, "/stream") as viewer:
        ask(viewer, scene=feed_id, t="live", follow=True, id=1)
        head, image = view(viewer)
        assert image == b"picture"
        assert (head["id"], head["state"], head["source_s"], head["age_s"]) == (1, "live", 60, 0.5)
        assert head["captured_at"] == "2023-11-14T22:14:20.000+00:00"
        for second in (61.0, 62.0):
            worker.newest_s = second
            head, _ = view(viewer)
            assert (head["id"], head["source_s"]) == (1, second)
        asked = len(worker.asked)
        time.sleep(0.5)
        polls = worker.asked[asked:]
        assert 3 < len(polls) < 13
        assert all(isinstance(each, RenderRequest) and each.newer_than_s == 62 for each in polls)
        ask(viewer, scene=feed_id, t=-2, id=2)
        assert view(viewer)[0]["source_s"] == 60
        worker.newest_s = 63.0
        with pytest.raises(TimeoutError):
            viewer.recv(timeout=0.3)


def test_all_viewers_of_a_feed_share_its_polls(service: LiveService, worker: FeedWorker) -> None:
    feed_id = opened(service)
    wait_until(lambda: any(each.feed_id == feed_id for each in service.queue.workers()))
    with connected(service, "/stream") as first, connected(service, "/stream") as second:
        for viewer in (first, second):
            ask(viewer, scene=feed_id, follow=True)
            assert view(viewer)[0]["source_s"] == 60
        asked = len(worker.asked)
        time.sleep(0.5)
        assert 3 < len(worker.asked[asked:]) < 13
        worker.newest_s = 61.0
        assert [view(viewer)[0]["source_s"] for viewer in (first, second)] == [61, 61]


def test_following_outlives_the_feeds_process_and_ends_with_the_feed(
    service: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.stream.AWAY_RETRY_S", 0.05)
    monkeypatch.setattr("service.feed_records.VALID_S", 0.0)
    feed_id = opened(service)
    with connected(service, "/stream") as viewer:
        ask(viewer, scene=feed_id, follow=True)
        assert problem(viewer)["status"] == 503  # nobody follows it yet
        with following(service.queue, service.store.run_dir):
            until_s = time.monotonic() + TIMEOUT_S
            while isinstance(message := viewer.recv(timeout=TIMEOUT_S), str):
                assert json.loads(message)["status"] == 503
                assert time.monotonic() < until_s
            httpx.delete(f"{service.url}/feeds/{feed_id}", timeout=TIMEOUT_S)
            assert problem(viewer)["status"] in (404, 503)


def test_that_a_feed_is_there_is_confirmed_without_a_view(service: LiveService, worker: FeedWorker) -> None:
    feed_id = opened(service)
    with connected(service, "/stream") as viewer:
        ask(viewer, scene=feed_id, confirm=True, id=3)
        answer = json.loads(viewer.recv(timeout=TIMEOUT_S))
    assert answer["id"] == 3
    assert answer["state"] in set(FeedState)
    assert worker.asked == []


def test_a_scene_and_the_past_cannot_be_followed(service: LiveService, worker: FeedWorker) -> None:
    scene, feed_id = service.finished_scene(), opened(service)
    with connected(service, "/stream") as viewer:
        for query in ({"scene": scene}, {"scene": feed_id, "t": -3}):
            ask(viewer, follow=True, **query)
            assert problem(viewer)["field"] == "follow"
        ask(viewer, scene=scene, t="live")
        assert problem(viewer)["field"] == "t"


def test_a_paused_feed_says_so_with_its_last_view(service: LiveService, worker: FeedWorker) -> None:
    feed_id = opened(service)
    wait_until(lambda: any(each.feed_id == feed_id for each in service.queue.workers()))
    worker.obeys, worker.state = False, FeedState.PAUSED
    with connected(service, "/stream") as viewer:
        ask(viewer, scene=feed_id)
        assert view(viewer)[0]["state"] == "paused"
