"""The running service that the tests here ask for by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.receiver import Receiver
from tests.service.under_test import ServiceUnderTest, running_service


@pytest.fixture
def service(tmp_path: Path) -> Iterator[ServiceUnderTest]:
    yield from running_service(tmp_path)


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with Receiver() as receiver:
        yield receiver
