"""What the tests of the worker share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from worker.evaluate.variants import register_variants


@pytest.fixture(scope="session", autouse=True)
def _one_torch_thread() -> Iterator[None]:
    """Torch's threads spin while they wait for each other: with tensors this small, most of the time."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def triton_cache(pytestconfig: pytest.Config, tmp_path: Path) -> Path:
    """Where Triton finds what it compiled for these tests before: it knows a kernel by its source, its constants and
    the compiler. An empty folder where pytest keeps nothing between runs.
    """
    kept = getattr(pytestconfig, "cache", None)
    return tmp_path if kept is None else Path(kept.mkdir("triton"))


@pytest.fixture(scope="session", autouse=True)
def _variants() -> None:
    """Presets and motions of the laboratory are known to every test here by their names."""
    register_variants()
