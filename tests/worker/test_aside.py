"""Pushes and cuts: answered in order beside renders, refused if too many wait or if nothing answers them."""

from __future__ import annotations

import os
import secrets
import threading
import time
from pathlib import Path

import pytest
import zmq

from contract.queue.embedded import short_socket_path
from contract.wire.rendering import CutRequest, PushRequest, RenderRequest, WorkerReply, WorkerRequest
from intrasplat.errors import InputError
from intrasplat.live.times import FeedTime
from tests.answers import at_once
from tests.worker.test_serve import answer, connected
from worker.aside import MAX_WAITING, Aside
from worker.reply import Reply
from worker.serve import RequestServer

FEED = "0" * 32


def push(content: bytes = b"") -> list[bytes]:
    request = PushRequest(scene_id=FEED, push_id="1" * 32)
    return [content[:8] or b"push", WorkerRequest(request=request).model_dump_json().encode(), content]


def received(socket: zmq.Socket[bytes]) -> tuple[bytes, WorkerReply]:
    request_id, head, _ = socket.recv_multipart()
    return request_id, WorkerReply.model_validate_json(head)


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{short_socket_path(tmp_path, 'feed.sock')}"


def test_pushes_are_taken_in_order_while_renders_are_answered(endpoint: str) -> None:
    taken, go_on = list[bytes](), threading.Event()

    def take(request: PushRequest, content: bytes) -> Reply:
        assert go_on.wait(10)
        taken.append(content)
        return Reply(b"", "application/octet-stream", 0.0)

    with RequestServer(endpoint, at_once(answer), aside=Aside({PushRequest: take})), connected(endpoint) as socket:
        for index in range(5):
            socket.send_multipart(push(b"%d" % index))
        render = WorkerRequest(request=RenderRequest(scene_id=FEED, t=0)).model_dump_json().encode()
        socket.send_multipart([b"render", render])
        assert received(socket)[0] == b"render"
        go_on.set()
        assert [received(socket)[0] for _ in range(5)] == [b"0", b"1", b"2", b"3", b"4"]
        assert taken == [b"0", b"1", b"2", b"3", b"4"]
        began_s = time.monotonic()
        for _ in range(60):
            socket.send_multipart(push())
            received(socket)
        assert time.monotonic() - began_s < 2.0  # an answer does not wait until the server looks again


def test_a_push_is_refused_if_too_many_wait_and_an_error_ends_none_of_the_others(endpoint: str) -> None:
    go_on = threading.Event()

    def take(request: PushRequest, content: bytes) -> Reply:
        assert go_on.wait(10)
        if content == b"bad":
            raise InputError("push", "it has ended.", "Begin anew.")
        return Reply(b"", "application/octet-stream", 0.0)

    with RequestServer(endpoint, at_once(answer), aside=Aside({PushRequest: take})), connected(endpoint) as socket:
        socket.send_multipart(push(b"bad"))
        time.sleep(0.2)
        for _ in range(MAX_WAITING + 1):
            socket.send_multipart(push())
        head = received(socket)[1]
        assert head.error is not None
        assert head.error.kind == "busy"
        go_on.set()
        heads = [received(socket)[1] for _ in range(MAX_WAITING + 1)]
        assert [each.error and each.error.kind for each in heads] == ["input", *[None] * MAX_WAITING]


def test_a_process_without_a_feed_refuses_pushes_and_cuts(endpoint: str) -> None:
    cut = CutRequest(scene_id=FEED, begins=FeedTime.at(1), ends=FeedTime.at(2), export_id=secrets.token_hex(16))
    with RequestServer(endpoint, at_once(answer)), connected(endpoint) as socket:
        for message in (push(b"bytes"), [b"cut", WorkerRequest(request=cut).model_dump_json().encode()]):
            socket.send_multipart(message)
            head = received(socket)[1]
            assert head.error is not None
            assert head.error.kind == "scene"


def test_a_close_leaves_no_pipe_and_an_answer_that_comes_later_does_no_harm() -> None:
    answering, go_on = threading.Event(), threading.Event()

    def take(request: PushRequest, content: bytes) -> Reply:
        answering.set()
        assert go_on.wait(10)
        return Reply(b"", "application/octet-stream", 0.0)

    aside = Aside({PushRequest: take})
    aside.take_in(b"caller", b"1", PushRequest(scene_id=FEED, push_id="1" * 32), b"")
    assert answering.wait(10)
    ends = aside.descriptor, aside._wake
    aside.close()
    for end in ends:
        with pytest.raises(OSError, match="Bad file"):
            os.fstat(end)
    go_on.set()
    assert aside._ready.get(timeout=10).caller == b"caller"
    aside.close()
