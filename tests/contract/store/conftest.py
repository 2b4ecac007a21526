"""Every test that asks for `machine` or `store` runs on a disk, and in a bucket of a real server that speaks S3."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from contract.store.store import Store
from tests.contract.stores import BUCKET_URL, lead_to

MakeStore = Callable[[str], Store]
"""The store as the machine of that name sees it: each has its own data directory beside a bucket; a disk is shared."""


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


@pytest.fixture(params=["disk", "bucket"])
def machine(request: pytest.FixtureRequest, tmp_path: Path) -> MakeStore:
    if request.param == "disk":
        return lambda name: Store(tmp_path / "data")
    request.getfixturevalue("bucket")
    return lambda name: Store(tmp_path / name, BUCKET_URL)


@pytest.fixture
def store(machine: MakeStore) -> Store:
    return machine("worker")
