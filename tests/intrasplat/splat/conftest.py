"""What tests of rasterisers share: an interpreter of Triton's kernels that wastes less time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib.util import find_spec

import pytest

from tests.intrasplat.splat.interpreter import hasten


@pytest.fixture(scope="session", autouse=True)
def _the_interpreter_repeats_nothing() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        if os.environ.get("TRITON_INTERPRET") == "1" and find_spec("triton") is not None:
            hasten(patched.setattr)
        yield
