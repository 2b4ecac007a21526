"""Which device is taken, what is said where it cannot be, and that nothing of a GPU is loaded without one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from contract.wire.errors import InputError, UnavailableError
from tests.worker.models import HEIGHT, WIDTH, moving_fdm, moving_hexplane, moving_shared, wall
from worker.machine.gpu import Gpu
from worker.methods.registry import PRESETS
from worker.raster.backend import (
    CPU,
    CPU_BY_VARIABLE,
    Device,
    choose_device,
    device_for,
    gpu_is_lost,
    make_model,
)
from worker.raster.cpu.model import CpuModel

H200 = Gpu(build="13.0", name="NVIDIA H200", triton="3.6.0")
CPU_BUILD = Gpu(build=None, name=None, triton=None)
NO_GPU = Gpu(build="13.0", name=None, triton="3.6.0")
NO_TRITON = Gpu(build="13.0", name="NVIDIA H200", triton=None)
OLD_TRITON = Gpu(build="12.8", name="NVIDIA H200", triton="3.5.1")
NEW_TRITON = Gpu(build="13.2", name="NVIDIA H200", triton="3.10.0+git1a2b3c4d")
NO_COMPILER = Gpu(build="13.0", name="NVIDIA H200", triton="3.6.0", has_compiler=False)
NO_HEADERS = Gpu(build="13.0", name="NVIDIA H200", triton="3.6.0", has_headers=False)
UNUSABLE = (CPU_BUILD, NO_GPU, NO_TRITON, OLD_TRITON, NEW_TRITON, NO_COMPILER, NO_HEADERS)


def test_auto_takes_the_gpu_where_everything_is_there_and_else_the_cpu() -> None:
    assert choose_device("auto", H200) == Device("cuda", "NVIDIA H200", "cuda")
    for gpu in UNUSABLE:
        assert choose_device("auto", gpu) == CPU


def test_what_is_asked_for_by_name_is_taken() -> None:
    assert choose_device("cpu", H200) == CPU
    assert choose_device("cuda", H200).kind == "cuda"


@pytest.mark.parametrize(
    ("gpu", "said", "remedy"),
    [
        (CPU_BUILD, "torch is a CPU build and Triton is not installed", "TORCH_INDEX"),
        (NO_GPU, "torch sees no NVIDIA GPU", "nvidia-smi"),
        (NO_TRITON, "Triton is not installed", ".venv/bin/pip install '.[gpu]'"),
        (OLD_TRITON, "Triton is 3.5.1, where 3.6 to 3.9 are supported", "do not change Triton alone"),
        (NEW_TRITON, "Triton is 3.10.0+git1a2b3c4d, where 3.6 to 3.9 are supported", "do not change Triton alone"),
        (NO_COMPILER, "Triton finds no C compiler", "apt install gcc python3-dev"),
        (NO_HEADERS, "Triton finds no Python.h", "apt install python3-dev"),
    ],
)
def test_a_gpu_that_cannot_be_used_is_refused_with_what_is_missing_and_the_remedy(
    gpu: Gpu, said: str, remedy: str
) -> None:
    with pytest.raises(UnavailableError) as refused:
        choose_device("cuda", gpu)
    assert said in refused.value.problem
    assert remedy in refused.value.remedy
    assert refused.value.remedy.endswith("--device cpu.")
    with pytest.raises(UnavailableError, match=CPU_BY_VARIABLE):
        choose_device("cuda", gpu, cpu_by=CPU_BY_VARIABLE)


def test_a_device_that_is_not_known_is_refused() -> None:
    with pytest.raises(InputError, match="tpu") as refused:
        choose_device("tpu", H200)
    assert refused.value.field == "options.device"


def test_a_motion_without_kernels_for_a_gpu_trains_on_the_cpu_and_not_on_a_gpu_that_was_asked_for() -> None:
    motion = PRESETS["hexplane"].deformation
    assert device_for(motion, "auto", H200) == device_for(motion, "cpu", H200) == CPU
    with pytest.raises(InputError, match="hexplane") as refused:
        device_for(motion, "cuda", H200)
    assert refused.value.field == "options.device"
    with pytest.raises(UnavailableError):
        device_for(motion, "cuda", NO_GPU)
    for preset in PRESETS.values():
        if preset.deformation != motion:
            assert device_for(preset.deformation, "auto", H200).kind == "cuda"


def test_reports_name_the_gpu() -> None:
    assert str(CPU) == "cpu"
    assert str(choose_device("auto", H200)) == "cuda (NVIDIA H200)"


def test_the_model_of_a_motion_is_that_of_the_device() -> None:
    gaussians = wall()
    for moving in (moving_shared, moving_fdm):
        assert type(make_model(gaussians, moving(gaussians), WIDTH, HEIGHT)) is CpuModel
    for device in (CPU, Device("cuda", "NVIDIA H200", "cuda")):
        assert type(make_model(gaussians, moving_hexplane(gaussians), WIDTH, HEIGHT, device)) is CpuModel


def test_a_process_that_has_used_no_gpu_has_lost_none() -> None:
    assert not gpu_is_lost()


@pytest.mark.parametrize("lost", [False, True])
def test_whether_a_gpu_is_lost_is_asked_of_the_threads_own_stream(lost: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    class Stream:
        def synchronize(self) -> None:
            if lost:
                raise RuntimeError("CUDA error: an illegal memory access was encountered")

    def whole_device() -> None:
        raise RuntimeError("CUDA error: operation not permitted when stream is capturing")

    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_stream", Stream)
    monkeypatch.setattr(torch.cuda, "synchronize", whole_device)
    assert gpu_is_lost() == lost


def test_without_a_gpu_nothing_of_triton_is_loaded() -> None:
    program = (
        "import sys, worker.pipeline, worker.daemon.views;"
        "from worker.raster.backend import choose_device; choose_device('auto');"
        "print(*(each for each in sys.modules if each == 'triton' or each.startswith('worker.raster.cuda')))"
    )
    environment = {"PATH": "", "CUDA_VISIBLE_DEVICES": "", "HOME": str(Path.home())}
    folder = Path(__file__).parents[3]
    command = [sys.executable, "-c", program]
    result = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=True
    )
    assert result.stdout.split() == []
