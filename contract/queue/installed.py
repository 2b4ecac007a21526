"""The queue of an installation for a command that works beside it, or while it is not running."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from contract.queue.embedded import EmbeddedServer
from contract.queue.interface import Queue
from contract.queue.redis_queue import RedisQueue
from contract.runtime.locks import FolderLock
from contract.runtime.settings import Settings
from contract.store.disk_errors import disk_errors

UP_LOCK = "up.lock"
"""In run/ of a data directory: held by `intrasplat up`, or by whoever keeps it from starting."""


@contextmanager
def installed_queue(settings: Settings) -> Iterator[Queue]:
    """The queue of REDIS_URL, or else the embedded one, whose server is started for the time if none runs.

    Raises:
        UnavailableError: the queue does not answer, or there is no server program.
    """
    if settings.redis_url is not None:
        yield from _answering(settings.redis_url)
        return
    data_dir = settings.data_dir.expanduser().resolve()
    with disk_errors():
        (data_dir / "run").mkdir(mode=0o700, parents=True, exist_ok=True)
        alone = FolderLock(data_dir / "run" / UP_LOCK)
        alone.take()  # else `up` runs, and its server
    server = EmbeddedServer(data_dir)
    try:
        server.start()
        yield from _answering(server.url)
    finally:
        server.stop()
        alone.release()


def _answering(url: str) -> Iterator[Queue]:
    queue = RedisQueue(url)
    try:
        queue.ping()
        yield queue
    finally:
        queue.close()
