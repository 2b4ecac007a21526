"""What a GPU takes is looked for where torch and Triton look for it."""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
import torch

from intrasplat.machine.gpu import find_gpu
from tests.conftest import REPOSITORY

without_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, in which alone programs are looked for; CC is not set."""
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("name", ["gcc", "clang"])
def test_a_c_compiler_is_looked_for_where_triton_looks(name: str, programs: Path) -> None:
    assert not find_gpu().has_compiler
    (programs / name).touch(mode=0o755)
    assert find_gpu().has_compiler


@pytest.mark.parametrize("named", ["/nonexistent", "", "gcc -m64"])
def test_a_cc_that_cannot_be_run_is_no_compiler_although_gcc_is_there(
    named: str, programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (programs / "gcc").touch(mode=0o755)
    monkeypatch.setenv("CC", named)
    assert not find_gpu().has_compiler
    monkeypatch.setenv("CC", str(programs / "gcc"))
    assert find_gpu().has_compiler


def test_pythons_headers_are_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sysconfig, "get_path", lambda name, scheme: str(tmp_path))
    assert not find_gpu().has_headers
    (tmp_path / "Python.h").touch()
    assert find_gpu().has_headers


def test_the_version_of_triton_is_the_installed_ones() -> None:
    pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")
    assert find_gpu().triton == importlib.metadata.version("triton")


@without_gpu
def test_this_machine_without_a_gpu_is_seen_as_one() -> None:
    gpu = find_gpu()
    assert gpu.name is None
    assert gpu.missing
    assert gpu.remedy


@without_gpu
def test_tests_that_are_to_run_on_a_missing_gpu_end_at_once_with_the_remedy() -> None:
    command = [sys.executable, "-m", "pytest", "--device", "cuda", "tests/intrasplat/machine/test_gpu.py"]
    bare = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}  # plugins take longer to load than the check
    answer = subprocess.run(command, cwd=REPOSITORY, env=bare, capture_output=True, text=True, timeout=120, check=False)
    gpu = find_gpu()
    assert answer.returncode == pytest.ExitCode.USAGE_ERROR
    assert f"--device cuda was asked for, but {gpu.missing}. {gpu.remedy}." in answer.stderr
