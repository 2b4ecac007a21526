"""Chooses the worker for a render, and another one if the first does not answer."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import hashlib
import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import zmq.asyncio
from opentelemetry.trace import SpanKind
from pydantic import TypeAdapter, ValidationError
from starlette.concurrency import run_in_threadpool

from contract.queue.interface import WORKER_TTL_S, Queue
from contract.runtime import traces
from contract.wire.cameras import CamerasRequest
from contract.wire.rendering import CutRequest, ExportRequest, PushRequest, ReplyError, WorkerAddress, WorkerReply
from intrasplat.errors import UnavailableError
from intrasplat.files.durable import replace_file
from intrasplat.formats import EXPORT_FORMATS, check_extra
from service.connection import Answer, AnyRequest, Connection, Reached, WorkerGoneError

WORKER_REMEDY = "Ask again in some seconds; if it stays so, start one with `intrasplat up` or `intrasplat worker`."
ADDRESSES_VALID_S = 1.0
"""How long the list of live workers is valid before the queue is read again, during renders."""
KNOWN_PERIOD_S = 5.0
"""How often the list is read between renders, so that it is known when the queue becomes unreachable."""
READ_PATIENCE_S = 0.5
"""How long a render waits for a newer list if the known one is older than the lifetime of an announcement."""

ADDRESSES = TypeAdapter(list[WorkerAddress])

logger = logging.getLogger("intrasplat.service")


class Renderer(Protocol):
    """Answers render and export requests."""

    async def ask(self, request: AnyRequest, worker: str | None = None, body: bytes | None = None) -> Answer:
        """The answer, from the worker at endpoint `worker` if given. body: of a PushRequest.

        Raises:
            UnavailableError: no answer comes in time.
        """
        ...

    async def reachable(self, workers: Sequence[WorkerAddress], timeout_s: float) -> list[WorkerAddress]:
        """The workers that can be reached within timeout_s."""
        ...

    async def missing_extras(self) -> frozenset[str]:
        """The extras that no live worker has; none where no worker is known."""
        ...

    async def run(self) -> None:
        """Keep the list of workers up to date, until cancelled."""
        ...

    async def close(self) -> None:
        """Close all connections."""
        ...


class ZmqRenderer:
    """Asks the live workers that the queue lists.

    The worker that runs a job renders it, and the process that follows a live feed answers for that alone. Any other
    worker can render a finished scene: an idle one that has it in memory is preferred, else always the same one, which
    then loads it. If that worker is gone, silent or busy, another is tried.

    known: a file with the workers' addresses, for a service that starts while the queue is unreachable.
    """

    def __init__(
        self, queue: Queue, timeout_s: float, render_secret: str | None = None, known: Path | None = None
    ) -> None:
        self._queue = queue
        self._timeout_s = timeout_s
        self._render_secret = render_secret
        self._context: zmq.asyncio.Context | None = None
        self._connections: dict[str, Connection] = {}
        self._known = known
        self._addresses: list[WorkerAddress] = [] if known is None else _read_known(known)
        self._read_s = self._heard_s = -math.inf
        self._reading: asyncio.Task[None] | None = None

    async def ask(self, request: AnyRequest, worker: str | None = None, body: bytes | None = None) -> Answer:
        workers = await self._workers_for(request)
        if worker is not None:
            workers = [each for each in workers if each.endpoint == worker]
            if not workers:
                raise UnavailableError("The worker of this export has ended.", "Ask for the export again.")
        if not workers:
            doing = "follows the feed" if _is_of_feed(request) else "runs job"
            problem = f"No worker {doing} {request.scene_id} yet."
            not_yet = ReplyError(kind="not-yet", problem=problem, field="scene", remedy="Ask again in a second.")
            return Answer(WorkerReply(error=not_yet), b"")
        until_s = time.monotonic() + self._timeout_s
        first, *others = workers
        if others:
            with contextlib.suppress(WorkerGoneError, TimeoutError):
                async with asyncio.timeout(self._timeout_s / 2):
                    answer = await self._ask(first, request, body, patiently=False)
                if answer.head.error is None or answer.head.error.kind != "busy":
                    return answer
            first = others[0]
        try:
            async with asyncio.timeout(until_s - time.monotonic()):
                return await self._ask(first, request, body)
        except TimeoutError:
            problem = f"The worker did not answer within {self._timeout_s:g} s."
            raise UnavailableError(problem, _remedy(first)) from None
        except WorkerGoneError:
            raise UnavailableError("The worker ended before it answered.", _remedy(first)) from None

    async def _ask(
        self, address: WorkerAddress, request: AnyRequest, body: bytes | None, *, patiently: bool = True
    ) -> Answer:
        connection = await self._connection(address)
        with traces.span("ask worker", kind=SpanKind.CLIENT, worker=address.name):
            answer = await connection.ask(request, body, patiently=patiently)
        return dataclasses.replace(answer, worker=address.endpoint)

    async def reachable(self, workers: Sequence[WorkerAddress], timeout_s: float) -> list[WorkerAddress]:
        there = await asyncio.gather(*(self._is_there(each, timeout_s) for each in workers))
        return [worker for worker, is_there in zip(workers, there, strict=True) if is_there]

    async def _is_there(self, address: WorkerAddress, timeout_s: float) -> bool:
        try:
            async with asyncio.timeout(timeout_s):
                await (await self._connection(address)).reach(patiently=False)
        except (WorkerGoneError, UnavailableError, TimeoutError):
            return False
        return True

    async def missing_extras(self) -> frozenset[str]:
        try:
            return _missing(await self._live())
        except UnavailableError:
            return frozenset()

    async def run(self) -> None:
        while True:
            await asyncio.sleep(KNOWN_PERIOD_S)
            with contextlib.suppress(UnavailableError):
                await self._live()

    async def close(self) -> None:
        if self._reading is not None:
            await self._reading
        for endpoint in list(self._connections):
            await self._connections.pop(endpoint).close()
        if self._context is not None:
            self._context.term()
            self._context = None

    async def _workers_for(self, request: AnyRequest) -> list[WorkerAddress]:
        """The workers that can answer, best first; empty for a job that no worker runs, or a feed that none follows.

        Raises:
            UnavailableError: there is no worker at all.
            MissingExtraError: no worker has the extra that an export needs.
        """
        addresses = await self._live()
        if request.attempt is not None and not _is_of_feed(request):
            others = [each for each in addresses if each.feed_id is None]
            if not others:
                raise UnavailableError("No worker is ready.", WORKER_REMEDY)
            if isinstance(request, ExportRequest):
                others = _able(others, request)
            return sorted(others, key=lambda address: self._preference(address, request.scene_id), reverse=True)
        there = [each for each in addresses if _has(each, request)]
        return there or [each for each in await self._live(reread=True) if _has(each, request)]

    def _preference(self, address: WorkerAddress, scene_id: str) -> tuple[bool, bool, bool, bool, bytes]:
        """Sort key: prefers workers that answer, are idle and have the scene; then rendezvous hashing."""
        connection = self._connections.get(address.endpoint)
        place = hashlib.sha256(f"{scene_id} {address.name}".encode()).digest()
        is_down = connection is not None and connection.state in (Reached.DOWN, Reached.REFUSED)
        return not is_down, address.job_id is None, scene_id in address.scenes, address.renders_only, place

    async def _connection(self, address: WorkerAddress) -> Connection:
        endpoint = address.endpoint
        if endpoint in self._connections and self._connections[endpoint].state is Reached.REFUSED:
            await self._connections.pop(endpoint).close()
        if endpoint not in self._connections:
            self._context = self._context or zmq.asyncio.Context()
            self._connections[endpoint] = Connection(self._context, endpoint, self._render_secret)
        return self._connections[endpoint]

    async def _live(self, *, reread: bool = False) -> list[WorkerAddress]:
        """The live workers, or those that were known when the queue became unreachable.

        A render waits for the queue if no worker is known or the list must be read again. If the list is too old, it
        waits READ_PATIENCE_S.
        """
        age_s = time.monotonic() - self._read_s
        if age_s > ADDRESSES_VALID_S or reread or not self._addresses:
            if self._reading is None or self._reading.done():
                self._reading = asyncio.create_task(self._read_addresses())
            if reread or not self._addresses:
                await asyncio.shield(self._reading)
            elif age_s > WORKER_TTL_S:
                await asyncio.wait({self._reading}, timeout=READ_PATIENCE_S)
        if not self._addresses:
            raise UnavailableError("No worker is ready.", WORKER_REMEDY)
        return self._addresses

    async def _read_addresses(self) -> None:
        try:
            addresses = await run_in_threadpool(self._queue.workers)
        except UnavailableError as error:
            # Renders do not need the queue. A request shows whether a worker is still alive.
            logger.warning("the queue does not answer; using the workers known before: %s", error.problem)
            self._read_s = self._heard_s = time.monotonic()
            return
        now_s = self._read_s = time.monotonic()
        # A queue that has just returned knows no worker until they announce themselves again.
        if addresses or now_s - self._heard_s > WORKER_TTL_S:
            await self._remember(addresses)
            self._addresses, self._heard_s = addresses, now_s
        live = {address.endpoint for address in self._addresses}
        for endpoint in self._connections.keys() - live:
            if self._connections[endpoint].is_idle:
                await self._connections.pop(endpoint).close()

    async def _remember(self, addresses: list[WorkerAddress]) -> None:
        """Store the workers' addresses, unless there are none or they have not changed."""
        if self._known is None or not addresses or _places(addresses) == _places(self._addresses):
            return
        content = ADDRESSES.dump_json(_places(addresses))
        with contextlib.suppress(OSError):  # on a full disk they are known only until this service ends
            await run_in_threadpool(replace_file, self._known, content)


def _is_of_feed(request: AnyRequest) -> bool:
    if isinstance(request, CutRequest | PushRequest):
        return True
    return not isinstance(request, CamerasRequest) and request.moment is not None


def _has(address: WorkerAddress, request: AnyRequest) -> bool:
    """Whether the worker follows the feed, or runs the job."""
    return request.scene_id == (address.feed_id if _is_of_feed(request) else address.job_id)


def _able(workers: list[WorkerAddress], request: ExportRequest) -> list[WorkerAddress]:
    """Those that have what the export needs. Raises MissingExtraError: none has."""
    check_extra(request.format, _missing(workers))
    known = EXPORT_FORMATS.get(request.format)
    return [each for each in workers if known is None or known.extra not in each.missing_extras]


def _missing(workers: Sequence[WorkerAddress]) -> frozenset[str]:
    """The extras that all of them lack."""
    lacks = [frozenset(each.missing_extras) for each in workers if each.feed_id is None]
    return frozenset.intersection(*lacks) if lacks else frozenset()


def _places(addresses: list[WorkerAddress]) -> list[WorkerAddress]:
    """The lasting part of the addresses, without what the workers are doing now."""
    return [each.model_copy(update={"job_id": None, "scenes": ()}) for each in addresses]


def _read_known(path: Path) -> list[WorkerAddress]:
    try:
        return ADDRESSES.validate_json(path.read_bytes())
    except (OSError, ValidationError):
        return []


def _remedy(address: WorkerAddress) -> str:
    if address.endpoint.startswith("tcp:"):
        return "Look at the worker's log, and see that INTRASPLAT_RENDER_SECRET is the same here and there."
    return "Ask again, or look at the worker's log."
