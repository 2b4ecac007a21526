"""What each kernel of a training step or a picture must move and compute, and the least time that takes on a card.

Symbols: N Gaussians (padded), F frames a step, B bases, A of them in use, C channels that move, M slots there is room
for. Bytes count every array once for each time it is read or written; what stays in the cache is counted alike, so the
floor of a small kernel may be undercut, and that of a large one may not.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from gpu_compile import Compiled
from gpu_counts import Counts

from worker.raster.cuda.bins import EXTENT, FILL_BLOCK, SLOT
from worker.raster.cuda.project import RECORD
from worker.raster.cuda.project_backward import SUMS
from worker.raster.cuda.update import ROWS, VALUES

FLOAT = 4
PARTS = {
    "deform_linear": "deform", "deform_fdm": "deform", "project": "project", "depth sort": "sort", "ranges": "bin",
    "fill_slots": "bin", "tile sort": "sort", "tile starts": "bin", "blend": "blend", "sum_slots": "project backward",
    "project_backward": "project backward", "update_linear": "update", "update_fdm": "update", "control": "control",
}  # fmt: skip
"""Part of the step by kernel; what torch launches has names with a blank."""
IN_PICTURES = ("deform", "project", "sort", "bin", "blend", "control")
RADIX_BITS = 8
"""Of a key that one pass of torch.sort (CUB's onesweep) puts in order."""
SORT_LAUNCHES = 4
"""Of torch.sort beside its passes: indices filled in, counters cleared, histogram, its running sum. As its source says;
not seen on a device."""


@dataclass(frozen=True)
class Card:
    """Peaks of a GPU, a second: bytes of its memory, clock ticks, multiprocessors; and us between two nodes of a graph.

    Of one multiprocessor and tick: four instructions of any kind for a warp, of which a special function (exp2, rsqrt)
    takes eight ticks of its quarter, a float64 one two; one TF32 product of 16 x 8 x 8.
    """

    name: str
    bytes_per_s: float
    ticks_per_s: float
    multiprocessors: int
    launch_us: tuple[float, float]

    def us(self, instructions_a_warp: float, per_tick: float) -> float:
        """Microseconds for so many instructions, of which a multiprocessor makes per_tick."""
        return 1e6 * instructions_a_warp / (per_tick * self.multiprocessors * self.ticks_per_s)


H200 = Card("NVIDIA H200 (data sheet)", 4.3e12, 1.98e9, 132, (1.5, 2.5))
"""4.3 TB/s is what copies reach; 1.98 GHz x 132 x 128 multiply-adds are the 67 TFLOP/s of the data sheet."""
ISSUED, SPECIAL, DOUBLE, MATRIX = 4.0, 0.5, 2.0, 1.0


@dataclass(frozen=True)
class Sizes:
    """What a step works on."""

    gaussians: int
    frames: int
    pixels: int
    bases: int
    alive: int
    channels: int
    is_fdm: bool
    capacity: int
    key_bytes: int

    @property
    def motion(self) -> int:
        """Numbers of a Gaussian's motion that a step reads."""
        return 3 * 10 * self.bases if self.is_fdm else self.channels * self.alive


def bytes_by_kernel(sizes: Sizes, counts: Counts) -> dict[str, float]:
    """Bytes that a step reads and writes, by kernel; counts are of one of its frames."""
    n, f, m, key = sizes.gaussians, sizes.frames, sizes.capacity, sizes.key_bytes
    deform, update = ("deform_fdm", "update_fdm") if sizes.is_fdm else ("deform_linear", "update_linear")
    pixels_of_tile = counts.tile_width * counts.tile_height
    passes = 8 * key // RADIX_BITS
    visited = counts.visited * (2 * (FLOAT + FLOAT * RECORD) + 8)
    scratch = 2 * FLOAT * counts.chunks * pixels_of_tile
    return {
        deform: f * n * FLOAT * (ROWS + sizes.motion + ROWS + 3),
        "project": f * n * FLOAT * (10 + 1 + 3 + RECORD + EXTENT + 2),
        "depth sort": f * n * (4 + 8 + 4 * 2 * (4 + 8)),
        "ranges": f * n * (8 + 4 + 4 + 4 + 8),
        "fill_slots": f * counts.instances * (8 + 4 + FLOAT * EXTENT) + f * n * 4 + m * (key + 4),
        "tile sort": m * (key + 8 + passes * 2 * (key + 8)),
        "tile starts": m * (8 + 4 + 4) + f * counts.tiles * FLOAT,
        "blend": f * (visited + scratch + FLOAT * SLOT * counts.instances + 8 * sizes.pixels + 16 * counts.tiles),
        "sum_slots": f * counts.instances * (FLOAT * SLOT + key) + f * n * FLOAT * (4 + SUMS),
        "project_backward": f * n * FLOAT * (10 + 2 + SUMS + 10 + 1 + 3 + 1),
        update: n * FLOAT * (f * (10 + 1 + 3 + 3 + 1) + 2 * VALUES + 4 * VALUES + 6 * sizes.motion),
        "control": 1000.0,
    }


def picture_bytes_by_kernel(sizes: Sizes, counts: Counts) -> dict[str, float]:
    """Likewise of pictures: no step's way back, and five planes a pixel written."""
    of_step = bytes_by_kernel(sizes, counts)
    kept = {kernel: moved for kernel, moved in of_step.items() if PARTS[kernel] in IN_PICTURES}
    read = counts.visited * (FLOAT + FLOAT * RECORD) + 2 * FLOAT * counts.tiles
    return kept | {"blend": sizes.frames * (read + 5 * FLOAT * sizes.pixels)}


@dataclass(frozen=True)
class Floor:
    """The least us a kernel takes, by what limits it; launches of it a step."""

    launches: int
    bytes: float
    limits_us: dict[str, float]

    @property
    def us(self) -> float:
        """What cannot be undercut, by the card's data."""
        return max(self.limits_us.values())

    @property
    def limit(self) -> str:
        """Which of the limits that is."""
        return max(self.limits_us, key=lambda name: self.limits_us[name])


def floor_of(kernel: Compiled | None, moved: float, launches: int, counts: Counts, frames: int, card: Card) -> Floor:
    """Of one kernel; None is one of torch's, of which the bytes alone are known."""
    limits = {"memory": 1e6 * moved / card.bytes_per_s}
    if kernel is not None:
        made = _instructions(kernel, counts, frames)
        limits["instructions"] = card.us(made.total(), ISSUED)
        limits["special functions"] = card.us(made["MUFU"], SPECIAL)
        limits["float64"] = card.us(sum(made[kind] for kind in ("DFMA", "DMUL", "DADD", "DSETP")), DOUBLE)
        limits["matrix products"] = card.us(made["HMMA"], MATRIX)
    return Floor(launches, moved, limits)


def _instructions(kernel: Compiled, counts: Counts, frames: int) -> Counter[str]:
    """Instructions of all warps, by kind. Of blend every chunk's; of others each instruction once, which is too few
    where they loop. Programs of fill_slots beyond the instances end at once."""
    programs = kernel.programs
    if kernel.name == "fill_slots":
        programs = min(programs, -(-frames * counts.instances // FILL_BLOCK))
    warps = programs * kernel.warps
    made: Counter[str] = Counter({kind: number * warps for kind, number in kernel.kinds.items()})
    if kernel.name == "blend":
        for loop in kernel.loops[:2]:  # the first composites, the second is the way back
            for kind, number in loop.items():
                made[kind] += number * (counts.chunks * frames * kernel.warps - warps)
    return made


def torch_launches(operations: list[tuple[str, int]]) -> dict[str, int]:
    """Kernels behind torch's operations of a step, (name, bytes of the key) in order, by the names of PARTS."""
    found: dict[str, int] = {"depth sort": 0, "tile sort": 0, "ranges": 0, "tile starts": 0, "control": 0}
    sorts = 0
    for name, key_bytes in operations:
        if name == "sort":
            sorts += 1
            found["depth sort" if sorts == 1 else "tile sort"] += SORT_LAUNCHES + 8 * key_bytes // RADIX_BITS
        elif name == "cumsum":
            found["ranges"] += 2
        elif name == "index_select":
            found["ranges" if sorts == 1 else "tile starts"] += 1
        elif name == "searchsorted":
            found["tile starts"] += 1
        elif name == "copy_":
            found["control"] += 1
    return found
