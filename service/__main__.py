"""`python -m service`: the HTTP service, with its settings from the environment (contract/runtime/settings.py)."""

from __future__ import annotations

import contextlib
import logging
import sys

from contract.access.keys import check_keys
from contract.queue.installed import check_queue
from contract.queue.redis_queue import RedisQueue
from contract.runtime import traces
from contract.runtime.logs import configure
from contract.runtime.settings import Settings
from contract.store.store import open_store
from intrasplat.commands.exits import ExitCode, end_by
from intrasplat.errors import IntrasplatError, UnavailableError
from service.app import create_app
from service.renderer import ZmqRenderer
from service.server import Server

QUEUE_PATIENCE_S = 2.7
"""How long the queue's client retries, so that callers learn within 3 s that the queue does not answer."""
KNOWN_WORKERS = "workers.json"
SWITCH_S = 0.0005
"""Python's thread switch interval. The event loop takes the interpreter lock several times for each answer. At the
usual 5 ms, every upload that a thread inspects would delay all other answers by tens of ms."""

logger = logging.getLogger("intrasplat.service")


def main() -> int:
    """Serve until a signal ends the process."""
    try:
        settings = Settings.from_environment()
        check_keys(settings)
    except IntrasplatError as error:
        return end_by(error)
    if settings.redis_url is None:
        return end_by(UnavailableError("REDIS_URL is not set.", "`intrasplat up` starts a queue of its own."))
    sys.setswitchinterval(SWITCH_S)
    configure(settings, "service")
    traces.configure("service")
    try:
        queue = RedisQueue(settings.redis_url, patience_s=QUEUE_PATIENCE_S)
        check_queue(queue)
        store = open_store(settings)
    except IntrasplatError as error:
        return end_by(error)
    known = store.run_dir / KNOWN_WORKERS
    renderer = ZmqRenderer(queue, settings.render_timeout_s, settings.render_secret, known)
    app = create_app(settings, queue, store, renderer)
    logger.info("listening on port %d", settings.port)
    server = Server(app, settings)
    with contextlib.suppress(KeyboardInterrupt):
        server.run()
    return ExitCode.OK if server.started else ExitCode.UNAVAILABLE


if __name__ == "__main__":
    sys.exit(main())
