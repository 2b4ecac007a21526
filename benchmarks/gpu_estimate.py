"""What a training step would take on an H200, estimated on a machine without a GPU. Nothing here was run on one.

    python benchmarks/gpu_estimate.py [--scene FOLDER] [--csv docs/results/gpu-estimate.csv] [--quick]

The frame's work is counted on the CPU (gpu_counts.py): of the standard grid of bm_raster.py, 640x512 with 40,096
Gaussians, and with --scene of a trained scene. The kernels of the step are compiled for sm_90 and their machine code is
read (gpu_compile.py). Both together give bytes, instructions and launches of every kernel, and the least time that the
card's data sheet allows them (gpu_work.py). Pictures are estimated likewise, one and sixteen at once. Tiles of other
shapes are compiled and counted too; --quick omits them, and whatever draws several frames.

A floor is not a forecast: kernels wait for memory, and the last programs of each run alone. As a forecast the sum of
the floors is given twice over, with 2.5 us for each launch; nearest to the floor would be once, with 1.5 us.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import triton
from bm_raster import BASES, GRID_STEP_PX, HEIGHT, RATES, TIME, WIDTH, grid_scene
from gpu_compile import Compiled, compiled, shaped
from gpu_counts import Counts, count
from gpu_work import H200, PARTS, Floor, Sizes, bytes_by_kernel, floor_of, picture_bytes_by_kernel, torch_launches
from torch.utils._python_dispatch import TorchDispatchMode

from worker.evaluate.rows import commit, machine, write_rows
from worker.model.deformation import Deformation, FlexibleDeformation, SharedBasis
from worker.model.gaussians import Gaussians
from worker.model.loss import LossSettings
from worker.raster.cpu import padded
from worker.raster.cpu.model import FusedModel
from worker.raster.cpu.motion import NEGLIGIBLE
from worker.raster.cuda.bins import TILE_HEIGHT, TILE_WIDTH
from worker.raster.cuda.blend import CHUNK, WARPS
from worker.raster.cuda.model import CudaModel
from worker.raster.cuda.rasterizer import CudaRasterizer
from worker.raster.step import Target, TrainingFrame, camera_vector
from worker.scene.checkpoint import load_scene
from worker.train.targets import camera_in_units

SHAPES = ((8, 4, 16, 1), (8, 8, 16, 1), (8, 8, 16, 2), (8, 8, 32, 1), (16, 8, 16, 2), (16, 8, 16, 4), (16, 16, 16, 8))
"""Tiles that are compared: width, height, splats a chunk, warps."""
FORECAST = 2.0
"""Times its floor that a kernel takes; well-made kernels of this kind reach a half to a third of what they could."""
Row = dict[str, Any]


class _Operations(TorchDispatchMode):
    """torch's operations and the bytes of their first argument's numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[str, int]] = []

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        size = args[0].element_size() if args and isinstance(args[0], torch.Tensor) else 0
        self.seen.append((operation.overloadpacket.__name__, size))
        return operation(*args, **(kwargs or {}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, help="folder of a stored scene, estimated beside the standard grid")
    parser.add_argument("--csv", type=Path, help="file that gets a row a kernel")
    parser.add_argument("--quick", action="store_true", help="leave out tiles of other shapes, and several frames")
    arguments = parser.parse_args()
    grid, camera = grid_scene(WIDTH, HEIGHT, GRID_STEP_PX)
    view, number = camera_vector(camera), len(grid)
    shared = SharedBasis.initial(number, bases=BASES, colour=True)
    usual = (TILE_WIDTH, TILE_HEIGHT, CHUNK, WARPS)
    rows = estimate("grid, shared", grid, shared, view, 1, usual)
    rows += estimate("grid, shared, a picture", grid, shared, view, 1, usual, part="picture")
    if not arguments.quick:
        rows += estimate("grid, shared, 4 frames a step", grid, shared, view, 4, usual)
        rows += estimate("grid, shared, 16 pictures at once", grid, shared, view, 16, usual, part="picture")
    fdm = FlexibleDeformation.initial(number, bases=BASES)
    rows += estimate("grid, fdm", grid, fdm, view, 1, usual)
    if arguments.scene:
        rows += _stored(arguments.scene, usual)
    if not arguments.quick:
        for shape in SHAPES:
            if shape != usual:
                rows += estimate("grid, shared", grid, shared, view, 1, shape, parts=False)
    if arguments.csv:
        _write(arguments.csv, rows)


def _stored(folder: Path, shape: tuple[int, int, int, int]) -> list[Row]:
    scene = load_scene(folder)
    camera = camera_vector(camera_in_units(scene.intrinsics, scene.world_from_camera[0], scene.units_per_mm))
    return estimate(f"trained, {scene.deformation.kind}", scene.gaussians, scene.deformation, camera, 1, shape)


def estimate(
    name: str,
    gaussians: Gaussians,
    deformation: Deformation,
    camera: np.ndarray,
    frames: int,
    shape: tuple[int, int, int, int],
    *,
    part: str = "step",
    parts: bool = True,
) -> list[Row]:
    """Rows of the kernels of a "step" or a "picture", then one of the whole; printed, with the kernels if wanted."""
    width, height = int(camera[4]), int(camera[5])
    counts = count(FusedModel(gaussians, deformation, width, height), camera, TIME, shape[:2], shape[2])
    operations = _Operations()
    with shaped(*shape):
        model = CudaModel(gaussians, deformation, width, height, "cpu")  # type: ignore[arg-type]
        work = _work(model, camera, [TIME + k / 100 for k in range(frames)], part)
        compiled(work)  # the first step alone copies its frames
        with operations:
            kernels = compiled(work)
    sizes = _sizes((model._shown or model._training).rasterizer, deformation, width * height)
    launches = torch_launches(operations.seen)
    floors = {}
    for kernel, moved in (picture_bytes_by_kernel if part == "picture" else bytes_by_kernel)(sizes, counts).items():
        code = next((each for each in kernels if each.name == kernel), None)
        floors[kernel] = floor_of(code, moved, launches.get(kernel, 1), counts, frames, H200)
    rows = [_row(name, counts, sizes, kernel, floor, kernels) for kernel, floor in floors.items()]
    blend = next(each for each in kernels if each.name == "blend")
    whole = {**_whole(name, counts, sizes, list(floors.values()), blend), "part": part}
    _print(whole, rows if parts else [])
    return [*rows, whole]


def _work(model: CudaModel, camera: np.ndarray, times: list[float], part: str) -> Callable[[], object]:
    """A step, or a picture, of so many frames."""
    if part == "picture":
        return lambda: model.render_times(camera, times)
    seen = [_frame(camera, t) for t in times]
    return lambda: model.step(seen, LossSettings(), RATES, 1)


def _frame(camera: np.ndarray, t: float) -> TrainingFrame:
    """What is in it does not matter: no kernel runs."""
    pixels = int(camera[5]) * padded(int(camera[4]))
    target = Target(np.zeros(3 * pixels, np.uint8), np.zeros(pixels, np.uint8), np.zeros(pixels, np.float32))
    return TrainingFrame(camera, t, target, pixels, pixels)


def _sizes(rasterizer: CudaRasterizer, deformation: Deformation, pixels: int) -> Sizes:
    weight = deformation.parameters()["weight"]
    is_fdm = isinstance(deformation, FlexibleDeformation)
    alive = 0 if is_fdm else int((deformation.basis(TIME).abs() >= NEGLIGIBLE).sum())  # type: ignore[attr-defined]
    return Sizes(
        rasterizer.gaussians, rasterizer.frames, pixels, weight.shape[2], alive, weight.shape[1], is_fdm,
        rasterizer.capacity, rasterizer._key.element_size(),
    )  # fmt: skip


def _row(name: str, counts: Counts, sizes: Sizes, kernel: str, floor: Floor, kernels: list[Compiled]) -> Row:
    code = next((each for each in kernels if each.name == kernel), None)
    row = _common(name, counts, sizes) | {
        "part": PARTS[kernel], "kernel": kernel, "launches": floor.launches, "megabytes": round(floor.bytes / 1e6, 2),
        "floor_us": round(floor.us, 2), "limit": floor.limit, "evidence": "estimate",
    }  # fmt: skip
    if code is not None:
        row |= {
            "programs": code.programs, "warps": code.warps, "registers": code.registers,
            "spilled_bytes": code.spilled_bytes, "shared_bytes": code.shared_bytes,
            "warps_at_once": code.programs_at_once * code.warps,
        }  # fmt: skip
        row |= {f"{limit.replace(' ', '_')}_us": round(us, 2) for limit, us in floor.limits_us.items()}
    return row


def _common(name: str, counts: Counts, sizes: Sizes) -> Row:
    return {
        "scene": name, "tile": f"{counts.tile_width}x{counts.tile_height}", "chunk": counts.chunk,
        "gaussians": sizes.gaussians, "frames": sizes.frames, "bases_alive": sizes.alive,
        "instances": counts.instances, "evaluated": counts.evaluated, "blended": counts.blended,
        "triton": triton.__version__, "machine": machine(), "commit": commit(),
    }  # fmt: skip


def _whole(name: str, counts: Counts, sizes: Sizes, floors: list[Floor], blend: Compiled) -> Row:
    """The row of all kernels, with what distinguishes shapes of tiles beside it."""
    launches, floor_us = sum(each.launches for each in floors), sum(each.us for each in floors)
    soonest, latest = H200.launch_us
    moved = sum(each.bytes for each in floors)
    return _common(name, counts, sizes) | {
        "kernel": "all", "launches": launches, "megabytes": round(moved / 1e6, 1),
        "floor_us": round(floor_us, 1), "least_us": round(floor_us + soonest * launches, 1),
        "forecast_us": round(FORECAST * floor_us + latest * launches, 1), "warps": blend.warps,
        "registers": blend.registers, "spilled_bytes": blend.spilled_bytes, "evidence": "estimate",
        "warps_at_once": blend.programs_at_once * blend.warps,
    }  # fmt: skip


def _print(whole: Row, rows: list[Row]) -> None:
    print(
        f"{whole['scene']}, Triton {whole['triton']}, tiles {whole['tile']}, chunks of {whole['chunk']}, "
        f"{whole['warps']} warp{'s' * (whole['warps'] != 1)}: "
        f"{whole['gaussians']} Gaussians, {whole['instances']} instances, {whole['evaluated'] / 1e6:.1f} M pairs "
        f"evaluated, {whole['blended'] / 1e6:.1f} M blended, {whole['megabytes']:.0f} MB, {whole['launches']} launches"
    )
    for row in rows:
        code = f"{row['registers']} registers, {row['warps_at_once']} warps at once" if "registers" in row else "torch"
        limit = f"{row['floor_us']:6.1f} us, {row['limit']}"
        print(f"  {row['kernel']:17}{row['megabytes']:7.1f} MB {row['launches']:3} launches {limit:30} {code}")
    print(
        f"  estimate, never run: floor {whole['floor_us']} us, with launches {whole['least_us']} us; "
        f"forecast {whole['forecast_us']} us; blend: {whole['registers']} registers, "
        f"{whole['spilled_bytes']} bytes spilled, {whole['warps_at_once']} warps at once",
        flush=True,
    )


def _write(path: Path, rows: list[Row]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_rows(path, dict.fromkeys(name for row in rows for name in row), rows)


if __name__ == "__main__":
    main()
