"""The running service that the tests here ask for by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from service import webhooks
from tests.receiver import Receiver
from tests.service.under_test import ServiceUnderTest, running_service


@pytest.fixture
def service(tmp_path: Path) -> Iterator[ServiceUnderTest]:
    yield from running_service(tmp_path)


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Webhooks that were not delivered are tried again at once."""
    monkeypatch.setattr(webhooks, "FIRST_WAIT_S", 0.001)
    monkeypatch.setattr(webhooks, "MAX_WAIT_S", 0.001)


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with Receiver() as receiver:
        yield receiver
