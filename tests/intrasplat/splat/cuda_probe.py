"""Run as a program: compile every kernel the CUDA backend launches for a GPU that need not be there.

The rasteriser and the model run on the host's tensors with each launch replaced by a compilation for sm_90 (Triton
brings its own assembler), so what is compiled is what would be launched. Prints a JSON list of {kernel, constants,
registers, stack, local, shared}; stack and local are the bytes a thread keeps in memory because its registers did not
suffice.
"""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.runtime.driver import driver
from triton.runtime.jit import JITFunction

from intrasplat.splat.cuda.rasterizer import CudaRasterizer
from intrasplat.splat.layout import CAMERA, ROWS
from tests.intrasplat.splat.test_cuda_model import LOSS, RATES, frames, model

CUOBJDUMP = Path(inspect.getfile(triton)).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
TIMES = 3

compiled: dict[str, dict[str, Any]] = {}
launch = JITFunction.run


class NoDevice:
    """A driver of Triton that compiles for an H200 (sm_90) and needs no GPU."""

    def get_current_target(self) -> GPUTarget:
        return GPUTarget("cuda", 90, 32)

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return device

    def get_active_torch_device(self) -> torch.device:
        return torch.device("cpu")


def compile_launch(kernel: JITFunction, *args: Any, grid: Any, warmup: bool, **named: Any) -> None:
    """In place of JITFunction.run: as it does, as far as it needs no GPU."""
    binary = launch(kernel, *args, grid=grid, warmup=True, **named)
    if binary.hash not in compiled:
        constants = {name: value for name, value in named.items() if not isinstance(value, torch.Tensor)}
        usage = resources(binary.asm["cubin"])
        compiled[binary.hash] = {"kernel": kernel.__name__, "constants": constants, **usage}
        compiled[binary.hash]["shared"] = binary.metadata.shared


def resources(binary: bytes) -> dict[str, int]:
    """registers, stack and local of the one kernel in a binary."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(binary)
        file.flush()
        command = [str(CUOBJDUMP), "-res-usage", file.name]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = {name: int(re.findall(rf"{name}:(\d+)", text)[-1]) for name in ("REG", "STACK", "LOCAL")}
    return {"registers": found["REG"], "stack": found["STACK"], "local": found["LOCAL"]}


def projected(count: int, width: int, height: int, frames: int) -> CudaRasterizer:
    rasterizer = CudaRasterizer(width, height, "cpu", frames=frames)
    camera = torch.zeros(frames, CAMERA, dtype=torch.float64)
    rasterizer.project_and_sort(
        camera, torch.zeros(frames, ROWS, count), torch.zeros(count), torch.zeros(frames, 3, count)
    )
    return rasterizer


def rasterize_everything() -> None:
    """What training, rendering and torch's autograd launch; no kernel runs."""
    count, width, height, frames = 50, 37, 35, 2
    rasterizer = projected(count, width, height, frames)
    rasterizer.render()
    rasterizer.render(torch.zeros(count))
    clip = [torch.zeros(TIMES, *shape, height, width, dtype=torch.uint8) for shape in ((3,), ())]
    depth = torch.zeros(TIMES, height, width, dtype=torch.float16)
    rasterizer.loss_backward(*clip, depth, torch.zeros(frames, 5), torch.zeros(frames, dtype=torch.int32))
    rasterizer.cotangent_backward(torch.zeros(frames, 5, height, width), pose=True)
    projected(1, 1, 1, 1).render()  # Triton makes a constant of every 1 it is given


def train_everything() -> None:
    """Steps of every form of motion; of one with a harmonic more and of one on several frames. No kernel runs."""
    seen = frames(2)
    for kind in ("shared with colour", "fdm-gaussian", "fdm-quartic"):
        model("cpu", kind).step(seen[:1], LOSS, RATES, 1)
    for kind in ("shared with colour", "fdm-gaussian"):
        model("cpu", kind, sh_degree=1).step(seen, LOSS, RATES, 1, sh_degree=1)


def main() -> None:
    driver.set_active(NoDevice())
    JITFunction.run = compile_launch
    rasterize_everything()
    train_everything()
    print(json.dumps(list(compiled.values())))


if __name__ == "__main__":
    main()
