"""Kernels are compiled ahead, once, by any number of processes, and with no folder to keep them in."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.conftest import REPOSITORY


def start(*arguments: str, cache: Path) -> subprocess.Popen[str]:
    """A fresh interpreter whose kernels are kept in the folder cache."""
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=REPOSITORY,
        env={**os.environ, "INTRASPLAT_CACHE": str(cache)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> tuple[str, str]:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return out, err


def answer_of(process: subprocess.Popen[str]) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads(finish(process)[0])
    return answer


def test_compiling_ahead_leaves_no_kernel_to_be_compiled_later() -> None:
    program = [sys.executable, "-m", "tests.intrasplat.splat.compile_probe"]
    process = subprocess.Popen(program, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    answer = answer_of(process)  # kernels that other tests compiled are loaded, so this takes seconds
    assert answer["later"] == [], "compile_kernels left these for the first clip"
    assert answer["shares"] == sorted(answer["shares"])
    assert answer["shares"][-1] == 1


def test_two_processes_that_compile_at_once_leave_a_cache_that_serves_a_third(tmp_path: Path) -> None:
    both = [start("-c", MEAN, cache=tmp_path) for _ in range(2)]
    answers = [answer_of(process) for process in both]
    answers.append(answer_of(start("-c", MEAN, cache=tmp_path)))
    assert [answer["mean"] for answer in answers] == [4] * 3
    assert [answers[0][key] + answers[1][key] for key in ("loaded", "compiled")] in ([0, 2], [1, 1])
    assert (answers[2]["loaded"], answers[2]["compiled"]) == (1, 0)


def test_without_a_folder_to_keep_them_in_kernels_are_compiled_into_a_temporary_one(tmp_path: Path) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.touch()
    out, err = finish(start("-c", WHERE, cache=in_the_way))
    mean, temporary = out.split()
    assert mean == "4"
    assert str(in_the_way) in err
    assert "set INTRASPLAT_CACHE to a folder that can be written" in err
    assert "intrasplat-kernels-" in temporary
    assert not Path(temporary).exists(), "the temporary folder is left behind"


def test_declaring_kernels_touches_no_file(tmp_path: Path) -> None:
    _, err = finish(start("-c", "import intrasplat.splat.cpu, intrasplat.scene.compact", cache=tmp_path / "kernels"))
    assert not err
    assert not list(tmp_path.iterdir())


WHERE = """
import numba
from intrasplat.scene.differences import _mean
print(_mean(2, 6, 0, 0, 1), numba.config.CACHE_DIR)
"""
"""Compiles one small kernel, so that the folder is really used."""

MEAN = """
import json
from intrasplat.scene.differences import _mean

mean, stats = _mean(2, 6, 0, 0, 1), _mean.stats
print(json.dumps({"mean": mean, "loaded": stats.cache_hits.total(), "compiled": stats.cache_misses.total()}))
"""
"""Uses the kernel that is compiled soonest, and says whether it was loaded or compiled."""
