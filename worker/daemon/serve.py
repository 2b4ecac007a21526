"""Answer render and export requests: a ZeroMQ ROUTER in a thread during training (contract/wire/rendering.py).

The thread answers one request at a time, in order of arrival. Rendering shares the cores with training and waits when
it has used its share (worker/daemon/pace.py). The folder of a unix socket protects it. TCP is encrypted, and only
callers who know the installation's secret are answered.
"""

from __future__ import annotations

import logging
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
from contract.wire.errors import ErrorCode, InputError, IntrasplatError, SceneError, UnavailableError
from contract.wire.notices import Notice
from contract.wire.rendering import ExportRequest, RenderRequest, ReplyError, WorkerReply, WorkerRequest

POLL_MS = 50
"""How soon the thread notices that it shall end."""

MAX_REQUEST_BYTES = 64 * 1024
"""Of one part of a message; a request has some hundred bytes. A caller who sends more loses the connection."""

BETWEEN_PERIOD_S = 1.0

logger = logging.getLogger("intrasplat.worker")


class NotYetError(IntrasplatError):
    """The job has nothing to show yet."""

    code = ErrorCode.NOT_YET


@dataclass(frozen=True)
class Reply:
    """The answer to a request: encoded bytes, the model time that they show (clamped), and warnings.

    iteration: of the snapshot that is shown; None: the scene is finished.
    unseen: share of a render's pixels that no training frame saw.
    """

    body: bytes
    media_type: str
    t: float
    warnings: tuple[Notice, ...] = ()
    iteration: int | None = None
    unseen: float = 0.0


class RequestServer:
    """A context manager that answers requests at `endpoint`.

    Args:
        answer: makes the reply. The caller is told of its InputError, SceneError or NotYetError; any other error is
            logged and told as a fault.
        between: called about once a second, in the same thread.
        rest_s: how long to answer nobody.
        render_secret: needed for tcp:// alone.
    """

    def __init__(
        self,
        endpoint: str,
        answer: Callable[[RenderRequest | ExportRequest], Reply],
        *,
        between: Callable[[], None] | None = None,
        rest_s: Callable[[], float] = lambda: 0.0,
        render_secret: str | None = None,
    ) -> None:
        if endpoint.startswith("tcp:") and render_secret is None:
            raise InputError(
                "INTRASPLAT_RENDER_SECRET",
                f"{endpoint} needs a secret and has none.",
                "Set it, to 32 or more characters.",
            )
        self.endpoint = endpoint
        self._answer = answer
        self._between = between
        self._between_at_s = 0.0
        self._rest_s = rest_s
        self._render_secret = render_secret
        self._end = threading.Event()
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._authenticator: ThreadAuthenticator | None = None
        self._thread = threading.Thread(target=self._serve, name="renders", daemon=True)
        self._socket: zmq.Socket[bytes] | None = None

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
            if (rest_s := self._rest_s()) > 0.0:
                self._end.wait(min(rest_s, POLL_MS / 1e3))
                continue
            if not self._socket.poll(POLL_MS):
                continue
            frames = self._socket.recv_multipart()
            if len(frames) != 3:
                logger.warning("a message of %d parts was ignored", len(frames))
                continue
            caller, request_id, document = frames
            head, body = self._reply(document)
            self._socket.send_multipart([caller, request_id, head.model_dump_json().encode(), body])
        self._socket.close()

    def _do_between(self) -> None:
        if self._between is None or time.monotonic() < self._between_at_s:
            return
        try:
            self._between()
        except Exception as error:  # a brief failure of the disk must not end the thread
            logger.error("between two requests: %s", type(error).__name__)
        self._between_at_s = time.monotonic() + BETWEEN_PERIOD_S

    def _reply(self, document: bytes) -> tuple[WorkerReply, bytes]:
        try:
            request = WorkerRequest.model_validate_json(document).request
        except ValidationError as error:
            problem = f"The request does not fit: {error.errors()[0]['msg']}."
            return WorkerReply(error=ReplyError(kind="internal", problem=problem)), b""
        start = time.perf_counter()
        try:
            view = self._answer(request)
        except Exception as error:
            return WorkerReply(error=_reply_error(error)), b""
        head = WorkerReply(
            media_type=view.media_type,
            t=view.t,
            warnings=view.warnings,
            iteration=view.iteration,
            unseen=view.unseen,
            render_ms=(time.perf_counter() - start) * 1e3,
        )
        return head, view.body


def _reply_error(error: Exception) -> ReplyError:
    """An error as the caller is told. Of an unforeseen one only its type, because its text may hold anything."""
    if isinstance(error, InputError):
        return ReplyError(kind="input", problem=error.problem, field=error.field, remedy=error.remedy)
    if isinstance(error, SceneError):
        remedy = "GET /scenes lists what there is."
        return ReplyError(kind="scene", problem=str(error), field="scene", remedy=remedy)
    if isinstance(error, NotYetError):
        return ReplyError(kind="not-yet", problem=str(error), field="scene", remedy="Ask again in a second.")
    where = "".join(traceback.format_tb(error.__traceback__))
    logger.error("a request could not be answered: %s\n%s", type(error).__name__, where)
    return ReplyError(kind="internal", problem=f"The worker could not render ({type(error).__name__}).")


def _encrypt(socket: zmq.Socket[bytes], render_secret: str) -> ThreadAuthenticator:
    """Make the socket a CURVE server that admits only services with this secret; the caller must stop the result."""
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
    """The address to listen on: every one where `endpoint` has the name by which others reach this machine."""
    parts = urlsplit(endpoint)
    if parts.scheme != "tcp" or parts.hostname in ("127.0.0.1", "::1"):
        return endpoint
    return f"tcp://127.0.0.1:{parts.port}" if parts.hostname == "localhost" else f"tcp://*:{parts.port}"
