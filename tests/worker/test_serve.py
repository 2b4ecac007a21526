"""The request server: whatever arrives, each request gets one answer and the thread lives on."""

from __future__ import annotations

import contextlib
import socket as socket_module
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq

from contract.access.render_keys import RenderKeys, service_keys, worker_keys
from contract.queue.embedded import short_socket_path
from contract.wire.rendering import CancelRequest, ExportRequest, RenderRequest, WorkerReply, WorkerRequest
from intrasplat.errors import InputError, SceneError, UnavailableError
from intrasplat.machine.parts import Parts
from tests.answers import at_once
from tests.reports import a_warning
from worker.pace import MAX_SAVED_S, SHARE, RenderPace
from worker.reply import NotYetError, Reply
from worker.request_queue import FIRST_SPEEDS
from worker.scheduler import Scheduler
from worker.serve import MAX_REQUEST_BYTES, RequestServer

SCENE = "0" * 32
SECRET = "a secret of at least 32 characters"


def answer(request: RenderRequest | ExportRequest) -> Reply:
    if request.t == 1:
        raise InputError("t", "1 is odd.", "Use another.")
    if request.t == 2:
        raise SceneError("It is damaged.")
    if request.t == 3:
        raise ZeroDivisionError("patient Smith")
    if request.t == 4:
        raise NotYetError("Nothing to show yet.")
    return Reply(b"image", "image/png", request.t, (a_warning("a warning"),), iteration=12)


@contextmanager
def connected(endpoint: str, keys: RenderKeys | None = None, server: bytes = b"") -> Iterator[zmq.Socket[bytes]]:
    """A DEALER to the endpoint, with CURVE if there are keys."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.DEALER)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.RCVTIMEO, 5000)
    socket.setsockopt(zmq.SNDTIMEO, 5000)
    if keys is not None:
        socket.curve_serverkey, socket.curve_publickey, socket.curve_secretkey = server, keys.public, keys.secret
    socket.connect(endpoint)
    try:
        yield socket
    finally:
        socket.close()
        context.term()


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{short_socket_path(tmp_path, 'worker.sock')}"


@pytest.fixture
def socket(endpoint: str) -> Iterator[zmq.Socket[bytes]]:
    with RequestServer(endpoint, at_once(answer)), connected(endpoint) as socket:
        yield socket


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
    assert head.render_ms > 0
    expected = WorkerReply(media_type="image/png", t=0.5, warnings=(a_warning("a warning"),), iteration=12)
    assert head.model_copy(update={"render_ms": 0.0}) == expected


@pytest.mark.parametrize(
    ("t", "kind", "field"), [(1, "input", "t"), (2, "scene", "scene"), (3, "internal", None), (4, "not-yet", "scene")]
)
def test_an_error_is_reported_and_the_next_request_is_answered(
    socket: zmq.Socket[bytes], t: float, kind: str, field: str | None
) -> None:
    head, body = ask(socket, request(t))
    assert head.error is not None
    assert (head.error.kind, head.error.field, body) == (kind, field, b"")
    assert "Smith" not in head.error.problem
    assert ask(socket, request(0))[0].error is None


@pytest.mark.parametrize("document", [b"", b"{}", b'{"request": {"kind": "shutdown"}}', b"\xff\xfe"])
def test_a_request_that_does_not_fit_gets_an_error(socket: zmq.Socket[bytes], document: bytes) -> None:
    head, _ = ask(socket, document)
    assert head.error is not None
    assert head.error.kind == "internal"
    assert ask(socket, request(0))[0].error is None


@pytest.mark.parametrize("parts", [[b""], [b"1", b""], [b"1", b"2", b"3", b"4"], [b"\xff" * 300, b"\x00" * 5000]])
def test_a_message_of_any_shape_leaves_the_thread_alive(socket: zmq.Socket[bytes], parts: list[bytes]) -> None:
    socket.send_multipart(parts)
    if len(parts) == 2:
        head = WorkerReply.model_validate_json(socket.recv_multipart()[1])
        assert head.error is not None
    assert ask(socket, request(0))[0].error is None


def test_who_sends_too_much_is_cut_off_and_others_are_answered(endpoint: str) -> None:
    with RequestServer(endpoint, at_once(answer)), connected(endpoint) as flooding, connected(endpoint) as other:
        flooding.send_multipart([b"1", b" " * (MAX_REQUEST_BYTES + 1)])
        assert ask(other, request(0))[0].error is None


def test_a_request_whose_cost_cannot_be_told_gets_an_error_and_the_next_is_answered(endpoint: str) -> None:
    def cost(asked: RenderRequest) -> float:
        return 1 / asked.t

    with RequestServer(endpoint, at_once(answer, cost=cost)), connected(endpoint) as socket:
        head, _ = ask(socket, request(0))
        assert head.error is not None
        assert head.error.kind == "internal"
        assert ask(socket, request(0.5))[0].error is None


def test_requests_of_one_caller_are_answered_in_their_order(socket: zmq.Socket[bytes]) -> None:
    for number in range(20):
        socket.send_multipart([bytes([number]), request(0)])
    assert [socket.recv_multipart()[0] for _ in range(20)] == [bytes([number]) for number in range(20)]


def test_what_is_to_be_done_between_requests_is_done_and_its_failure_ends_nothing(endpoint: str) -> None:
    called = threading.Event()

    def fail() -> None:
        called.set()
        raise OSError("the disk")

    with RequestServer(endpoint, at_once(answer), between=fail), connected(endpoint) as socket:
        assert called.wait(5)
        assert ask(socket, request(0))[0].error is None


@pytest.fixture
def tcp_endpoint() -> str:
    with contextlib.closing(socket_module.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{probe.getsockname()[1]}"


def test_over_tcp_the_services_of_the_same_secret_are_answered(tcp_endpoint: str) -> None:
    with (
        RequestServer(tcp_endpoint, at_once(answer), render_secret=SECRET),
        connected(tcp_endpoint, service_keys(SECRET), worker_keys(SECRET).public) as socket,
    ):
        assert ask(socket, request(0))[1] == b"image"


@pytest.mark.parametrize(
    ("keys", "server"),
    [
        (None, b""),
        (service_keys("another secret of 32 characters."), worker_keys(SECRET).public),
        (worker_keys(SECRET), worker_keys(SECRET).public),
        (service_keys(SECRET), worker_keys("another secret of 32 characters.").public),
    ],
)
def test_over_tcp_no_other_caller_is_answered(tcp_endpoint: str, keys: RenderKeys | None, server: bytes) -> None:
    asked: list[RenderRequest | ExportRequest] = []

    def note(request: RenderRequest | ExportRequest) -> Reply:
        asked.append(request)
        return answer(request)

    with (
        RequestServer(tcp_endpoint, at_once(note), render_secret=SECRET),
        connected(tcp_endpoint, keys, server) as socket,
    ):
        socket.setsockopt(zmq.RCVTIMEO, 300)
        socket.setsockopt(zmq.SNDTIMEO, 300)
        with pytest.raises(zmq.Again):  # of the sending, if the handshake has failed before
            ask(socket, request(0))
    assert asked == []


def test_tcp_without_a_secret_is_refused_before_anything_listens() -> None:
    with pytest.raises(InputError, match="INTRASPLAT_RENDER_SECRET"):
        RequestServer("tcp://127.0.0.1:7000", at_once(answer))


def test_keys_follow_from_the_secret_and_each_side_has_its_own() -> None:
    assert service_keys(SECRET) == service_keys(SECRET)
    assert len({service_keys(SECRET).public, worker_keys(SECRET).public, service_keys(SECRET + "!").public}) == 3
    assert service_keys(SECRET).secret.decode() not in repr(service_keys(SECRET))


def test_who_asks_while_the_worker_rests_is_answered_afterwards(endpoint: str) -> None:
    pace = RenderPace()
    with RequestServer(endpoint, at_once(answer, pace)), connected(endpoint) as socket, pace.training():
        pace.charge(MAX_SAVED_S + 0.1 * SHARE)
        start_s = time.monotonic()
        assert ask(socket, request(0.25))[1] == b"image"
        assert time.monotonic() - start_s > 0.08


class Studio:
    """Renders whose cost is their t, each in parts that are made when they are let go."""

    def __init__(self, endpoint: str) -> None:
        scheduler = Scheduler(self.answer, RenderPace(), cost=lambda each: each.t * FIRST_SPEEDS[0], max_wait_s=40.0)
        self.server = RequestServer(endpoint, scheduler)
        self.begun: list[float] = []
        self.has_begun = threading.Event()
        self.parts = threading.Semaphore(0)

    def answer(self, request: Any, level: int) -> Parts[Reply]:
        self.begun.append(request.t)
        self.has_begun.set()
        for _ in range(2 if request.t >= 1 else 0):
            assert self.parts.acquire(timeout=5)
            spin_s = time.thread_time() + 0.01
            while time.thread_time() < spin_s:
                pass
            yield
        return Reply(str(request.t).encode(), "image/png", request.t)


def send(socket: zmq.Socket[bytes], number: int, t: float) -> None:
    socket.send_multipart([bytes([number]), request(t)])


def give_up(socket: zmq.Socket[bytes], number: int) -> None:
    socket.send_multipart([bytes([number]), WorkerRequest(request=CancelRequest()).model_dump_json().encode()])


def test_a_small_view_is_answered_while_a_large_one_is_made(endpoint: str) -> None:
    studio = Studio(endpoint)
    with studio.server, connected(endpoint) as socket, connected(endpoint) as other:
        send(socket, 1, 8.0)
        assert studio.has_begun.wait(5)
        send(other, 2, 0.25)
        studio.parts.release(1)
        assert other.recv_multipart()[0] == bytes([2])
        studio.parts.release(1)
        assert socket.recv_multipart()[0] == bytes([1])


def test_what_its_caller_gives_up_is_not_begun_or_ends_after_its_part(endpoint: str) -> None:
    studio = Studio(endpoint)
    with studio.server, connected(endpoint) as socket:
        send(socket, 1, 8.0)
        assert studio.has_begun.wait(5)
        send(socket, 2, 9.0)
        send(socket, 3, 10.0)
        give_up(socket, 2)
        give_up(socket, 1)
        time.sleep(0.1)
        studio.parts.release(3)  # one for the first, two for the third
        assert socket.recv_multipart()[0] == bytes([3])
    assert studio.begun == [8.0, 10.0]


def test_who_asks_the_same_at_the_same_time_shares_one_answer(endpoint: str) -> None:
    studio = Studio(endpoint)
    with studio.server, connected(endpoint) as socket, connected(endpoint) as other:
        send(socket, 1, 2.0)
        assert studio.has_begun.wait(5)
        send(socket, 2, 3.0)
        send(other, 3, 3.0)
        send(other, 4, 2.0)
        time.sleep(0.1)
        studio.parts.release(4)
        assert [socket.recv_multipart()[0][0] for _ in range(2)] == [1, 2]
        assert {other.recv_multipart()[0][0] for _ in range(2)} == {3, 4}
    assert studio.begun == [2.0, 3.0]


def test_whose_turn_is_too_far_off_is_told_when_to_come_back(endpoint: str) -> None:
    studio = Studio(endpoint)
    with studio.server, connected(endpoint) as socket:
        send(socket, 1, 45.0)
        assert studio.has_begun.wait(5)
        send(socket, 2, 44.0)
        studio.parts.release(1)
        number, head, _ = socket.recv_multipart()
        error = WorkerReply.model_validate_json(head).error
        assert number == bytes([2])
        assert error is not None
        assert error.kind == "busy"
        assert error.retry_after_s == pytest.approx(45.0, abs=0.5)
        studio.parts.release(1)
        assert socket.recv_multipart()[0] == bytes([1])


def test_a_server_that_ends_abandons_the_answer_that_is_being_made(endpoint: str) -> None:
    ended = threading.Event()

    def answer_slowly(request: Any, level: int) -> Parts[Reply]:
        try:
            while True:
                yield
        finally:
            ended.set()

    with RequestServer(endpoint, Scheduler(answer_slowly, RenderPace())), connected(endpoint) as socket:
        socket.send_multipart([b"1", request(0.5)])
        time.sleep(0.1)
    assert ended.is_set()


def test_an_address_that_is_taken_is_an_error_with_a_remedy(tcp_endpoint: str) -> None:
    with (
        RequestServer(tcp_endpoint, at_once(answer), render_secret=SECRET),
        pytest.raises(UnavailableError, match="INTRASPLAT_RENDER_ENDPOINT"),
        RequestServer(tcp_endpoint, at_once(answer), render_secret=SECRET),
    ):
        pass
