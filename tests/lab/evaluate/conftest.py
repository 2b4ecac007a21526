"""What several tests of the laboratory's measurements share."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import pytest

from lab.conditions import clean, scenes
from lab.evaluate import measure, sources
from lab.phantom import make_phantom


@pytest.fixture(scope="module")
def each_phantom_once() -> Iterator[None]:
    """The same settings give the same phantom, which takes long to make; that it is the same is checked where phantoms
    are."""
    made = cache(make_phantom)
    with pytest.MonkeyPatch.context() as patched:
        for module in (clean, scenes, sources):
            patched.setattr(module, "make_phantom", made)
        yield


@pytest.fixture(scope="module")
def few_renders_timed() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(measure, "TIMED_RENDERS", 5)
        yield
