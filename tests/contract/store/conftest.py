"""Every test that asks for `machine` or `store` runs on a disk, and in a bucket of a real server that speaks S3."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from contract.store.store import Store
from tests.contract.stores import BUCKET_URL

MakeStore = Callable[[str], Store]
"""The store as the machine of that name sees it: each has its own data directory beside a bucket; a disk is shared."""


@pytest.fixture(params=["disk", "bucket"])
def machine(request: pytest.FixtureRequest, tmp_path: Path) -> MakeStore:
    if request.param == "disk":
        return lambda name: Store(tmp_path / "data")
    request.getfixturevalue("bucket")
    return lambda name: Store(tmp_path / name, BUCKET_URL)


@pytest.fixture
def store(machine: MakeStore) -> Store:
    return machine("worker")
