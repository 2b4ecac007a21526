"""Whom a render is asked of: who runs the job, who holds the scene, somebody else if that one is gone or mute."""

from __future__ import annotations

import asyncio
import contextlib
import socket as socket_module
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event
from typing import Any, TypeVar

import pytest
import zmq

from contract.queue.embedded import short_socket_path
from contract.wire.rendering import ExportRequest, RenderRequest, WorkerAddress
from intrasplat.errors import UnavailableError
from service.connection import Answer
from service.renderer import ZmqRenderer
from tests.answers import at_once
from tests.memory_queue import MemoryQueue
from worker.reply import Reply
from worker.serve import RequestServer

SCENES = [f"{number:032x}" for number in range(40)]
SECRET, ANOTHER = "a secret of at least 32 characters", "another secret of 32 characters!"
TIMEOUT_S = 5.0
Result = TypeVar("Result")


class LeavingQueue(MemoryQueue):
    """Goes away when it is told to; when it is back, it knows of no worker until they speak again."""

    is_away = False

    def workers(self) -> list[WorkerAddress]:
        if self.is_away:
            raise UnavailableError("The queue does not answer.", "Start it.")
        return super().workers()


class Workers:
    """Workers that answer with their name, and the queue that lists them."""

    def __init__(self, folder: Path) -> None:
        self.queue = LeavingQueue()
        self.asked: Counter[str] = Counter()
        self._folder = folder
        self._stack = ExitStack()

    def endpoint(self, name: str) -> str:
        return f"ipc://{short_socket_path(self._folder, f'{name}.sock')}"

    def start(self, name: str, **about: Any) -> RequestServer:
        """about: of its WorkerAddress."""

        def answer(request: RenderRequest | ExportRequest) -> Reply:
            self.asked[name] += 1
            return Reply(name.encode(), "image/png", request.t)

        server = RequestServer(self.endpoint(name), at_once(answer))
        self._stack.enter_context(server)
        self.announce(name, self.endpoint(name), **about)
        return server

    def announce(self, name: str, endpoint: str, **about: Any) -> None:
        self.queue.announce(WorkerAddress(name=name, endpoint=endpoint, device="cpu", **about))

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
def workers(tmp_path: Path) -> Iterator[Workers]:
    made = Workers(tmp_path)
    yield made
    made.close()


def asking(
    workers: Workers,
    ask: Callable[[ZmqRenderer], Awaitable[Result]],
    *,
    timeout_s: float = TIMEOUT_S,
    secret: str | None = None,
) -> Result:
    """What comes of asking a renderer in an event loop of its own."""

    async def run() -> Result:
        renderer = ZmqRenderer(workers.queue, timeout_s, secret)
        try:
            return await ask(renderer)
        finally:
            await renderer.close()

    return asyncio.run(run())


def scene(scene_id: str, t: float = 0.0) -> RenderRequest:
    return RenderRequest(scene_id=scene_id, attempt=1, t=t)


def answer_to(workers: Workers, request: RenderRequest, timeout_s: float = TIMEOUT_S) -> Answer:
    async def ask(renderer: ZmqRenderer) -> Answer:
        return await renderer.ask(request)

    return asking(workers, ask, timeout_s=timeout_s)


def test_the_workers_that_were_known_are_asked_for_as_long_as_the_queue_is_away(
    workers: Workers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.renderer.ADDRESSES_VALID_S", 0.0)
    monkeypatch.setattr("service.renderer.WORKER_TTL_S", 0.05)
    workers.start("worker-1", job_id=SCENES[1])

    async def ask(renderer: ZmqRenderer) -> list[bytes]:
        running = RenderRequest(scene_id=SCENES[1], t=0)
        answers = [await renderer.ask(scene(SCENES[0]))]
        workers.queue.is_away = True
        for request in (scene(SCENES[0]), scene(SCENES[2]), running):
            await asyncio.sleep(0.1)
            answers.append(await renderer.ask(request))
        workers.queue.withdraw("worker-1")
        workers.queue.is_away = False
        answers.append(await renderer.ask(scene(SCENES[2])))  # the worker has not spoken to the new queue yet
        return [answer.body for answer in answers]

    assert asking(workers, ask) == [b"worker-1"] * 5


def test_a_running_job_is_asked_of_the_worker_that_runs_it(workers: Workers) -> None:
    for number in range(3):
        workers.start(f"worker-{number}", job_id=SCENES[number], scenes=(SCENES[0],))
    for number in range(3):
        answer = answer_to(workers, RenderRequest(scene_id=SCENES[number], t=0))
        assert answer.body == f"worker-{number}".encode()


def test_a_job_that_nobody_runs_is_not_there_yet(workers: Workers) -> None:
    workers.start("worker-1", job_id=SCENES[1])
    answer = answer_to(workers, RenderRequest(scene_id=SCENES[0], t=0))
    assert answer.head.error is not None
    assert answer.head.error.kind == "not-yet"
    assert not workers.asked


def test_a_scene_is_asked_of_who_holds_it(workers: Workers) -> None:
    for number in range(3):
        workers.start(f"worker-{number}", scenes=(SCENES[number],))
    for number in range(3):
        assert answer_to(workers, scene(SCENES[number])).body == f"worker-{number}".encode()


def test_a_scene_is_asked_of_a_worker_that_trains_only_if_no_other_is_there(workers: Workers) -> None:
    workers.start("trains", job_id=SCENES[1], scenes=(SCENES[0],))
    workers.start("idle", scenes=(SCENES[2],))
    workers.start("renders", renders_only=True)
    assert answer_to(workers, scene(SCENES[0])).body == b"renders"
    assert answer_to(workers, scene(SCENES[2])).body == b"idle"
    workers.queue.withdraw("renders")
    assert answer_to(workers, scene(SCENES[0])).body == b"idle"
    workers.queue.withdraw("idle")
    assert answer_to(workers, scene(SCENES[0])).body == b"trains"


def test_scenes_that_nobody_holds_are_spread_and_stay_where_they_were_when_another_worker_goes(
    workers: Workers,
) -> None:
    for number in range(3):
        workers.start(f"worker-{number}")

    async def ask_all(renderer: ZmqRenderer) -> dict[str, bytes]:
        return {each: (await renderer.ask(scene(each))).body for each in SCENES}

    before = asking(workers, ask_all)
    assert len(set(before.values())) == 3
    assert asking(workers, ask_all) == before
    workers.queue.withdraw("worker-1")
    after = asking(workers, ask_all)
    assert all(after[each] == name for each, name in before.items() if name != b"worker-1")


def test_each_of_many_viewers_gets_its_own_answer(workers: Workers) -> None:
    workers.start("worker-1")

    async def ask_all(renderer: ZmqRenderer) -> list[Answer]:
        return await asyncio.gather(*(renderer.ask(scene(SCENES[0], t=number / 300)) for number in range(300)))

    assert [answer.head.t for answer in asking(workers, ask_all)] == [number / 300 for number in range(300)]


def test_who_gives_up_is_not_rendered_for(workers: Workers) -> None:
    go_on, asked = Event(), list[float]()

    def answer(request: RenderRequest | ExportRequest) -> Reply:
        asked.append(request.t)
        assert go_on.wait(TIMEOUT_S)
        return Reply(b"", "image/png", request.t)

    async def ask(renderer: ZmqRenderer) -> None:
        many = [asyncio.create_task(renderer.ask(scene(SCENES[0], t=number))) for number in range(50)]
        while not asked:
            await asyncio.sleep(0.01)
        for task in many:
            task.cancel()
        await asyncio.gather(*many, return_exceptions=True)
        go_on.set()
        await renderer.ask(scene(SCENES[0], t=1000))

    with RequestServer(workers.endpoint("slow"), at_once(answer)):
        workers.announce("slow", workers.endpoint("slow"))
        asking(workers, ask)
    assert asked[-1] == 1000
    assert len(asked) < 10


@contextmanager
def mute(endpoint: str) -> Iterator[zmq.Socket[bytes]]:
    """A worker that listens and never answers."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.ROUTER)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.RCVTIMEO, int(TIMEOUT_S * 1000))
    socket.bind(endpoint)
    try:
        yield socket
    finally:
        socket.close()
        context.term()


def test_another_is_asked_if_nobody_listens_where_the_worker_was(workers: Workers) -> None:
    workers.start("alive")
    workers.announce("dead", workers.endpoint("dead"), scenes=(SCENES[0],))

    async def ask(renderer: ZmqRenderer) -> list[bytes]:
        return [(await renderer.ask(scene(SCENES[0]))).body for _ in range(3)]

    assert asking(workers, ask) == [b"alive"] * 3


def test_another_is_asked_if_the_worker_dies_over_the_request(workers: Workers) -> None:
    workers.start("alive")
    workers.announce("dying", workers.endpoint("dying"), scenes=(SCENES[0],))

    async def ask(renderer: ZmqRenderer) -> Answer:
        with mute(workers.endpoint("dying")) as socket:
            asked = asyncio.create_task(renderer.ask(scene(SCENES[0])))
            await asyncio.to_thread(socket.recv_multipart)
        return await asked

    assert asking(workers, ask, timeout_s=60.0).body == b"alive"


def test_another_is_asked_if_the_worker_says_nothing(workers: Workers) -> None:
    workers.start("alive")
    workers.announce("mute", workers.endpoint("mute"), scenes=(SCENES[0],))
    with mute(workers.endpoint("mute")):
        assert answer_to(workers, scene(SCENES[0]), timeout_s=0.6).body == b"alive"


def test_a_worker_that_comes_back_is_asked_again(workers: Workers) -> None:
    workers.announce("worker-1", workers.endpoint("worker-1"))

    async def ask(renderer: ZmqRenderer) -> Answer:
        with mute(workers.endpoint("worker-1")) as socket:
            lost = asyncio.create_task(renderer.ask(scene(SCENES[0])))
            await asyncio.to_thread(socket.recv_multipart)
        with pytest.raises(UnavailableError, match="ended"):
            await lost
        workers.start("worker-1")
        return await renderer.ask(scene(SCENES[0]))

    assert asking(workers, ask).body == b"worker-1"


def test_a_mute_worker_is_given_up_in_time(workers: Workers) -> None:
    workers.announce("mute", workers.endpoint("mute"))
    with mute(workers.endpoint("mute")), pytest.raises(UnavailableError, match=r"within 0\.2 s"):
        answer_to(workers, scene(SCENES[0]), timeout_s=0.2)


@pytest.fixture
def tcp_endpoint() -> str:
    with contextlib.closing(socket_module.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{probe.getsockname()[1]}"


def named(request: RenderRequest | ExportRequest) -> Reply:
    return Reply(b"over tcp", "image/png", request.t)


def test_over_tcp_the_same_secret_opens_and_another_is_named_as_the_cause(workers: Workers, tcp_endpoint: str) -> None:
    async def ask(renderer: ZmqRenderer) -> bytes:
        with (
            RequestServer(tcp_endpoint, at_once(named), render_secret=ANOTHER),
            pytest.raises(UnavailableError, match="INTRASPLAT_RENDER_SECRET"),
        ):
            await renderer.ask(scene(SCENES[0]))
        with RequestServer(tcp_endpoint, at_once(named), render_secret=SECRET):
            return (await renderer.ask(scene(SCENES[0]))).body

    workers.announce("worker-1", tcp_endpoint)
    assert asking(workers, ask, secret=SECRET) == b"over tcp"


def test_over_tcp_without_a_secret_its_absence_is_named(workers: Workers, tcp_endpoint: str) -> None:
    workers.announce("worker-1", tcp_endpoint)
    with pytest.raises(UnavailableError, match="INTRASPLAT_RENDER_SECRET"):
        answer_to(workers, scene(SCENES[0]))
