"""Answer the requests of contract/wire/rendering.py: a ZeroMQ ROUTER in a thread, as long as the device process lives.

The thread answers while the process trains and while it is idle. It reads all waiting messages, lets the scheduler
compute one part of one answer (worker/scheduler.py), sends completed answers, and reads again. A request that would
wait too long is refused, with the time at which to ask again. The permissions of its folder protect a unix socket. TCP
is encrypted, and only callers who know the installation's secret are answered.
"""

from __future__ import annotations

import logging
import math
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import urlsplit

import zmq
from pydantic import ValidationError
from zmq.auth.thread import ThreadAuthenticator

from contract.access.render_keys import service_keys, worker_keys
from contract.wire.rendering import (
    CancelRequest,
    CutRequest,
    PushRequest,
    ReplyError,
    WorkerReply,
    WorkerRequest,
)
from intrasplat.errors import ErrorCode, InputError, MissingExtraError, SceneError, UnavailableError
from worker.aside import Aside
from worker.job_errors import FAULT_REMEDY
from worker.reply import NotYetError, Reply
from worker.scheduler import Answered, Scheduler

POLL_MS = 50
"""How soon the thread notices that it must end."""

MAX_REQUEST_BYTES = 64 * 1024
"""Limit of one part of a message; a request has some hundred bytes. A caller who sends more loses the connection."""

BETWEEN_PERIOD_S = 1.0

MAX_READ = 1000
"""Most messages that are read before the next part is computed, so that a flood does not stop the answers."""

UNAVAILABLE_RETRY_S = 2.0
"""When to ask again for what is not available now, such as the disk or one more export."""

logger = logging.getLogger("intrasplat.worker")


class RequestServer:
    """A context manager that answers requests at `endpoint`.

    Args:
        scheduler: computes the answers. An InputError, SceneError or NotYetError is sent to the caller; any other error
            is logged, and the caller gets its type.
        aside: answers the cuts and pushes of a live feed; None: they are refused.
        between: called about once a second, in the same thread.
        render_secret: needed only for tcp://.
    """

    def __init__(
        self,
        endpoint: str,
        scheduler: Scheduler,
        *,
        aside: Aside | None = None,
        between: Callable[[], None] | None = None,
        render_secret: str | None = None,
    ) -> None:
        if endpoint.startswith("tcp:") and render_secret is None:
            raise InputError(
                "INTRASPLAT_RENDER_SECRET",
                f"{endpoint} needs a secret and has none.",
                "Set it, to 32 or more characters.",
            )
        self.endpoint = endpoint
        self._scheduler = scheduler
        self._aside = aside
        self._between = between
        self._between_at_s = 0.0
        self._render_secret = render_secret
        self._end = threading.Event()
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._authenticator: ThreadAuthenticator | None = None
        self._thread = threading.Thread(target=self._serve, name="renders", daemon=True)
        self._socket: zmq.Socket[bytes] | None = None
        self._poller = zmq.Poller()

    def __enter__(self) -> RequestServer:
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_REQUEST_BYTES)
        if self.endpoint.startswith("tcp:"):
            assert self._render_secret is not None
            self._authenticator = _encrypt(self._socket, self._render_secret)
        try:
            self._socket.bind(_bind_address(self.endpoint))
        except zmq.ZMQError as error:
            self._socket.close()
            self._close()
            problem = f"Renders cannot be answered at {self.endpoint} ({error.strerror})."
            raise UnavailableError(problem, "Free the address, or set another INTRASPLAT_RENDER_ENDPOINT.") from error
        self._poller.register(self._socket, zmq.POLLIN)
        if self._aside is not None:
            self._poller.register(self._aside.descriptor, zmq.POLLIN)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._end.set()
        self._thread.join()
        self._close()

    def _close(self) -> None:
        if self._authenticator is not None:
            self._authenticator.stop()
        self._context.term()

    def _serve(self) -> None:
        assert self._socket is not None
        while not self._end.is_set():
            self._do_between()
            self._read(min(self._scheduler.rest_s(), POLL_MS / 1e3))
            if (answered := self._scheduler.advance()) is not None:
                self._send_answer(answered)
        self._scheduler.close()
        if self._aside is not None:
            self._aside.close()
        self._socket.close()

    def _read(self, wait_s: float) -> None:
        """Read the waiting messages; wait up to wait_s if there are none. Send what was answered aside."""
        assert self._socket is not None
        self._poller.poll(math.ceil(wait_s * 1e3))
        for done in self._aside.ready() if self._aside is not None else ():
            self._send(done.caller, done.request_id, *_message(done.outcome, done.seconds))
        for _ in range(MAX_READ):
            try:
                frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            if len(frames) in (3, 4):
                self._take_in(*frames)
            else:
                logger.warning("a message of %d parts was ignored", len(frames))

    def _take_in(self, caller: bytes, request_id: bytes, document: bytes, content: bytes = b"") -> None:
        try:
            envelope = WorkerRequest.model_validate_json(document)
        except ValidationError as error:
            problem = f"The worker cannot read the service's request: {error.errors()[0]['msg']}."
            remedy = "Install the same version of intrasplat for the service and for its workers."
            self._send(
                caller, request_id, WorkerReply(error=ReplyError(kind="internal", problem=problem, remedy=remedy))
            )
            return
        request = envelope.request
        if isinstance(request, CancelRequest):
            self._scheduler.give_up(caller, request_id)
            return
        try:
            if isinstance(request, CutRequest | PushRequest):
                self._lay_aside(caller, request_id, request, content)
                return
            wait_s = self._scheduler.take_in(caller, request_id, request, envelope.trace)
        except Exception as error:  # one caller's request must not end the loop for all
            self._send(caller, request_id, WorkerReply(error=_reply_error(error)))
            return
        if wait_s is not None:
            self._send(caller, request_id, WorkerReply(error=_busy(wait_s)))

    def _lay_aside(self, caller: bytes, request_id: bytes, request: CutRequest | PushRequest, content: bytes) -> None:
        if self._aside is None:
            raise SceneError("This process follows no feed.")
        self._aside.take_in(caller, request_id, request, content)

    def _send_answer(self, answered: Answered) -> None:
        message = _message(answered.outcome, answered.seconds)
        for each in answered.requests:
            self._send(each.caller, each.request_id, *message)

    def _send(self, caller: bytes, request_id: bytes, head: WorkerReply, body: bytes = b"") -> None:
        assert self._socket is not None
        self._socket.send_multipart([caller, request_id, head.model_dump_json().encode(), body])

    def _do_between(self) -> None:
        if self._between is None or time.monotonic() < self._between_at_s:
            return
        try:
            self._between()
        except Exception as error:  # a brief failure of the disk must not end the thread
            logger.error("between two requests: %s", type(error).__name__)
        self._between_at_s = time.monotonic() + BETWEEN_PERIOD_S


def _message(outcome: Reply | Exception, seconds: float) -> tuple[WorkerReply, bytes]:
    """Head and body of an answer."""
    if isinstance(outcome, Reply):
        return _head(outcome, seconds), outcome.body
    return WorkerReply(error=_reply_error(outcome)), b""


def _head(reply: Reply, seconds: float) -> WorkerReply:
    return WorkerReply(
        media_type=reply.media_type,
        t=reply.t,
        warnings=reply.warnings,
        iteration=reply.iteration,
        unseen=reply.unseen,
        detail=reply.detail,
        gaussians=reply.gaussians,
        clip_size=reply.clip_size,
        camera=reply.camera,
        more=reply.more,
        depth_range_mm=reply.depth_range_mm,
        feed=reply.feed,
        cut=reply.cut,
        render_ms=seconds * 1e3,
    )


def _busy(wait_s: float) -> ReplyError:
    """The answer to a caller who would wait too long."""
    retry_after_s = round(wait_s, 1)
    problem, remedy = "The worker has other pictures to make first.", f"Ask again in {math.ceil(wait_s)} s."
    return ReplyError(kind="busy", problem=problem, remedy=remedy, retry_after_s=retry_after_s)


def _reply_error(error: Exception) -> ReplyError:
    """The error that the caller gets. For an unforeseen error only its type, because its text may contain anything."""
    if isinstance(error, InputError):
        code = error.code if isinstance(error, MissingExtraError) else ErrorCode.UNCLASSIFIED
        return ReplyError(kind="input", problem=error.problem, field=error.field, remedy=error.remedy, code=code)
    if isinstance(error, SceneError):
        remedy = "GET /scenes lists what there is."
        return ReplyError(kind="scene", problem=str(error), field="scene", remedy=remedy)
    if isinstance(error, NotYetError):
        return ReplyError(kind="not-yet", problem=str(error), field="scene", remedy="Ask again in a second.")
    if isinstance(error, UnavailableError):
        return ReplyError(kind="busy", problem=error.problem, remedy=error.remedy, retry_after_s=UNAVAILABLE_RETRY_S)
    where = "".join(traceback.format_tb(error.__traceback__))
    logger.error("a request could not be answered: %s\n%s", type(error).__name__, where)
    problem = f"The worker could not answer ({type(error).__name__})."
    return ReplyError(kind="internal", problem=problem, remedy=FAULT_REMEDY)


def _encrypt(socket: zmq.Socket[bytes], render_secret: str) -> ThreadAuthenticator:
    """Make the socket a CURVE server that admits only services with this secret. The caller must stop the result."""
    own = worker_keys(render_secret)
    socket.curve_server = True
    socket.curve_publickey, socket.curve_secretkey = own.public, own.secret
    authenticator = ThreadAuthenticator(socket.context, log=logger)
    authenticator.start()
    authenticator.configure_curve_callback(credentials_provider=_OneKey(service_keys(render_secret).public))
    return authenticator


@dataclass(frozen=True)
class _OneKey:
    """Admits one public key; ZeroMQ calls callback()."""

    public: bytes

    def callback(self, domain: str, key: bytes) -> bool:
        del domain
        return key == self.public


def _bind_address(endpoint: str) -> str:
    """The address to listen on: all addresses, if `endpoint` has the name by which others reach this machine."""
    parts = urlsplit(endpoint)
    if parts.scheme != "tcp" or parts.hostname in ("127.0.0.1", "::1"):
        return endpoint
    return f"tcp://127.0.0.1:{parts.port}" if parts.hostname == "localhost" else f"tcp://*:{parts.port}"
