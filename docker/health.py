"""`python health.py service|worker`: exit status 0 if the process of this container does its work, else 1."""

from __future__ import annotations

import sys
import urllib.request

from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import Settings
from intrasplat.errors import UnavailableError

TIMEOUT_S = 3.0


def service_is_well(settings: Settings) -> bool:
    """It answers; whether it could do anything with a clip, /readyz says."""
    url = f"http://127.0.0.1:{settings.port}/healthz"
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_S) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


def worker_is_well(settings: Settings) -> bool:
    """It has told the queue within the last seconds that it is ready."""
    assert settings.redis_url is not None
    queue = RedisQueue(settings.redis_url)
    try:
        return settings.worker_name in [worker.name for worker in queue.workers()]
    except UnavailableError:
        return False
    finally:
        queue.close()


if __name__ == "__main__":
    check = {"service": service_is_well, "worker": worker_is_well}[sys.argv[1]]
    sys.exit(0 if check(Settings.from_environment()) else 1)
