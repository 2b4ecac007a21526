"""The way from the service to the worker that renders: one lasting ZeroMQ connection a worker, many requests on it."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import time
import zlib
from dataclasses import dataclass
from typing import Protocol

import zmq
import zmq.asyncio
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool

from contract.errors import UnavailableError
from contract.queue import Queue
from contract.rendering import ExportRequest, RenderRequest, WorkerAddress, WorkerReply, WorkerRequest

WORKER_REMEDY = "Start one with `intrasplat up`, or `python -m worker consume`."
ADDRESSES_VALID_S = 1.0
"""How long the list of live workers is used before the queue is asked again."""

logger = logging.getLogger("intrasplat.service")


@dataclass(frozen=True)
class Answer:
    """A worker's answer: its head, and the encoded image or file."""

    head: WorkerReply
    body: bytes


class Renderer(Protocol):
    """Whoever can answer render and export requests."""

    async def ask(self, request: RenderRequest | ExportRequest) -> Answer:
        """The answer; raises UnavailableError if no worker gives one in time."""
        ...

    async def close(self) -> None:
        """Let go of connections."""
        ...


class ZmqRenderer:
    """Asks the live workers that the queue lists; the same scene goes to the same worker, which keeps it loaded."""

    def __init__(self, queue: Queue, timeout_s: float) -> None:
        self._queue = queue
        self._timeout_s = timeout_s
        self._context: zmq.asyncio.Context | None = None
        self._connections: dict[str, _Connection] = {}
        self._addresses: list[WorkerAddress] = []
        self._addresses_until_s = 0.0

    async def ask(self, request: RenderRequest | ExportRequest) -> Answer:
        address = await self._choose(request.scene_id)
        connection = self._connections.get(address.endpoint)
        if connection is None:
            self._context = self._context or zmq.asyncio.Context()
            connection = self._connections[address.endpoint] = _Connection(self._context, address.endpoint)
        try:
            return await asyncio.wait_for(connection.ask(WorkerRequest(request=request)), self._timeout_s)
        except TimeoutError:
            problem = f"The worker did not answer within {self._timeout_s:g} s."
            raise UnavailableError(problem, "Ask again, or look at the worker's log.") from None

    async def close(self) -> None:
        for connection in self._connections.values():
            await connection.close()
        self._connections.clear()
        if self._context is not None:
            self._context.term()
            self._context = None

    async def _choose(self, scene_id: str) -> WorkerAddress:
        if time.monotonic() > self._addresses_until_s:
            try:
                self._addresses = await run_in_threadpool(self._queue.workers)
            except UnavailableError as error:
                # Renders do not need the queue: go on with the workers that were known.
                logger.warning("the queue does not answer; using the workers known before: %s", error.problem)
            self._addresses_until_s = time.monotonic() + ADDRESSES_VALID_S
        if not self._addresses:
            self._addresses_until_s = 0.0
            raise UnavailableError("No worker is ready.", WORKER_REMEDY)
        return self._addresses[zlib.crc32(scene_id.encode()) % len(self._addresses)]


class _Connection:
    """A DEALER to one worker; answers find their request by its id."""

    def __init__(self, context: zmq.asyncio.Context, endpoint: str) -> None:
        self._socket = context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(endpoint)
        self._ids = itertools.count()
        self._waiting: dict[bytes, asyncio.Future[Answer]] = {}
        self._reader = asyncio.create_task(self._read())

    async def ask(self, request: WorkerRequest) -> Answer:
        request_id = next(self._ids).to_bytes(8, "big")
        future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[request_id] = future
        try:
            await self._socket.send_multipart([request_id, request.model_dump_json().encode()])
            return await future
        finally:
            del self._waiting[request_id]

    async def close(self) -> None:
        self._reader.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._reader
        self._socket.close()

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
                future.set_result(Answer(WorkerReply.model_validate_json(head), body))
            except ValidationError:
                problem = "The worker's answer cannot be read."
                future.set_exception(UnavailableError(problem, "Start service and worker from the same version."))
