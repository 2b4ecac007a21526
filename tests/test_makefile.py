"""`make setup` installs what is asked for, once; `make gpu-check` runs on the Python that is named."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

CPU, CUDA = "https://download.pytorch.org/whl/cpu", "https://download.pytorch.org/whl/cu128"
FROM_OUTSIDE = ("TORCH_INDEX", "PYTHON", "MAKEFLAGS", "MAKEOVERRIDES")
"""What the make that runs these tests would tell the one that they run."""


class Checkout:
    """A folder with the Makefile, whose .venv has a Python that does nothing but write down how it was called."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("Makefile", "pyproject.toml", "constraints.txt"):
            shutil.copy(REPOSITORY / name, folder)
        python = folder / ".venv" / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.write_text('#!/bin/sh\necho "$@" >>calls\n')
        python.chmod(0o755)

    def make(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        variables = {name: value for name, value in os.environ.items() if name not in FROM_OUTSIDE}
        command = ["make", *arguments]
        return subprocess.run(
            command, cwd=self.folder, env=variables, capture_output=True, text=True, timeout=60, check=False
        )

    def installs(self, *arguments: str) -> list[str]:
        """The options of every `pip install` of a `make setup`."""
        calls = self.folder / "calls"
        calls.write_text("")
        answer = self.make("setup", *arguments)
        assert answer.returncode == 0, answer.stderr
        return [line.partition(" install ")[2] for line in calls.read_text().splitlines() if " install " in line]


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_setup_installs_once_from_pips_own_index(checkout: Checkout) -> None:
    (install,) = checkout.installs()
    assert "--index-url" not in install
    assert checkout.installs() == []


def test_another_index_than_the_environment_was_made_with_installs_torch_anew(checkout: Checkout) -> None:
    checkout.installs(f"TORCH_INDEX={CPU}")
    assert checkout.installs(f"TORCH_INDEX={CPU}") == []
    torch, rest = checkout.installs(f"TORCH_INDEX={CUDA}")
    assert torch.endswith(f"--index-url {CUDA} torch")
    assert "--force-reinstall" in torch
    assert "--force-reinstall" not in rest
    torch, _ = checkout.installs("TORCH_INDEX=")
    assert "--force-reinstall" in torch
    assert "--index-url" not in torch
    assert checkout.installs() == []


def test_the_index_is_kept_when_requirements_change(checkout: Checkout) -> None:
    checkout.installs(f"TORCH_INDEX={CUDA}")
    os.utime(checkout.folder / ".venv" / ".installed", (0, 0))
    torch, _ = checkout.installs()
    assert torch.endswith(f"--index-url {CUDA} torch")
    assert "--force-reinstall" not in torch


def test_a_python_that_is_named_for_the_gpu_check_is_not_replaced(checkout: Checkout) -> None:
    answer = checkout.make("gpu-check", "PYTHON=/nonexistent")
    assert answer.returncode == 2
    assert "gpu-check: '/nonexistent' is no Python" in answer.stderr
    assert not (checkout.folder / "calls").exists()
