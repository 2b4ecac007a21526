"""The kernels of a training step compiled for an H200 on a machine without one: registers, memory, instructions.

The step itself is run, on CPU tensors, with Triton's driver replaced by one that knows an sm_90 and launches nothing:
so every kernel is compiled for exactly the arguments that the step gives it. ptxas and cuobjdump come with Triton.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.runtime.driver import driver
from triton.runtime.jit import JITFunction

from worker.raster.cuda import rasterizer

WARP = 32
_TOOLS = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"
_INSTRUCTION = re.compile(r"\s+/\*([0-9a-f]{4,})\*/\s+(?:@!?U?P\w+\s+)?([A-Z][A-Z0-9_]*)(.*?);")
_TARGET = re.compile(r"0x([0-9a-f]+)\s*$")


@dataclass(frozen=True)
class Multiprocessor:
    """What programs share on one multiprocessor of compute capability 9.0 (CUDA C++ Programming Guide, table of
    technical specifications): warps, programs, registers, and bytes of shared memory, of which each program loses some.
    """

    warps: int = 64
    programs: int = 32
    registers: int = 65_536
    shared: int = 228 * 1024
    reserved: int = 1024

    def programs_at_once(self, warps: int, registers: int, shared: int) -> int:
        """Programs of so many warps, registers a thread and bytes of shared memory that fit at the same time."""
        registers_a_warp = -(-registers // 8) * 8 * WARP
        return min(
            self.programs,
            self.warps // warps,
            self.registers // registers_a_warp // warps,
            self.shared // (shared + self.reserved),
        )


@dataclass(frozen=True)
class Compiled:
    """A kernel as it was launched. kinds: how often its code has which instruction, each for a whole warp; loops:
    likewise, of each innermost loop in the order of the code."""

    name: str
    programs: int
    warps: int
    registers: int
    spilled_bytes: int
    shared_bytes: int
    kinds: Counter[str]
    loops: tuple[Counter[str], ...]

    @property
    def programs_at_once(self) -> int:
        """On a multiprocessor."""
        return Multiprocessor().programs_at_once(self.warps, self.registers, self.shared_bytes)


class NoDevice:
    """A driver of Triton that knows what to compile for."""

    def get_current_target(self) -> GPUTarget:
        return GPUTarget("cuda", 90, WARP)

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return device

    def get_active_torch_device(self) -> torch.device:
        return torch.device("cpu")


def compiled(work: Callable[[], object]) -> list[Compiled]:
    """The kernels that work launches on CPU tensors, in order; nothing is launched, so tensors keep what they hold."""
    launched: list[tuple[str, tuple[int, ...], Any]] = []
    run = JITFunction.run

    def compile_alone(kernel: Any, *arguments: Any, grid: tuple[int, ...], warmup: bool, **options: Any) -> Any:
        binary = run(kernel, *arguments, grid=grid, warmup=True, **options)
        launched.append((kernel.__name__, grid, binary))
        return binary

    active = driver._active
    driver.set_active(NoDevice())
    JITFunction.run = compile_alone
    try:
        work()
    finally:
        JITFunction.run = run
        driver._active = active
    return [_inspected(*each) for each in launched]


@contextmanager
def shaped(width: int, height: int, chunk: int, warps: int) -> Iterator[None]:
    """Rasterisers made inside have tiles of this shape, blended in such chunks by so many warps."""
    constants = {"TILE_WIDTH": width, "TILE_HEIGHT": height, "CHUNK": chunk, "WARPS": warps}
    usual = {name: getattr(rasterizer, name) for name in constants}
    try:
        for name, value in constants.items():
            setattr(rasterizer, name, value)
        yield
    finally:
        for name, value in usual.items():
            setattr(rasterizer, name, value)


def _inspected(name: str, grid: tuple[int, ...], binary: Any) -> Compiled:
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(binary.asm["cubin"])
        file.flush()
        usage, code = (_cuobjdump(option, file.name) for option in ("--dump-resource-usage", "-sass"))
    found = {key: int(value) for key, value in re.findall(r"(REG|STACK|LOCAL):(\d+)", usage)}
    instructions = [(int(at, 16), kind, rest) for at, kind, rest in _INSTRUCTION.findall(code)]
    programs = 1
    for each in grid:
        programs *= each
    return Compiled(
        name, programs, binary.metadata.num_warps, found["REG"], found["STACK"] + found["LOCAL"],
        binary.metadata.shared, Counter(kind for _, kind, _ in instructions), tuple(_innermost(instructions)),
    )  # fmt: skip


def _cuobjdump(option: str, path: str) -> str:
    command = [str(_TOOLS / "cuobjdump"), option, path]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


def _innermost(instructions: list[tuple[int, str, str]]) -> Iterator[Counter[str]]:
    """Loops that hold no other: from a branch's target back to the branch. A branch to itself only fills the end."""
    found = []
    for at, kind, rest in instructions:
        target = _TARGET.search(rest) if kind == "BRA" else None
        if target and int(target[1], 16) < at:
            found.append((int(target[1], 16), at))
    for first, last in sorted(found):
        if not any(first <= other and end <= last and (first, last) != (other, end) for other, end in found):
            yield Counter(kind for at, kind, _ in instructions if first <= at <= last)
