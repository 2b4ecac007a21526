"""What the tests of the library share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from lab.evaluate.variants import register_variants
from tests.intrasplat.splat.interpreter import hasten


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


@pytest.fixture(scope="session", autouse=True)
def _the_interpreter_repeats_nothing() -> Iterator[None]:
    """Triton's interpreter wastes less time."""
    with pytest.MonkeyPatch.context() as patched:
        if os.environ.get("TRITON_INTERPRET") == "1" and find_spec("triton") is not None:
            hasten(patched.setattr)
        yield
