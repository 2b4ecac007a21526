"""Answer render and export requests: a ZeroMQ ROUTER in a thread during training (contract/wire/rendering.py).

The thread reads all that has come and answers one request at a time, small ones first (worker/turns.py). Those
who ask the same at the same time share one answer. Between the parts of a large answer small ones are given, and it
ends when its caller gives up. Rendering shares the cores with training and waits when it has used its share
(worker/pace.py); whose turn is too far off is told when to come back. The folder of a unix socket protects it.
TCP is encrypted, and only callers who know the installation's secret are answered.
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
    PictureCamera,
    RenderRequest,
    ReplyError,
    SceneRequest,
    WorkerReply,
    WorkerRequest,
)
from intrasplat.errors import ErrorCode, InputError, IntrasplatError, SceneError, UnavailableError
from intrasplat.notices import Notice
from intrasplat.view.encode import FOR_EYES
from worker.pace import Pace
from worker.turn_spans import answer_span, shared_span
from worker.turns import COARSEST, Turn, Turns

POLL_MS = 50
"""How soon the thread notices that it shall end."""

MAX_REQUEST_BYTES = 64 * 1024
"""Of one part of a message; a request has some hundred bytes. A caller who sends more loses the connection."""

BETWEEN_PERIOD_S = 1.0

MAX_READ = 1000
"""Messages read in one go, so that whoever floods the worker keeps nobody else from being answered."""

SMALL_SHARE = 0.25
"""An answer that takes less than this share of a larger one's time is given between the parts of that one."""

ALL_WITHIN_S = 1.0
"""Each viewer's picture is at most so old, where a coarser one can make it so."""

MIN_CHARGE_S = 0.01
"""Counted for each answer while a job trains: service and viewer have work with it, too."""

logger = logging.getLogger("intrasplat.worker")


class NotYetError(IntrasplatError):
    """The job has nothing to show yet."""

    code = ErrorCode.NOT_YET


class GivenUpError(Exception):
    """Nobody waits any more for the answer that is being made."""


@dataclass(frozen=True)
class Reply:
    """The answer to a request: encoded bytes, the model time that they show (clamped), and warnings.

    iteration: of the snapshot that is shown; None: the scene is finished.
    unseen: share of a render's pixels that no training frame saw.
    gaussians, clip_size, camera: as in WorkerReply.
    level: of detail at which it was drawn (intrasplat/view/coarse.py); 0 shows all.
    is_kept: it was made for an earlier request, or its time tells nothing of that of renders.
    more: further parts of the export follow.
    depth_range_mm: of depth in false colours, as in WorkerReply.
    """

    body: bytes
    media_type: str
    t: float
    warnings: tuple[Notice, ...] = ()
    iteration: int | None = None
    unseen: float = 0.0
    gaussians: int = 0
    clip_size: tuple[int, int] | None = None
    level: int = 0
    is_kept: bool = False
    more: bool = False
    depth_range_mm: tuple[float, float] | None = None
    camera: PictureCamera | None = None


class RequestServer:
    """A context manager that answers requests at `endpoint`.

    Args:
        answer: makes the reply, and calls pause() between the parts of a large one. The caller is told of its
            InputError, SceneError or NotYetError; any other error is logged and told as a fault.
        cost: what an answer will take, in pixels x Gaussians.
        between: called about once a second, in the same thread.
        pace: how much of the time answers may take.
        spent_s: CPU seconds that this thread has used.
        max_wait_s: whose turn is farther off is told so at once.
        render_secret: needed for tcp:// alone.
    """

    def __init__(
        self,
        endpoint: str,
        answer: Callable[[SceneRequest], Reply],
        *,
        cost: Callable[[SceneRequest], float] = lambda request: 0.0,
        between: Callable[[], None] | None = None,
        pace: Pace | None = None,
        spent_s: Callable[[], float] = time.thread_time,
        max_wait_s: float = math.inf,
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
        self._cost = cost
        self._pace = pace or Pace()
        self._spent_s = spent_s
        self._charged_s = 0.0
        self._max_wait_s = max_wait_s
        self._turns = Turns()
        self._begun: list[Turn] = []
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
            longest_s = POLL_MS / 1e3
            self._read(min(self._pace.rest_s(), longest_s) if len(self._turns) else longest_s)
            if self._pace.rest_s() == 0.0 and (turn := self._turns.take()) is not None:
                self._give(turn)
        self._socket.close()

    def pause(self) -> None:
        """Let others have a turn between two parts of an answer: small ones, for as long as the last part took.

        Raises:
            GivenUpError: nobody waits for this answer any more.
        """
        turn = self._begun[-1]
        left_s = self._charge()
        self._do_between()
        self._read(0.0)
        while True:
            if turn.is_given_up or self._end.is_set():
                raise GivenUpError
            if (rest_s := self._pace.rest_s()) > 0.0:
                self._read(min(rest_s, POLL_MS / 1e3))
                continue
            small = self._turns.take(SMALL_SHARE * turn.seconds) if left_s > 0.0 else None
            if small is None:
                return
            self._give(small)
            left_s -= small.spent_s

    def level(self) -> int:
        """The level of detail of the answer that is being made: as fine as time allows.

        0, the finest, if no job trains, or if nobody else waits and the pace affords it. 1 if the answers of this level
        to all who wait take less than ALL_WITHIN_S. 2 otherwise.
        """
        turn = self._begun[-1]
        others = self._turns.others(turn.request)
        if self._pace.trains and (others > 0 or not self._pace.affords(turn.seconds)):
            all_s = (1 + others) * self._turns.seconds(turn.cost, 1)
            turn.level = 1 if all_s <= ALL_WITHIN_S * self._pace.rate else 2
        return turn.level

    def _read(self, wait_s: float) -> None:
        """Take in what has come; wait so long if nothing has."""
        assert self._socket is not None
        if not self._socket.poll(math.ceil(wait_s * 1e3)):
            return
        for _ in range(MAX_READ):
            try:
                frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            if len(frames) == 3:
                self._take_in(*frames)
            else:
                logger.warning("a message of %d parts was ignored", len(frames))

    def _take_in(self, caller: bytes, request_id: bytes, document: bytes) -> None:
        try:
            envelope = WorkerRequest.model_validate_json(document)
        except ValidationError as error:
            problem = f"The request does not fit: {error.errors()[0]['msg']}."
            self._send(caller, request_id, WorkerReply(error=ReplyError(kind="internal", problem=problem)))
            return
        request = envelope.request
        if isinstance(request, CancelRequest):
            self._turns.give_up(caller, request_id)
            for begun in self._begun:
                begun.is_given_up |= (begun.caller, begun.request_id) == (caller, request_id)
            return
        try:
            cost = self._cost(request)
        except Exception as error:  # what one caller asks must not end the loop for all
            self._send(caller, request_id, WorkerReply(error=_reply_error(error)))
            return
        seconds, least_s = self._turns.seconds(cost), self._turns.seconds(cost, self._coarsest(request))
        arrived_s = time.monotonic()
        turn = Turn(caller, request_id, request, cost, seconds, least_s, arrived_s, trace=envelope.trace)
        if (wait_s := self._wait_s(turn)) > self._max_wait_s:
            self._send(caller, request_id, WorkerReply(error=_busy(wait_s)))
        else:
            self._turns.add(turn)

    def _coarsest(self, request: SceneRequest) -> int:
        """The coarsest level of detail that will do."""
        may_be_coarse = isinstance(request, RenderRequest) and request.format in FOR_EYES
        return COARSEST if self._pace.trains and may_be_coarse else 0

    def _wait_s(self, turn: Turn) -> float:
        """Seconds until its turn, as far as known."""
        larger = [each for each in self._begun if turn.seconds >= SMALL_SHARE * each.seconds]
        left_s = (max(0.0, self._turns.seconds(each.cost, each.level) - each.spent_s) for each in larger)
        before_s = self._turns.seconds_before(turn) + sum(left_s)
        return self._pace.rest_s() + before_s / self._pace.rate

    def _give(self, turn: Turn) -> None:
        """Answer it, and all who wait for the same."""
        self._begun.append(turn)
        self._charged_s = self._spent_s()
        try:
            with answer_span(turn):
                head, body, is_new = self._reply(turn.request)
        except GivenUpError:
            return
        finally:
            self._charge()
            self._begun.pop()
        if is_new:
            self._turns.learn(turn)
        answered = [turn, *self._turns.take_same(turn.request)]
        self._pace.charge(max(0.0, len(answered) * MIN_CHARGE_S - turn.spent_s))
        for each in answered:
            self._send(each.caller, each.request_id, head, body)
        for each in answered[1:]:
            shared_span(each)

    def _charge(self) -> float:
        """Count the CPU seconds since this was last done for the answer that is being made; how many they are."""
        now_s = self._spent_s()
        spent_s, self._charged_s = now_s - self._charged_s, now_s
        self._begun[-1].spent_s += spent_s
        self._pace.charge(spent_s)
        return spent_s

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

    def _reply(self, request: SceneRequest) -> tuple[WorkerReply, bytes, bool]:
        """Head and body of the answer, and whether it was made for this request."""
        start = time.perf_counter()
        try:
            view = self._answer(request)
        except GivenUpError:
            raise
        except Exception as error:
            return WorkerReply(error=_reply_error(error)), b"", False
        head = WorkerReply(
            media_type=view.media_type,
            t=view.t,
            warnings=view.warnings,
            iteration=view.iteration,
            unseen=view.unseen,
            gaussians=view.gaussians,
            clip_size=view.clip_size,
            camera=view.camera,
            more=view.more,
            depth_range_mm=view.depth_range_mm,
            render_ms=(time.perf_counter() - start) * 1e3,
        )
        return head, view.body, not view.is_kept


def _busy(wait_s: float) -> ReplyError:
    """The answer to who would wait too long."""
    retry_after_s = round(wait_s, 1)
    problem, remedy = "The worker has other pictures to make first.", f"Ask again in {math.ceil(wait_s)} s."
    return ReplyError(kind="busy", problem=problem, remedy=remedy, retry_after_s=retry_after_s)


def _reply_error(error: Exception) -> ReplyError:
    """An error as the caller is told. Of an unforeseen one only its type, because its text may hold anything."""
    if isinstance(error, InputError):
        return ReplyError(kind="input", problem=error.problem, field=error.field, remedy=error.remedy)
    if isinstance(error, SceneError):
        remedy = "GET /scenes lists what there is."
        return ReplyError(kind="scene", problem=str(error), field="scene", remedy=remedy)
    if isinstance(error, NotYetError):
        return ReplyError(kind="not-yet", problem=str(error), field="scene", remedy="Ask again in a second.")
    if isinstance(error, UnavailableError):
        return ReplyError(kind="busy", problem=error.problem, remedy=error.remedy)
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
