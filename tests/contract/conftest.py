"""Every test that asks for `queue` or `queues` runs on each implementation, and on each kind of server; a bucket."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import redis

from contract.queue.interface import LEASE_S, Queue
from contract.queue.redis_queue import PREFIX, RedisQueue
from tests.contract.queues import RunningServer, redis_binary, valkey_binary
from tests.contract.stores import lead_to
from tests.memory_queue import MemoryQueue

MakeQueue = Callable[..., Queue]
"""A client of the one queue of the test, with a lease of so many seconds."""


@pytest.fixture(scope="session")
def valkey_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    server = RunningServer(valkey_binary(), tmp_path_factory.mktemp("valkey"))
    yield server.url
    server.stop()


@pytest.fixture(scope="session")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """REDIS_URL, of which only the queue's keys are touched, or a redis-server that is started here."""
    if "REDIS_URL" in os.environ:
        yield os.environ["REDIS_URL"]
        return
    binary = redis_binary()
    if binary is None:
        pytest.skip("no redis-server on PATH, and REDIS_URL is not set")
    server = RunningServer(binary, tmp_path_factory.mktemp("redis"))
    yield server.url
    server.stop()


def emptied(url: str) -> str:
    """The same server, without a queue."""
    client = redis.Redis.from_url(url)
    for key in client.scan_iter(f"{PREFIX}*"):
        client.delete(key)
    client.close()
    return url


@pytest.fixture(params=["valkey", "redis"])
def url(request: pytest.FixtureRequest) -> str:
    """Of a server whose queue is empty."""
    found: str = request.getfixturevalue(f"{request.param}_url")
    return emptied(found)


@pytest.fixture(params=["memory", "valkey", "redis"])
def queues(request: pytest.FixtureRequest) -> Iterator[MakeQueue]:
    """Makes queues: several clients of one server; in memory the same object as long as the lease is the same."""
    if request.param == "memory":
        yield lambda **leases: MemoryQueue(**leases)
        return
    found: str = request.getfixturevalue(f"{request.param}_url")
    emptied(found)
    made: list[RedisQueue] = []

    def make(**leases: float) -> Queue:
        made.append(RedisQueue(found, **leases))
        return made[-1]

    yield make
    for queue in made:
        queue.close()


@pytest.fixture
def queue(queues: MakeQueue) -> Queue:
    return queues(lease_s=LEASE_S, preempt_after_s=0.0)


@pytest.fixture
def short_lease(queues: MakeQueue) -> Queue:
    """A queue whose leases run out at once unless they are renewed."""
    return queues(lease_s=0.02, preempt_after_s=0.0)


@pytest.fixture
def served(url: str) -> Iterator[RedisQueue]:
    """The queue of that server."""
    queue = RedisQueue(url, preempt_after_s=0.0)
    yield queue
    queue.close()


@pytest.fixture
def client(url: str) -> Iterator[redis.Redis]:
    client = redis.Redis.from_url(url, decode_responses=True)
    yield client
    client.close()


@pytest.fixture(params=["valkey", "redis"])
def binary(request: pytest.FixtureRequest) -> Path:
    """For tests that change a server's settings and so need one of their own."""
    found = valkey_binary() if request.param == "valkey" else redis_binary()
    if found is None:
        pytest.skip("no redis-server on PATH")
    return found


@pytest.fixture
def own(binary: Path, tmp_path: Path) -> Iterator[RunningServer]:
    server = RunningServer(binary, tmp_path)
    yield server
    server.stop()


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """The address of an S3 server."""
    pytest.importorskip("s3fs")
    moto_server: Any = pytest.importorskip("moto.server")
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def bucket(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The empty bucket of BUCKET_URL, as boto3 sees it; the environment leads our store to it."""
    boto3: Any = pytest.importorskip("boto3")
    lead_to(monkeypatch, s3_server)
    bucket = boto3.resource("s3").Bucket("clips")
    bucket.create()
    yield bucket
    bucket.object_versions.delete()
    bucket.delete()


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    """A folder with cert.pem for localhost, which has signed itself, and key.pem."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl on PATH")
    command = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -keyout key.pem -out cert.pem"
    command += " -days 2 -subj /CN=localhost -addext subjectAltName=DNS:localhost"
    subprocess.run(command.split(), cwd=tmp_path, check=True, capture_output=True)
    return tmp_path
