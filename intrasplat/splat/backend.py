"""Choose the device, an NVIDIA GPU (Triton kernels) or the processor (Numba kernels), and create the model for it."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import Literal, get_args

import torch

from intrasplat.errors import InputError, UnavailableError
from intrasplat.machine.gpu import Gpu, find_gpu
from intrasplat.names import DeviceName
from intrasplat.splat.cpu.model import CpuModel
from intrasplat.splat.deformation import Deformation, motion_named
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.model import Model

logger = logging.getLogger(__name__)

CPU_BY_OPTION, CPU_BY_VARIABLE = "--device cpu", "INTRASPLAT_DEVICE=cpu"
"""How a user chooses the CPU for one reconstruction, and for a worker."""


@dataclass(frozen=True)
class Device:
    """Where a model is trained and rendered.

    kind    the user's name for it
    name    the GPU's product name, for reports
    memory  torch's name of the device that holds its tensors
    """

    kind: Literal["cpu", "cuda"]
    name: str = ""
    memory: str = "cpu"

    def __str__(self) -> str:
        return f"{self.kind} ({self.name})" if self.name else self.kind


CPU = Device("cpu")


def choose_device(asked: str, gpu: Gpu | None = None, *, cpu_by: str = CPU_BY_OPTION) -> Device:
    """The device for auto, cpu or cuda; auto chooses the GPU if all of its requirements are met, otherwise the CPU.

    Args:
        gpu: the GPU found; None searches for one.
        cpu_by: how the caller's user chooses the CPU, for the remedy.

    Raises:
        InputError: there is no device of that name.
        UnavailableError: cuda is requested, and one of its requirements is not met.
    """
    if asked not in get_args(DeviceName):
        raise InputError("options.device", f"there is no device {asked!r}.", "Use auto, cpu or cuda.")
    if asked == "cpu":
        return CPU
    gpu = gpu or find_gpu()
    if gpu.name is not None and not gpu.missing:
        return Device("cuda", gpu.name, "cuda")
    if asked == "auto":
        return CPU
    problem = f"device 'cuda' was asked for, but {gpu.missing}."
    raise UnavailableError(problem, f"{gpu.remedy}, or train on the CPU: {cpu_by}.")


def examine(device: Device) -> float:
    """Compile the GPU's splatting kernels and check, once per process, that their images and gradients match the
    reference; returns the seconds it took.

    Raises:
        UnavailableError: they differ by more than agreement.LIMIT, or do not run; the log has the error.
    """
    start = time.perf_counter()
    if device.kind == "cuda":
        try:
            from intrasplat.splat.cuda import agreement

            agreement.check(device.memory, device.name)
        except UnavailableError:
            raise
        except Exception as error:  # driver, compiler and memory errors have many types
            logger.error("%s cannot be used", device, exc_info=error)
            problem = f"{device} cannot be used ({type(error).__name__})."
            remedy = f"Free or mend the GPU (see the log), or use the CPU ({CPU_BY_OPTION}, {CPU_BY_VARIABLE})."
            raise UnavailableError(problem, remedy) from error
    return time.perf_counter() - start


def gpu_is_lost() -> bool:
    """Whether this process can no longer use its GPU, because after an error every use fails."""
    if not torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        return False
    try:
        # Only this stream: waiting for the whole device would break the graph that another thread may be capturing.
        torch.cuda.current_stream().synchronize()
    except RuntimeError:
        return True
    return False


def device_for(deformation: str, asked: str, gpu: Gpu | None = None) -> Device:
    """The device for training a motion of this name: like choose_device, but auto is the CPU if it has no GPU kernels.

    Raises:
        InputError: cuda is requested, and the motion trains on the CPU only; or there is no device of that name.
        UnavailableError: as choose_device.
    """
    device = choose_device(asked, gpu)
    if device.kind == "cpu" or motion_named(deformation).has_kernels:
        return device
    if asked == "cuda":
        problem = f"cuda was asked for, but motion {deformation!r} trains on the CPU only."
        raise InputError("options.device", problem, "Use auto or cpu, or another preset.")
    return CPU


def make_model(gaussians: Gaussians, deformation: Deformation, width: int, height: int, device: Device = CPU) -> Model:
    """The model that trains and renders these Gaussians (on the host) and their motion on the device.

    A motion without kernels stays on the CPU, whatever the device. Triton is imported only for a GPU.

    Raises:
        UnavailableError: as examine.
    """
    if device.kind == "cpu" or not deformation.has_kernels:
        return CpuModel(gaussians, deformation, width, height)
    from intrasplat.splat.cuda.model import CudaModel

    examine(device)
    model: Model = CudaModel(gaussians, deformation, width, height, device.memory)
    return model
