"""The queue of an installation, for commands that run beside it or without it, and for a process that starts."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from contract.queue.embedded import EmbeddedServer
from contract.queue.interface import Queue
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import Settings
from intrasplat.errors import UnavailableError

logger = logging.getLogger("intrasplat.queue")


@contextmanager
def installed_queue(settings: Settings) -> Iterator[Queue]:
    """The queue of REDIS_URL, or else the embedded one. Its server runs during the context if none ran before. An
    `intrasplat up` that starts meanwhile shares that server, and starts another one when it ends.

    Raises:
        UnavailableError: the queue does not answer, or there is no server program.
    """
    if settings.redis_url is not None:
        yield from _answering(settings.redis_url)
        return
    server = EmbeddedServer(settings.data_dir.expanduser().resolve())
    try:
        server.start()
        yield from _answering(server.url)
    finally:
        server.stop()


def _answering(url: str) -> Iterator[Queue]:
    queue = RedisQueue(url)
    try:
        queue.ping()
        yield queue
    finally:
        queue.close()


def check_queue(queue: Queue) -> None:
    """Return if the queue answers or may do so later: finished scenes need no queue. Else raise UnavailableError."""
    try:
        queue.ping()
    except UnavailableError as error:
        if not error.may_return:
            raise
        logger.warning("starting without the queue: %s", error)
