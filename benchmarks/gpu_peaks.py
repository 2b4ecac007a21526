"""What the card itself can do, measured: bytes, multiply-adds and exponentials a second; launches in a graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from gpu_rows import Part, device_ms

BLOCK, CHAINS, UNROLLED = 512, 8, 8
"""Threads of a program times two; independent chains of each; repetitions of a loop's body."""
_UNROLLED = tl.constexpr(UNROLLED)


@triton.jit
def multiply_add(out, rounds, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Eight chains of multiply-adds a number, enough to hide an instruction's latency."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    a = at.to(tl.float32)
    b, c, d, e, f, g, h = a + 1.0, a + 2.0, a + 3.0, a + 4.0, a + 5.0, a + 6.0, a + 7.0
    x, y = 0.999 + 0.0 * a, 0.001 + 0.0 * a
    left = rounds
    while left > 0:
        for _ in tl.static_range(_UNROLLED):
            a, b, c, d = tl.fma(a, x, y), tl.fma(b, x, y), tl.fma(c, x, y), tl.fma(d, x, y)
            e, f, g, h = tl.fma(e, x, y), tl.fma(f, x, y), tl.fma(g, x, y), tl.fma(h, x, y)
        left -= 1
    tl.store(out + at, a + b + c + d + e + f + g + h)


@triton.jit
def exponential(out, rounds, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Eight chains of 2^-x a number."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    a = at.to(tl.float32) * 1e-9
    b, c, d, e, f, g, h = a + 0.1, a + 0.2, a + 0.3, a + 0.4, a + 0.5, a + 0.6, a + 0.7
    left = rounds
    while left > 0:
        for _ in tl.static_range(_UNROLLED):
            a, b, c, d = tl.exp2(-a), tl.exp2(-b), tl.exp2(-c), tl.exp2(-d)
            e, f, g, h = tl.exp2(-e), tl.exp2(-f), tl.exp2(-g), tl.exp2(-h)
        left -= 1
    tl.store(out + at, a + b + c + d + e + f + g + h)


@dataclass(frozen=True)
class Peaks:
    """A second, but for the launch: us from one node of a graph to the next."""

    copied_bytes: float
    cached_bytes: float
    multiply_adds: float
    exponentials: float
    launch_us: float


def measure_peaks(part: Part) -> Peaks:
    """The peaks of the part's device."""
    tiny = part.interpret
    large, small = (1 << 12, 1 << 10) if tiny else (1 << 30, 1 << 23)
    programs, rounds = (2, 1) if tiny else (4 * 132 * 4, 256)
    out = torch.empty(programs * BLOCK, device=part.device)
    numbers = programs * BLOCK * CHAINS * UNROLLED * rounds
    return Peaks(
        copied_bytes=_copied(part, large, 1),
        cached_bytes=_copied(part, small, 50),  # 8 MiB there and 8 MiB here stay in the cache
        multiply_adds=_rate(part, lambda: multiply_add[(programs,)](out, rounds, BLOCK=BLOCK), numbers),
        exponentials=_rate(part, lambda: exponential[(programs,)](out, rounds, BLOCK=BLOCK), numbers),
        launch_us=_launch_us(part),
    )


def _rate(part: Part, call: Callable[[], object], numbers: int) -> float:
    return 1e3 * numbers / device_ms(call, part.device, calls=1, rounds=2 if part.interpret else 15)


def _copied(part: Part, size: int, times: int) -> float:
    """Bytes read and written a second by copies of so many bytes, several in a graph."""
    source = torch.randint(0, 255, (size,), dtype=torch.uint8, device=part.device)
    target = torch.empty_like(source)
    copies = graph_of(part.device, lambda: [target.copy_(source) for _ in range(times)])
    return 1e3 * 2 * size * times / device_ms(copies, part.device, calls=1, rounds=2 if part.interpret else 15)


def _launch_us(part: Part) -> float:
    """Of a graph of kernels that have next to nothing to do."""
    number, one = 2 if part.interpret else 200, torch.zeros(32, device=part.device)
    additions = graph_of(part.device, lambda: [one.add_(1.0) for _ in range(number)])
    return 1e3 * device_ms(additions, part.device, calls=1, rounds=2 if part.interpret else 15) / number


def graph_of(device: str, routine: Callable[[], object]) -> Callable[[], object]:
    """The routine's launches as one call, captured after it was run once; the routine where there is no device."""
    routine()
    if device != "cuda":
        return routine
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        routine()
    return graph.replay
