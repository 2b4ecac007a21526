"""The running service that the tests here ask for by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from contract.queue.interface import Claim
from intrasplat_client import Client
from tests.client.local_service import CLIP, LocalService, local_service


@pytest.fixture(scope="package")
def _service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalService]:
    with local_service(tmp_path_factory.mktemp("data")) as service:
        yield service


@pytest.fixture
def service(_service: LocalService) -> LocalService:
    """The service, with nothing to do and its worker awake."""
    for record in _service.queue.records():
        _service.queue.cancel(record.job_id)
        _service.queue.confirm_cancel(Claim(record.job_id, record.attempt, record.owner or ""))
    _service.announce()
    return _service


@pytest.fixture
def client(service: LocalService) -> Iterator[Client]:
    with Client(service.url) as client:
        yield client


@pytest.fixture
def clip() -> Path:
    return CLIP
