"""One persistent ZeroMQ connection from the service to a worker, with many requests on it."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

import zmq
import zmq.asyncio
from pydantic import ValidationError
from zmq.utils.monitor import parse_monitor_message

from contract.access.render_keys import service_keys, worker_keys
from contract.runtime import traces
from contract.wire.rendering import CancelRequest, FeedRequest, SceneRequest, WorkerReply, WorkerRequest
from intrasplat.errors import UnavailableError

CONNECT_TIMEOUT_S = 2.0
"""How long to try to connect. A worker that listens answers in milliseconds; one that has just died never does."""

LAST_ANSWERS_S = 0.05

HEARTBEAT_MS, SILENCE_MS = 2000, 6000
"""ZeroMQ's heartbeat interval and timeout: they detect a lost machine or a stopped process by its silence."""

UP = zmq.Event.HANDSHAKE_SUCCEEDED
DOWN = zmq.Event.DISCONNECTED | zmq.Event.CONNECT_RETRIED
REFUSED = zmq.Event.HANDSHAKE_FAILED_AUTH | zmq.Event.HANDSHAKE_FAILED_PROTOCOL | zmq.Event.HANDSHAKE_FAILED_NO_DETAIL

AnyRequest: TypeAlias = SceneRequest | FeedRequest

logger = logging.getLogger("intrasplat.service")


@dataclass(frozen=True)
class Answer:
    """A worker's answer: its head, the encoded image or file, and the worker's endpoint if known."""

    head: WorkerReply
    body: bytes
    worker: str | None = None


class WorkerGoneError(Exception):
    """The worker cannot be reached, or disconnected before it answered."""


class Reached(StrEnum):
    """The state of the connection to the worker."""

    TRYING = "trying"
    UP = "up"
    DOWN = "down"
    """Not connected; ZeroMQ keeps trying."""
    REFUSED = "refused"
    """The two sides have different secrets. ZeroMQ then gives up: a retry needs a new connection."""


class Connection:
    """A DEALER socket to one worker; an answer carries the id of its request."""

    def __init__(self, context: zmq.asyncio.Context, endpoint: str, render_secret: str | None = None) -> None:
        if endpoint.startswith("tcp:") and render_secret is None:
            problem = f"A worker answers at {endpoint}, and no secret is set here."
            raise UnavailableError(problem, "Set INTRASPLAT_RENDER_SECRET to the one that the worker has.")
        self.state = Reached.TRYING
        self._changed = asyncio.Event()
        self._ids = itertools.count()
        self._waiting: dict[bytes, asyncio.Future[Answer]] = {}
        self._cancelling: set[asyncio.Task[None]] = set()
        self._socket = context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
        self._socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, SILENCE_MS)
        if endpoint.startswith("tcp:"):
            assert render_secret is not None
            own = service_keys(render_secret)
            self._socket.curve_serverkey = worker_keys(render_secret).public
            self._socket.curve_publickey, self._socket.curve_secretkey = own.public, own.secret
        self._monitor = self._socket.get_monitor_socket(UP | DOWN | REFUSED)
        self._socket.connect(endpoint)
        self._tasks = [asyncio.create_task(self._read()), asyncio.create_task(self._watch())]

    async def ask(self, request: AnyRequest, body: bytes | None = None, *, patiently: bool = True) -> Answer:
        """The worker's answer. body: of a PushRequest. patiently: wait a moment for a worker that is down, because
        there is no other.

        The worker gets all requests at once and chooses their order. Cancelling this call cancels the request.

        Raises:
            WorkerGoneError: no answer will come.
            UnavailableError: this version cannot read the answer.
        """
        document = WorkerRequest(request=request, trace=traces.traceparent()).model_dump_json().encode()
        await self.reach(patiently=patiently)
        request_id = next(self._ids).to_bytes(8, "big")
        future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[request_id] = future
        try:
            await self._socket.send_multipart([request_id, document, *([] if body is None else [body])])
            return await future
        except asyncio.CancelledError:
            task = asyncio.create_task(self._cancel(request_id))
            self._cancelling.add(task)
            task.add_done_callback(self._cancelling.discard)
            raise
        finally:
            del self._waiting[request_id]

    @property
    def is_idle(self) -> bool:
        """Whether no caller waits for an answer."""
        return not self._waiting

    async def close(self) -> None:
        """Close the connection. Callers that still wait get WorkerGoneError."""
        for task in [*self._tasks, *self._cancelling]:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        _give_up(self._waiting.values())
        self._socket.disable_monitor()
        self._monitor.close()
        self._socket.close()

    async def _cancel(self, request_id: bytes) -> None:
        """Tell the worker that no caller waits for this answer any more."""
        if self.state is Reached.UP:
            document = WorkerRequest(request=CancelRequest()).model_dump_json().encode()
            await self._socket.send_multipart([request_id, document])

    async def reach(self, *, patiently: bool) -> None:
        """Return when the worker is connected; WorkerGoneError if it is not. patiently: as in ask()."""
        hopeless = {Reached.REFUSED} if patiently else {Reached.REFUSED, Reached.DOWN}
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                while self.state is not Reached.UP:
                    if self.state in hopeless:
                        raise WorkerGoneError
                    await self._changed.wait()
        except TimeoutError:
            self.state = Reached.DOWN
            raise WorkerGoneError from None

    async def _watch(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            event = parse_monitor_message(await self._monitor.recv_multipart())["event"]
            if event == UP:
                self.state = Reached.UP
            elif event & REFUSED or self.state is Reached.REFUSED:
                self.state = Reached.REFUSED
            else:
                self.state = Reached.DOWN
            if self.state is not Reached.UP:
                # Unanswered requests were lost with the worker; an answer that has just arrived is read first.
                loop.call_later(LAST_ANSWERS_S, _give_up, list(self._waiting.values()))
            self._changed.set()  # wakes the present waiters
            self._changed.clear()

    async def _read(self) -> None:
        while True:
            frames = await self._socket.recv_multipart()
            if len(frames) != 3:
                logger.warning("an answer of %d parts was ignored", len(frames))
                continue
            request_id, head, body = frames
            future = self._waiting.get(request_id)
            if future is None or future.done():  # its caller has given up
                continue
            try:
                future.set_result(Answer(WorkerReply.model_validate_json(head, extra="ignore"), body))
            except ValidationError:
                problem = "The worker's answer cannot be read."
                future.set_exception(UnavailableError(problem, "Start service and worker from the same version."))


def _give_up(futures: Iterable[asyncio.Future[Answer]]) -> None:
    for future in futures:
        if not future.done():
            future.set_exception(WorkerGoneError())
