"""The running service that the tests here ask for by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from client import Client
from contract.queue.promise import Claim
from tests.client.town import CLIP, Town, town_at


@pytest.fixture(scope="package")
def _town(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Town]:
    with town_at(tmp_path_factory.mktemp("data")) as town:
        yield town


@pytest.fixture
def town(_town: Town) -> Town:
    """The service, with nothing to do and its worker awake."""
    for record in _town.queue.records():
        _town.queue.cancel(record.job_id)
        _town.queue.confirm_cancel(Claim(record.job_id, record.attempt, record.owner or ""))
    _town.announce()
    return _town


@pytest.fixture
def client(town: Town) -> Iterator[Client]:
    with Client(town.url) as client:
        yield client


@pytest.fixture
def clip() -> Path:
    return CLIP
