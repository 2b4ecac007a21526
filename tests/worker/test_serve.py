"""The worker's ear: whatever arrives, each request gets one answer and the thread lives on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from contract.embedded import short_socket_path
from contract.errors import InputError, SceneError
from contract.rendering import ExportRequest, RenderRequest, WorkerReply, WorkerRequest
from worker.serve import RequestServer, View

SCENE = "0" * 32


def answer(request: RenderRequest | ExportRequest) -> View:
    if request.t == 1:
        raise InputError("t", "1 is odd.", "Use another.")
    if request.t == 2:
        raise SceneError("It is damaged.")
    if request.t == 3:
        raise ZeroDivisionError("patient Smith")
    return View(b"image", "image/png", request.t, ("a warning",))


@pytest.fixture
def socket(tmp_path: Path) -> Iterator[zmq.Socket[bytes]]:
    endpoint = f"ipc://{short_socket_path(tmp_path, 'worker.sock')}"
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with RequestServer(endpoint, answer):
        socket = context.socket(zmq.DEALER)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVTIMEO, 5000)
        socket.connect(endpoint)
        yield socket
        socket.close()
    context.term()


def ask(socket: zmq.Socket[bytes], document: bytes, request_id: bytes = b"7") -> tuple[WorkerReply, bytes]:
    socket.send_multipart([request_id, document])
    answered_id, head, body = socket.recv_multipart()
    assert answered_id == request_id
    return WorkerReply.model_validate_json(head), body


def request(t: float) -> bytes:
    return WorkerRequest(request=RenderRequest(scene_id=SCENE, t=t)).model_dump_json().encode()


def test_an_answer_carries_the_bytes_the_time_and_the_warnings(socket: zmq.Socket[bytes]) -> None:
    head, body = ask(socket, request(0.5))
    assert body == b"image"
    assert head == WorkerReply(media_type="image/png", t=0.5, warnings=("a warning",))


@pytest.mark.parametrize(("t", "kind", "field"), [(1, "input", "t"), (2, "scene", "scene"), (3, "internal", None)])
def test_an_error_is_told_and_the_next_request_is_answered(
    socket: zmq.Socket[bytes], t: float, kind: str, field: str | None
) -> None:
    head, body = ask(socket, request(t))
    assert head.error is not None
    assert (head.error.kind, head.error.field, body) == (kind, field, b"")
    assert "Smith" not in head.error.problem
    assert ask(socket, request(0))[0].error is None


@pytest.mark.parametrize("document", [b"", b"{}", b'{"request": {"kind": "shutdown"}}', b"\xff\xfe"])
def test_a_request_that_does_not_fit_is_told_so(socket: zmq.Socket[bytes], document: bytes) -> None:
    head, _ = ask(socket, document)
    assert head.error is not None
    assert head.error.kind == "internal"
    assert ask(socket, request(0))[0].error is None


def test_a_message_of_the_wrong_shape_is_passed_over(socket: zmq.Socket[bytes]) -> None:
    socket.send_multipart([b"1", b"2", b"3", b"4"])
    assert ask(socket, request(0))[0].error is None
