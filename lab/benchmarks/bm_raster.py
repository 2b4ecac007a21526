"""What splatting on this CPU costs, and of what: renders and whole training steps, with the parts of each.

    python -m lab.benchmarks.bm_raster [--scene FOLDER] [--repeats 31] [--csv lab/rows/raster.csv] [--quick]

The standard scene is 640x512 with a Gaussian every 2.86 pixels each way (40,096), 0.6 of the grid's step wide, opacity
0.88, on a curved surface at depth 60: every pixel is covered, as after fusion. A step is deformation, projection,
binning, sorting, blend with loss and gradients, their way back to the parameters, and Adam; a two-eyed step takes two
pictures of one moment, with gloss. With shared bases (17, colour moving) and with the paper's FDM (17 bases per
Gaussian and channel). Then the same against the number of pixels, Gaussians held, and against the number of Gaussians,
pixels held. Figures are medians in ms, the least beside them for busy machines (--cpu-time for very busy ones); parts
are timed inside whole runs. --scene measures a stored scene instead.

The machine's peak is that of two small kernels on the same vectors. The floor of a work is the multiply-adds it cannot
do without at that peak, plus the bytes it cannot but move at theirs, as if no lane of a vector ever idled and nothing
were moved twice; beside it stands what share of the least time it is.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from intrasplat.scene.checkpoint import load_scene
from intrasplat.splat.camera import Camera
from intrasplat.splat.constants import LOG2E, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from intrasplat.splat.cpu import Rasterizer, compile_kernels
from intrasplat.splat.cpu.model import CpuModel
from intrasplat.splat.cpu.motion import NEGLIGIBLE, FdmMotion, LinearMotion
from intrasplat.splat.cpu.simd import fma, lane_sum, load, splat
from intrasplat.splat.cpu.threads import run, thread_count
from intrasplat.splat.cpu.vectors import LANES
from intrasplat.splat.deformation import Deformation, GaussianFdm, SharedBasis
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.optimize import StepRates
from intrasplat.splat.step import Target, TrainingFrame, camera_vector
from lab.evaluate.rows import commit, write_rows

WIDTH, HEIGHT, GRID_STEP_PX = 640, 512, 2.86
SPREAD, OPACITY, DEPTH = 0.6, 0.88, 60.0
BASES = 17
EYES_APART, EYES_TURNED_DEG = 3.0, 0.04
"""Distance in units (4 mm at a depth of 80 mm), and a typical rotation of the right eye after registration."""
TIME = 0.4
RATES = StepRates(*[1e-7] * 13)  # so small that the scene does not change
TARGET_MS = {"render": 1000 / 60, "step": 25.0, "two-eyed step": 45.0}
PAIR_FMA = {"render": 8, "step": 8 + 15}
"""Multiply-adds (or single products and sums) per pixel and blended Gaussian: alpha and its ratio, w, T and four
channels; in the backward pass the score, B, four channels, dL/dpower and three moments."""
GAUSSIAN_FMA = {"render": 300, "step": 1000}
"""Multiply-adds of a Gaussian's projection, and of its backward pass."""
MOVES = {"render": 1, "step": 1 + 6}
"""Memory accesses per parameter: read once to deform; Adam reads and writes it and both moments."""
PIXEL_BYTES = {"render": 5 * 4, "step": 3 + 1 + 4}
"""Bytes per pixel: the image is written; the target is read."""
PARTS = ("project", "sort", "blend", "project_backward")


Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, help="folder of a stored scene, measured instead of the standard one")
    parser.add_argument("--repeats", type=int, default=31, help="timed runs a figure")
    parser.add_argument("--csv", type=Path, help="file that gets a row a figure")
    parser.add_argument("--quick", action="store_true", help="leave out the costs against pixels and Gaussians")
    parser.add_argument("--cpu-time", action="store_true", help="time on the processor, not on the clock: one thread")
    arguments = parser.parse_args()
    if arguments.cpu_time:
        if thread_count() != 1:
            parser.error(f"--cpu-time is that of one thread; there are {thread_count()}: set INTRASPLAT_THREADS=1")
        time.perf_counter = time.thread_time
    load_1min = os.getloadavg()[0]
    machine = {"cpu": _cpu_model(), "threads": thread_count(), "commit": commit(), "load_1min": round(load_1min, 2)}
    print(", ".join(f"{name} {value}" for name, value in machine.items()))
    print(f"kernels compiled or loaded in {compile_kernels():.1f} s")
    peaks = _peak_rows()
    rows = [*peaks]
    if arguments.scene:
        rows += _stored(arguments.scene, arguments.repeats, peaks[-1])
    else:
        rows += _standard(arguments.repeats, peaks[-1])
        if not arguments.quick:
            rows += _against_sizes(arguments.repeats, peaks[-1])
    if arguments.csv:
        _write(arguments.csv, [{**machine, **row} for row in rows])


def _standard(repeats: int, peak: Row) -> list[Row]:
    gaussians, camera = grid_scene(WIDTH, HEIGHT, GRID_STEP_PX)
    count = len(gaussians)
    rows = []
    for label, deformation in (
        ("shared, 17 bases, 13 channels", SharedBasis.initial(count, bases=BASES, colour=True)),
        ("fdm, 17 bases", GaussianFdm.initial(count, bases=BASES)),
    ):
        rows += measure(f"standard: {label}", gaussians, deformation, camera, repeats, peak)
    return rows


def _stored(folder: Path, repeats: int, peak: Row) -> list[Row]:
    scene = load_scene(folder)
    camera_from_world = np.linalg.inv(scene.world_from_camera[0])
    camera_from_world[:3, 3] *= scene.units_per_mm
    k = scene.intrinsics
    camera = Camera(k.fx, k.fy, k.cx, k.cy, k.width, k.height, camera_from_world)
    return measure(
        f"{folder.name}: {scene.deformation.kind}", scene.gaussians, scene.deformation, camera, repeats, peak
    )


def _against_sizes(repeats: int, peak: Row) -> list[Row]:
    """Measure four image sizes with the same Gaussians, then four numbers of Gaussians on the same image."""
    rows = []
    for width, height in ((160, 128), (320, 256), (640, 512), (1280, 1024)):
        gaussians, camera = grid_scene(width, height, GRID_STEP_PX * width / WIDTH)
        shared = SharedBasis.initial(len(gaussians), bases=BASES, colour=True)
        rows += measure(f"pixels: {width}x{height}", gaussians, shared, camera, repeats, peak, parts=False)
    for step_px in (6.0, 4.0, 3.0, 2.0):
        gaussians, camera = grid_scene(WIDTH, HEIGHT, step_px)
        shared = SharedBasis.initial(len(gaussians), bases=BASES, colour=True)
        rows += measure(f"Gaussians: {len(gaussians)}", gaussians, shared, camera, repeats, peak, parts=False)
    return rows


def grid_scene(width: int, height: int, step_px: float) -> tuple[Gaussians, Camera]:
    """A Gaussian every step_px pixels on a curved surface that fills the image."""
    focal = 1.1 * width
    i, j = np.mgrid[step_px / 2 : height : step_px, step_px / 2 : width : step_px]
    depth = DEPTH + 4 * np.sin(9 * j / width) * np.cos(9 * i / width)
    mean = np.stack([(j - width / 2) / focal * depth, (i - height / 2) / focal * depth, depth], axis=-1)
    count = depth.size
    random = torch.Generator().manual_seed(0)
    scale = torch.from_numpy(np.log(SPREAD * step_px * depth.ravel() / focal)).float()
    gaussians = Gaussians(
        mean=torch.from_numpy(mean.reshape(count, 3)).float(),
        quaternion=torch.randn(count, 4, generator=random),
        log_scale=scale[:, None].repeat(1, 3),
        opacity_logit=torch.full((count,), math.log(OPACITY / (1 - OPACITY))),
        sh=0.5 * torch.randn(count, 1, 3, generator=random),
    )
    return gaussians, Camera(focal, focal, width / 2, height / 2, width, height, np.eye(4))


def measure(
    name: str,
    gaussians: Gaussians,
    deformation: Deformation,
    camera: Camera,
    repeats: int,
    peak: Row,
    *,
    parts: bool = True,
) -> list[Row]:
    """Median ms of a render and of a step, printed with their parts, as rows."""
    model = CpuModel(gaussians, deformation, camera.width, camera.height)
    view, pixels = camera_vector(camera), camera.width * camera.height
    target = _target(model.rasterizer)
    frame = TrainingFrame(view, TIME, lambda: target, pixels, pixels)
    left = dataclasses.replace(camera, side=-0.5)
    right = dataclasses.replace(camera, camera_from_world=_right_eye(camera), side=0.5)
    both = [TrainingFrame(camera_vector(eye), TIME, lambda: target, pixels, pixels) for eye in (left, right)]
    works: dict[str, Callable[[], object]] = {
        "render": lambda: model.render(view, TIME),
        "step": lambda: model.step([frame], LossSettings(), RATES, 1, model.sh_degree),
        "two-eyed step": lambda: model.step(both, LossSettings(), RATES, 1, model.sh_degree),
    }
    blended = blended_per_pixel(model, view)
    rows = []
    print(f"{name}: {len(gaussians)} Gaussians, {camera.width}x{camera.height}, {blended:.1f} blended per pixel")
    for work, call in works.items():
        call()
        total_ms, least_ms, part_ms = _timed(model, call, repeats)
        aim = f" (target {TARGET_MS[work]:.0f})" if name.startswith("standard: shared") else ""
        shares = f": {_listed(part_ms, total_ms)}" if parts else ""
        floor_ms = _floor_ms(work, model, blended, peak)
        pace = f", {1e3 / total_ms:.0f} frames/s" if work == "render" else ""
        floor = f"floor {floor_ms:.1f}, {floor_ms / least_ms:.0%} reached"
        print(f"  {work:13} {total_ms:7.2f} ms{aim}{pace}, least {least_ms:.2f}, {floor}{shares}")
        row = {"name": name, "work": work, "gaussians": len(gaussians), "blended": round(blended, 1)}
        row |= {"width": camera.width, "height": camera.height, "ms": round(total_ms, 2)}
        row |= {"least_ms": round(least_ms, 2), "floor_ms": round(floor_ms, 2)}
        rows.append(row | {f"{part}_ms": round(value, 2) for part, value in part_ms.items()})
    return rows


def _right_eye(camera: Camera) -> NDArray[np.float64]:
    """camera_from_world of an eye EYES_APART to the right, rotated by EYES_TURNED_DEG."""
    moved, turn = np.array(camera.camera_from_world), np.eye(4)
    moved[0, 3] -= EYES_APART
    turn[:3, :3] = Rotation.from_euler("y", EYES_TURNED_DEG, degrees=True).as_matrix()
    return np.asarray(turn @ moved)


def _floor_ms(work: str, model: CpuModel, blended: float, peak: Row) -> float:
    """The floor of a work in ms: its multiply-adds and bytes, each divided by the machine's peak, summed."""
    pixels = model.rasterizer.width * model.rasterizer.height
    moved = model.canonical.nbytes + model.opacity_logit.nbytes
    if isinstance(model.motion, LinearMotion):
        alive = np.abs(model.motion.export(0).basis(TIME).numpy()) >= NEGLIGIBLE
        moved += model.motion.weight[alive].nbytes
    elif isinstance(model.motion, FdmMotion):
        moved += 3 * model.motion.weight.nbytes
    kind, pictures = ("step", 2) if work == "two-eyed step" else (work, 1)
    multiply_adds = pictures * (PAIR_FMA[kind] * blended * pixels + GAUSSIAN_FMA[kind] * model.count)
    moved_bytes = MOVES[kind] * moved + pictures * PIXEL_BYTES[kind] * pixels
    return 1e3 * float(multiply_adds / (1e9 * peak["gfma_per_s"]) + moved_bytes / (1e9 * peak["gb_per_s"]))


def _timed(model: CpuModel, call: Callable[[], object], repeats: int) -> tuple[float, float, dict[str, float]]:
    """Median and minimum ms of call, and median ms of its parts, by wrapping the model's methods."""
    spent: dict[str, float] = {}

    def wrapped(part: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **named: Any) -> Any:
            start = time.perf_counter()
            result = method(*arguments, **named)
            spent[part] = spent.get(part, 0.0) + time.perf_counter() - start
            return result

        return timed

    watched: list[tuple[Any, str, str]] = [(model.rasterizer, part, part) for part in PARTS]
    watched += [(model.motion, "deform", "deform"), (model.motion, "update", "motion_adam")]
    watched += [(model, "update_canonical", "canonical_adam")]
    for owner, name, part in watched:
        setattr(owner, name, wrapped(part, getattr(owner, name)))
    totals, parts = [], []
    for _ in range(repeats):
        spent.clear()
        start = time.perf_counter()
        call()
        totals.append(time.perf_counter() - start)
        parts.append(dict(spent))
    for owner, name, _ in watched:
        delattr(owner, name)
    part_ms = {part: 1e3 * median(each[part] for each in parts) for part in parts[0]}
    return 1e3 * median(totals), 1e3 * min(totals), part_ms


def _listed(part_ms: dict[str, float], total_ms: float) -> str:
    rest = total_ms - sum(part_ms.values())
    return ", ".join(f"{part} {value:.2f}" for part, value in part_ms.items()) + f", rest {rest:.2f}"


def _target(rasterizer: Rasterizer) -> Target:
    """A target of noise, so that every pixel has a gradient."""
    pixels = rasterizer.height * rasterizer.stride
    random = np.random.default_rng(0)
    rgb = random.integers(0, 256, 3 * pixels, dtype=np.uint8)
    return Target(rgb, np.full(pixels, 255, np.uint8), np.full(pixels, 1 / DEPTH, np.float32))


def blended_per_pixel(model: CpuModel, view: NDArray[np.float64]) -> float:
    """Mean number of Gaussians that a pixel blends before it is opaque, by the contract's rules."""
    model.project(view, TIME, model.sh_degree)
    raster = model.rasterizer
    transmittance = np.ones((raster.height, raster.width))
    taken = 0
    drawn = np.flatnonzero(raster.radius2 >= 0)
    for g in drawn[np.argsort(raster.splats[drawn, 9], kind="stable")]:
        x, y, k_xx, k_xy, k_yy, log2_opacity = raster.splats[g, :6].astype(float)
        a, b, c = -2 / LOG2E * k_xx, -k_xy / LOG2E, -2 / LOG2E * k_yy
        reach = np.sqrt(raster.radius2[g] * np.array([c, a]) / (a * c - b * b)) + 1
        left, top = (max(0, int(low)) for low in (x - reach[0], y - reach[1]))
        window = transmittance[top : int(y + reach[1]) + 1, left : int(x + reach[0]) + 1]
        dx = left + 0.5 - x + np.arange(window.shape[1])
        dy = top + 0.5 - y + np.arange(window.shape[0])[:, None]
        alpha = np.exp2(log2_opacity + k_xx * dx * dx + k_xy * dx * dy + k_yy * dy * dy)
        used = (alpha >= MIN_ALPHA) & (window >= MIN_TRANSMITTANCE)
        taken += int(used.sum())
        window *= np.where(used, 1 - np.minimum(alpha, MAX_ALPHA), 1)
    return taken / transmittance.size


@njit(nogil=True)
def _multiply_add(thread, threads, rounds, out):  # type: ignore[no-untyped-def]
    """Ten chains of multiply-adds, enough to hide an instruction's latency on two units."""
    a = b = c = d = e = f = g = h = k = m = splat(np.float32(thread + 1))
    x, y = splat(np.float32(0.999)), splat(np.float32(0.001))
    for _ in range(rounds):
        a, b, c, d, e = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y), fma(e, x, y)
        f, g, h, k, m = fma(f, x, y), fma(g, x, y), fma(h, x, y), fma(k, x, y), fma(m, x, y)
    out[thread] = lane_sum(a + b + c + d + e + f + g + h + k + m)


@njit(nogil=True)
def _read(thread, threads, values, out):  # type: ignore[no-untyped-def]
    """Sum of the thread's share of values; every vector is read once."""
    vectors = values.shape[0] // LANES // 4
    a = b = c = d = splat(np.float32(0))
    for block in range(vectors * thread // threads, vectors * (thread + 1) // threads):
        i = 4 * LANES * block
        a, b = a + load(values, i), b + load(values, i + LANES)
        c, d = c + load(values, i + 2 * LANES), d + load(values, i + 3 * LANES)
    out[thread] = lane_sum(a + b + c + d)


def _peak_rows() -> list[Row]:
    """Measure and print multiply-adds and bytes per second, of one thread and of all."""
    out = np.zeros(thread_count(), np.float32)
    values = np.ones(1 << 26, np.float32)  # 256 MiB: far beyond the caches
    rounds = 2_000_000
    rows = []
    for label, threads, call in (
        ("one thread", 1, lambda kernel, *given: kernel(0, 1, *given)),
        (f"{thread_count()} threads", thread_count(), run),
    ):
        times = [_fastest(call, _multiply_add, rounds, out), _fastest(call, _read, values, out)]
        fma_per_s, bytes_per_s = threads * rounds * 10 * LANES / times[0], values.nbytes / times[1]
        print(f"peak, {label}: {fma_per_s / 1e9:.1f} G multiply-adds/s, {bytes_per_s / 1e9:.1f} GB/s read")
        peak = {"gfma_per_s": round(fma_per_s / 1e9, 1), "gb_per_s": round(bytes_per_s / 1e9, 1)}
        rows.append({"name": "peak", "work": label, **peak})
    return rows


def _fastest(call: Callable[..., object], *arguments: Any) -> float:
    """Minimum seconds of a few calls, after one that compiles."""
    seconds = []
    for _ in range(6):
        start = time.perf_counter()
        call(*arguments)
        seconds.append(time.perf_counter() - start)
    return min(seconds[1:])


def _write(path: Path, rows: list[Row]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_rows(path, dict.fromkeys(name for row in rows for name in row), rows)


def _cpu_model() -> str:
    information = Path("/proc/cpuinfo")
    names = [line for line in information.read_text().splitlines() if line.startswith("model name")]
    return names[0].split(":")[1].strip() if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
