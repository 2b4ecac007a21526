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
from triton.compiler import ASTSource
from triton.runtime.jit import JITFunction

from tests.worker.raster.test_cuda_model import LOSS, RATES, frames, model
from worker.raster.cuda.rasterizer import CudaRasterizer

TARGET = GPUTarget("cuda", 90, 32)
TYPES = {
    torch.float64: "fp64",
    torch.float32: "fp32",
    torch.float16: "fp16",
    torch.int64: "i64",
    torch.int32: "i32",
    torch.int16: "i16",
    torch.uint8: "u8",
}
OPTIONS = ("num_warps", "num_stages")
CUOBJDUMP = Path(inspect.getfile(triton)).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
COUNT, WIDTH, HEIGHT, FRAMES, TIMES = 50, 37, 35, 2, 3

compiled: dict[str, dict[str, Any]] = {}


def compile_launch(kernel: JITFunction, *args: Any, grid: Any, warmup: bool, **named: Any) -> None:
    """In place of JITFunction.run."""
    options = {name: named.pop(name) for name in OPTIONS if name in named}
    given = dict(zip([each.name for each in kernel.params], args, strict=False)) | named
    constants = {each.name: given[each.name] for each in kernel.params if each.is_constexpr}
    title = f"{kernel.__name__} {constants} {options}"
    if title in compiled:
        return
    signature, aligned = {}, {}
    for i, each in enumerate(kernel.params):
        value = given[each.name]
        if each.is_constexpr:
            signature[each.name] = "constexpr"
        elif isinstance(value, torch.Tensor):
            signature[each.name], aligned[(i,)] = f"*{TYPES[value.dtype]}", [["tt.divisibility", 16]]
        else:
            signature[each.name] = "i32"
            if value % 16 == 0 and not each.do_not_specialize:
                aligned[(i,)] = [["tt.divisibility", 16]]
    source = ASTSource(kernel, signature=signature, constexprs=constants, attrs=aligned)
    binary = triton.compile(source, target=TARGET, options=options)
    usage = resources(binary.asm["cubin"])
    compiled[title] = {"kernel": kernel.__name__, "constants": {**constants, **options}, **usage}
    compiled[title]["shared"] = binary.metadata.shared


def resources(binary: bytes) -> dict[str, int]:
    """registers, stack and local of the one kernel in a binary."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(binary)
        file.flush()
        command = [str(CUOBJDUMP), "-res-usage", file.name]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = {name: int(re.findall(rf"{name}:(\d+)", text)[-1]) for name in ("REG", "STACK", "LOCAL")}
    return {"registers": found["REG"], "stack": found["STACK"], "local": found["LOCAL"]}


def launch_everything() -> None:
    """What training, rendering and torch's autograd launch; no kernel runs."""
    rasterizer = CudaRasterizer(WIDTH, HEIGHT, "cpu", frames=FRAMES)
    camera = torch.zeros(FRAMES, 18, dtype=torch.float64)
    rasterizer.project(camera, torch.zeros(FRAMES, 13, COUNT), torch.zeros(COUNT), torch.zeros(FRAMES, 3, COUNT))
    rasterizer.render()
    rasterizer.render(torch.zeros(COUNT))
    clip = [torch.zeros(TIMES, *shape, HEIGHT, WIDTH, dtype=torch.uint8) for shape in ((3,), ())]
    depth = torch.zeros(TIMES, HEIGHT, WIDTH, dtype=torch.float16)
    rasterizer.loss_backward(*clip, depth, torch.zeros(FRAMES, 5), torch.zeros(FRAMES, dtype=torch.int32))
    rasterizer.cotangent_backward(torch.zeros(FRAMES, 5, HEIGHT, WIDTH), pose=True)


def train_everything() -> None:
    """Steps of every form of motion; of one with a harmonic more and of one on several frames. No kernel runs."""
    seen = frames(2)
    for kind in ("shared with colour", "fdm-gaussian", "fdm-quartic"):
        model("cpu", kind).step(seen[0], LOSS, RATES, 1)
    for kind in ("shared with colour", "fdm-gaussian"):
        model("cpu", kind, sh_degree=1, frames_a_step=2).step_frames(seen, LOSS, RATES, 1, sh_degree=1)


def main() -> None:
    JITFunction.run = compile_launch
    launch_everything()
    train_everything()
    print(json.dumps(list(compiled.values())))


if __name__ == "__main__":
    main()
