"""`python -m service`: the HTTP service, with its settings from the environment (contract/settings.py)."""

from __future__ import annotations

import sys

import uvicorn

from contract.errors import UnavailableError
from contract.exits import ExitCode
from contract.queue_redis import RedisQueue
from contract.settings import Settings
from contract.store import open_store
from service.app import create_app
from service.guard import LOOPBACK_NAMES
from service.renderer import ZmqRenderer

KEEP_ALIVE_S = 15
MAX_CONNECTIONS = 256


def main() -> int:
    """Serve until a signal ends it."""
    settings = Settings.from_environment()
    if settings.redis_url is None:
        print("REDIS_URL is not set; `intrasplat up` starts a queue of its own.", file=sys.stderr)
        return ExitCode.UNAVAILABLE
    if settings.host not in LOOPBACK_NAMES:
        print("There are no accounts yet, so only a loopback INTRASPLAT_HOST is accepted.", file=sys.stderr)
        return ExitCode.USAGE
    queue = RedisQueue(settings.redis_url)
    try:
        queue.ping()
    except UnavailableError as error:
        print(error, file=sys.stderr)
        return ExitCode.UNAVAILABLE
    app = create_app(settings, queue, open_store(settings), ZmqRenderer(queue, settings.render_timeout_s))
    uvicorn.run(
        app,
        host=settings.host,
        port=settings.port,
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_S,
        limit_concurrency=MAX_CONNECTIONS,
    )
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
