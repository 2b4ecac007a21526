"""What all tests share: the seeded generator, the folder of recordings, the device."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
SEED = 20240527


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--device",
        choices=("cpu", "cuda"),
        default="cpu",
        help="where tests that need a device run: the CUDA backend's kernels in Triton's interpreter, or on the GPU",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Triton decides when it is imported whether its kernels are interpreted, so that is said before any test is."""
    if config.getoption("--device") == "cpu":
        os.environ["TRITON_INTERPRET"] = "1"
    else:
        os.environ.pop("TRITON_INTERPRET", None)


@pytest.fixture(scope="session")
def device(pytestconfig: pytest.Config) -> str:
    """The device asked for; a GPU that is asked for and missing is a failure, so that a GPU run cannot pass empty."""
    chosen: str = pytestconfig.getoption("--device")
    if chosen == "cuda":
        import torch

        if not torch.cuda.is_available():
            pytest.fail("--device cuda was asked for, but torch sees no GPU")
    return chosen


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recordings: INTRASPLAT_DATA, else ../shared/data. Skips the test where there is none."""
    named = os.environ.get("INTRASPLAT_DATA")
    folder = Path(named) if named else REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        if named:
            pytest.fail(f"INTRASPLAT_DATA={named} is not a folder; correct or unset it")
        pytest.skip("no recordings: set INTRASPLAT_DATA to a folder that holds them")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    """The same random numbers for every test, whatever ran before."""
    return np.random.default_rng(SEED)
