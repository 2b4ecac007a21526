"""The worker's ear for renders and exports: a ZeroMQ ROUTER in a thread beside training (contract/rendering.py).

One request is answered at a time, in the order they came; rendering shares the cores with training.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

import zmq
from pydantic import ValidationError

from contract.errors import InputError, SceneError
from contract.rendering import ExportRequest, RenderRequest, ReplyError, WorkerReply, WorkerRequest

POLL_MS = 50
"""How soon the thread notices that it should end."""

logger = logging.getLogger("intrasplat.worker")


@dataclass(frozen=True)
class View:
    """An answered request: encoded bytes, the time they show (clamped), what the caller should know."""

    body: bytes
    media_type: str
    t: float
    warnings: tuple[str, ...] = ()


class RequestServer:
    """Answers requests at `endpoint` by `answer`; a context manager that binds and unbinds.

    `answer` may raise InputError or SceneError, which the caller is told; anything else is logged and told as a fault.
    """

    def __init__(self, endpoint: str, answer: Callable[[RenderRequest | ExportRequest], View]) -> None:
        self.endpoint = endpoint
        self._answer = answer
        self._end = threading.Event()
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._thread = threading.Thread(target=self._serve, name="renders", daemon=True)
        self._socket: zmq.Socket[bytes] | None = None

    def __enter__(self) -> RequestServer:
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(self.endpoint)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._end.set()
        self._thread.join()
        self._context.term()

    def _serve(self) -> None:
        assert self._socket is not None
        while not self._end.is_set():
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

    def _reply(self, document: bytes) -> tuple[WorkerReply, bytes]:
        try:
            view = self._answer(WorkerRequest.model_validate_json(document).request)
        except InputError as error:
            reply = ReplyError(kind="input", problem=error.problem, field=error.field, remedy=error.remedy)
        except SceneError as error:
            reply = ReplyError(
                kind="scene", problem=str(error), field="scene", remedy="GET /scenes lists what there is."
            )
        except ValidationError as error:
            reply = ReplyError(kind="internal", problem=f"The request does not fit: {error.errors()[0]['msg']}.")
        except Exception as error:
            logger.exception("a request could not be answered")
            reply = ReplyError(kind="internal", problem=f"The worker could not render ({type(error).__name__}).")
        else:
            return WorkerReply(media_type=view.media_type, t=view.t, warnings=view.warnings), view.body
        return WorkerReply(error=reply), b""
