"""The libraries that compute keep to one thread, unless their variables are set."""

from __future__ import annotations

import os

import pytest

from intrasplat.machine.cores import keep_libraries_to_one_thread

VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")


@pytest.mark.parametrize("given", [None, "3"])
def test_libraries_keep_to_one_thread_unless_the_environment_says_otherwise(
    given: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    monkeypatch.setattr(os, "environ", dict(os.environ))
    keep_libraries_to_one_thread()
    assert [os.environ[name] for name in VARIABLES] == ["1", given or "1"]
