"""What all tests share: the seeded generator, the folder of recordings, the device."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from intrasplat.machine.cores import keep_libraries_to_one_thread

keep_libraries_to_one_thread()  # as every program of ours does, before NumPy is imported
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # torch's threads wait for each other without using a core

import numpy as np  # noqa: E402

from intrasplat.machine.gpu import find_gpu  # noqa: E402

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
    """Triton decides when it is imported whether its kernels are interpreted, so that is said before any test is.

    A GPU that is asked for and missing ends the run at once, so that it cannot pass empty.
    """
    if config.getoption("--device") == "cpu":
        os.environ["TRITON_INTERPRET"] = "1"
        return
    os.environ.pop("TRITON_INTERPRET", None)
    gpu = find_gpu()
    if gpu.missing:
        raise pytest.UsageError(f"--device cuda was asked for, but {gpu.missing}. {gpu.remedy}.")


@pytest.fixture(scope="session")
def device(pytestconfig: pytest.Config) -> str:
    """The device asked for."""
    chosen: str = pytestconfig.getoption("--device")
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
