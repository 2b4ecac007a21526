"""`make setup` installs only what is needed, once, and torch from the right index; gpu-check keeps the named Python."""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

CPU, CUDA = "https://download.pytorch.org/whl/cpu", "https://download.pytorch.org/whl/cu128"
NO_ANSWER = "http://127.0.0.1:9"
"""The discard port: the connection is refused at once."""
FROM_OUTSIDE = ("TORCH_INDEX", "PYTHON", "MAKEFLAGS", "MAKEOVERRIDES")
"""What the make that runs these tests would tell the one that they run."""


class Checkout:
    """A folder with the Makefile, whose .venv has a Python that does nothing but write down how it was called."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cpu_index, self.nvidia = NO_ANSWER, ""
        for name in (
            "Makefile",
            "pyproject.toml",
            "client/pyproject.toml",
            "service/pyproject.toml",
            "constraints.txt",
        ):
            (folder / name).parent.mkdir(exist_ok=True)
            shutil.copy(REPOSITORY / name, folder / name)
        python = folder / ".venv" / "bin" / "python"
        python.parent.mkdir(parents=True)
        for name in ("python", "ruff", "mypy", "intrasplat"):
            program = python.with_name(name)
            program.write_text('#!/bin/sh\necho "$@" >>calls\n')
            program.chmod(0o755)

    def make(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        variables = {name: value for name, value in os.environ.items() if name not in FROM_OUTSIDE}
        variables["no_proxy"] = "127.0.0.1"
        command = ["make", f"CPU_INDEX={self.cpu_index}", f"NVIDIA={self.nvidia}", *arguments]
        return subprocess.run(
            command, cwd=self.folder, env=variables, capture_output=True, text=True, timeout=60, check=False
        )

    def installs(self, *arguments: str, target: str = "setup") -> list[str]:
        """The options of every `pip install` that making the target takes."""
        calls = self.folder / "calls"
        calls.write_text("")
        answer = self.make(target, *arguments)
        assert answer.returncode == 0, answer.stderr
        return [line.partition(" install ")[2] for line in calls.read_text().splitlines() if " install " in line]


class CpuBuilds(BaseHTTPRequestHandler):
    """An index that has torch and nothing else."""

    def do_GET(self) -> None:
        self.send_response(200 if self.path == "/whl/cpu/torch/" else 404)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


@pytest.fixture
def cpu_index() -> Iterator[str]:
    """The address of an index of CPU builds that answers."""
    with ThreadingHTTPServer(("127.0.0.1", 0), CpuBuilds) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        yield f"http://127.0.0.1:{server.server_port}/whl/cpu"
        server.shutdown()
        serving.join()


def test_setup_installs_once_and_only_what_running_needs(checkout: Checkout) -> None:
    (install,) = checkout.installs()
    assert install.endswith("--editable .[charts] --editable ./client --editable ./service")
    assert checkout.installs() == []
    assert checkout.installs(target="demo") == []


def test_tests_and_checks_add_their_tools_once(checkout: Checkout) -> None:
    running, tools = checkout.installs(target="test")
    assert running.endswith("--editable .[charts] --editable ./client --editable ./service")
    assert tools.endswith("--editable .[dev]")
    assert checkout.installs(target="check") == []


def test_changed_requirements_are_installed_for_running_and_for_the_tests(checkout: Checkout) -> None:
    checkout.installs(target="test")
    os.utime(checkout.folder / ".venv" / ".installed", (0, 0))
    running, tools = checkout.installs(target="test")
    assert running.endswith("--editable .[charts] --editable ./client --editable ./service")
    assert tools.endswith("--editable .[dev]")


def test_without_a_gpu_torch_comes_from_the_index_of_cpu_builds(checkout: Checkout, cpu_index: str) -> None:
    checkout.cpu_index = cpu_index
    torch, _ = checkout.installs()
    assert torch.endswith(f"--index-url {cpu_index} torch")
    assert checkout.installs() == []
    checkout.cpu_index = NO_ANSWER  # asked once: .venv knows
    os.utime(checkout.folder / ".venv" / ".installed", (0, 0))
    torch, _ = checkout.installs()
    assert torch.endswith(f"--index-url {cpu_index} torch")


def test_pips_own_index_is_used_where_that_of_cpu_builds_does_not_answer(checkout: Checkout) -> None:
    (install,) = checkout.installs()
    assert "--index-url" not in install


def test_pips_own_index_is_used_where_that_of_cpu_builds_has_no_torch(checkout: Checkout, cpu_index: str) -> None:
    checkout.cpu_index = f"{cpu_index}/elsewhere"
    (install,) = checkout.installs()
    assert "--index-url" not in install


def test_pips_own_index_is_used_where_there_is_a_gpu(checkout: Checkout, cpu_index: str) -> None:
    checkout.cpu_index, checkout.nvidia = cpu_index, "/usr/bin/nvidia-smi"
    (install,) = checkout.installs()
    assert "--index-url" not in install


@pytest.mark.parametrize("named", ["", CUDA])
def test_an_index_that_is_named_decides(checkout: Checkout, cpu_index: str, named: str) -> None:
    checkout.cpu_index = cpu_index
    indices = [each.partition("--index-url ")[2] for each in checkout.installs(f"TORCH_INDEX={named}")]
    assert indices == ([f"{named} torch", ""] if named else [""])


def test_another_index_than_the_environment_was_made_with_installs_torch_anew(checkout: Checkout) -> None:
    checkout.installs(f"TORCH_INDEX={CPU}", target="test")
    assert checkout.installs(f"TORCH_INDEX={CPU}", target="test") == []
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


def test_help_asks_no_index(checkout: Checkout, tmp_path: Path) -> None:
    witness = tmp_path / "asked"
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\necho asked >{witness}\n")
    program.chmod(0o755)
    assert checkout.make("help", f"PYTHON={program}").returncode == 0
    assert not witness.exists()


def test_a_python_that_is_named_for_the_gpu_check_is_not_replaced(checkout: Checkout) -> None:
    answer = checkout.make("gpu-check", "PYTHON=/nonexistent")
    assert answer.returncode == 2
    assert "gpu-check: '/nonexistent' is no Python" in answer.stderr
    assert not (checkout.folder / "calls").exists()
