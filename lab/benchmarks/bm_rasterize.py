"""Times rasterize() against its own reference and against gsplat's plain-torch path, on the same Gaussians.

    python -m lab.benchmarks.bm_rasterize [--gsplat FOLDER] [--repeats 9] [--csv lab/rows/rasterize.csv]

All run on the processor, in float32, in turn within each round: forward, and forward with all gradients of a random
projection of colour, depth and alpha. Figures are medians of the rounds in ms, with the least beside them.

gsplat is no requirement of this project. To make a folder for --gsplat:

    pip install --target FOLDER rich && pip install --target FOLDER --no-deps gsplat==1.5.3

gsplat imports without CUDA, but its plain-torch path (gsplat.cuda._torch_impl) calls three functions that need CUDA:
its own rasterize_to_indices_in_range, and two of nerfacc. Torch stand-ins of this file take their place. The column
"stand-ins" says how much of the forward time they take; the rest is gsplat's own code.

On a busy machine, --cpu-time measures the CPU time of one thread instead of the clock; it needs INTRASPLAT_THREADS=1.

Symbols: N Gaussians, C cameras, H W pixels, M pairs of a Gaussian and a pixel.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from intrasplat.splat.constants import MIN_ALPHA, MIN_TRANSMITTANCE
from intrasplat.splat.cpu import compile_kernels
from intrasplat.splat.cpu.threads import thread_count
from intrasplat.splat.rasterize import BackendName, rasterize
from lab.evaluate.rows import commit, machine, texts_of, write_rows

SIZES = ((1000, 160, 128), (4000, 320, 256), (16000, 640, 512))
"""N, W, H."""
WIDE_PX = 0.9
"""Standard deviation of an average Gaussian as a share of the mean distance between Gaussians on the image."""
TILE = 16
MAX_SECONDS = 30.0
"""No further round of a size starts after this long, once there are three."""
FIELDS = (
    "renderer", "gaussians", "width", "height", "forward_ms", "least_forward_ms", "stand_ins_ms", "both_ms",
    "least_both_ms", "clock", "threads", "load_1min", "machine", "commit",
)  # fmt: skip

Scene = dict[str, Any]
Render = Callable[[Scene], Tensor]
"""Colour, depth and alpha of a scene, [C, H, W, 5]."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gsplat", type=Path, help="folder that holds the package gsplat, if it is not installed")
    parser.add_argument("--repeats", type=int, default=9, help="rounds a size")
    parser.add_argument("--sizes", type=int, default=len(SIZES), help="how many of the sizes, the smallest first")
    parser.add_argument("--cpu-time", action="store_true", help="time on the processor, not on the clock: one thread")
    parser.add_argument("--csv", type=Path, help="file that gets a row a figure")
    arguments = parser.parse_args()
    if arguments.cpu_time:
        if thread_count() != 1:
            parser.error(f"--cpu-time is that of one thread; there are {thread_count()}: set INTRASPLAT_THREADS=1")
        torch.set_num_threads(1)
        time.perf_counter = time.thread_time
    compile_kernels()
    renderers: dict[str, Render] = {"rasterize, cpu": by("cpu"), "rasterize, reference": by("reference")}
    gsplat = find_gsplat(arguments.gsplat)
    if gsplat is not None:
        renderers[f"gsplat {gsplat.__version__}, torch"] = GsplatTorch()
    clock = "processor" if arguments.cpu_time else "wall"
    origin = {"clock": clock, "threads": thread_count(), "machine": machine(), "commit": commit()}
    print(", ".join(f"{name} {value}" for name, value in origin.items()))
    rows = []
    for size in SIZES[: arguments.sizes]:
        rows += measure(random_scene(*size), renderers, arguments.repeats, origin)
    if arguments.csv:
        write_rows(arguments.csv, FIELDS, [texts_of(row, FIELDS) for row in rows])


def random_scene(count: int, width: int, height: int) -> Scene:
    """The arguments of rasterize: Gaussians all over the image at depths from 2 to 4, one camera."""
    random = torch.Generator().manual_seed(0)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=random)

    focal = 1.1 * width
    depth = uniform(2, 4, count, 1)
    middle = torch.tensor([width, height]) / 2
    means = torch.cat([(uniform(0, 1, count, 2) * 2 * middle - middle) / focal * depth, depth], dim=1)
    wide_px = WIDE_PX * (width * height / count) ** 0.5
    return {
        "means": means,
        "quats": uniform(-1, 1, count, 4),
        "scales": wide_px / focal * depth * uniform(0.5, 1.5, count, 3),
        "opacities": uniform(0.1, 0.95, count),
        "colors": uniform(0, 1, count, 3),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]]),
        "width": width,
        "height": height,
    }


def by(backend: BackendName) -> Render:
    """A Render that calls rasterize() with this backend."""

    def render(scene: Scene) -> Tensor:
        seen = rasterize(**scene, backend=backend)
        return torch.cat([seen.colors, seen.depth, seen.alpha], dim=-1)

    return render


def measure(scene: Scene, renderers: dict[str, Render], repeats: int, origin: dict[str, object]) -> list[Scene]:
    """Measure each renderer and print its row, with its differences in image and gradients from the reference."""
    size = {"gaussians": len(scene["means"]), "width": scene["width"], "height": scene["height"]}
    print(f"\n{size['gaussians']} Gaussians, {size['width']} x {size['height']}")
    cotangent = torch.randn(1, scene["height"], scene["width"], 5, generator=torch.Generator().manual_seed(1))
    wanted = image_and_gradients(by("reference"), scene, cotangent)
    differences = {
        name: compared(image_and_gradients(each, scene, cotangent), wanted) for name, each in renderers.items()
    }
    seconds: dict[str, list[tuple[float, float, float]]] = {name: [] for name in renderers}
    load_1min, start = os.getloadavg()[0], time.perf_counter()
    for round_index in range(repeats):
        if round_index >= 3 and time.perf_counter() - start > MAX_SECONDS:
            break
        for name, render in renderers.items():
            with torch.no_grad():
                forward_s = timed(partial(render, scene))
            stand_ins_s = render.stand_ins_s if isinstance(render, GsplatTorch) else 0.0
            both_s = timed(partial(image_and_gradients, render, scene, cotangent))
            seconds[name].append((forward_s, stand_ins_s, both_s))
    print(f"  {'renderer':22} {'forward (least)':>22} {'stand-ins':>10} {'with gradients (least)':>28}  differs by")
    rows = []
    for name, spent in seconds.items():
        forward, stand_ins, both = ([1e3 * each for each in column] for column in zip(*spent, strict=True))
        row = {"forward_ms": median(forward), "least_forward_ms": min(forward)}
        row |= {"stand_ins_ms": median(stand_ins), "both_ms": median(both), "least_both_ms": min(both)}
        print(
            f"  {name:22} {median(forward):12.1f} {f'({min(forward):.1f})':>9} {median(stand_ins):10.1f} "
            f"{median(both):18.1f} {f'({min(both):.1f})':>9}  {differences[name]}"
        )
        rows.append({"renderer": name, **size, **row, "load_1min": load_1min, **origin})
    return rows


def timed(call: Callable[[], object]) -> float:
    """The seconds of a call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def image_and_gradients(render: Render, scene: Scene, cotangent: Tensor) -> list[Tensor]:
    """The image, and the gradients of its product with cotangent."""
    live = scene | {name: scene[name].detach().clone().requires_grad_() for name in LEAVES}
    image = render(live)
    return [image.detach(), *torch.autograd.grad((image * cotangent).sum(), [live[name] for name in LEAVES])]


def compared(found: list[Tensor], wanted: list[Tensor]) -> str:
    """The largest difference of the image, and the largest relative norm of a gradient's difference."""
    image = float((found[0] - wanted[0]).abs().max())
    gradients = [float((a - b).norm() / b.norm()) for a, b in zip(found[1:], wanted[1:], strict=True)]
    return f"image {image:.1e}, gradients {max(gradients):.1e}"


def find_gsplat(folder: Path | None) -> ModuleType | None:
    """The gsplat package, or None after printing why it cannot be used."""
    if folder is not None:
        sys.path.append(str(folder))
    try:
        importlib.import_module("gsplat.cuda._torch_impl")
        return importlib.import_module("gsplat")
    except ImportError as error:
        print(f"gsplat is left out, for it does not import ({error}); see --help for how to install it.")
        return None


class GsplatTorch:
    """gsplat's plain-torch path, one function after the other as its rasterization() calls their CUDA forms."""

    def __init__(self) -> None:
        self.stand_ins_s = 0.0
        self._torch_impl = importlib.import_module("gsplat.cuda._torch_impl")
        wrapper: Any = importlib.import_module("gsplat.cuda._wrapper")
        wrapper.rasterize_to_indices_in_range = self._watched(pairs_in_range)
        nerfacc: Any = ModuleType("nerfacc")
        nerfacc.render_weight_from_alpha = self._watched(weights_from_alphas)
        nerfacc.accumulate_along_rays = self._watched(sums_by_pixel)
        sys.modules["nerfacc"] = nerfacc

    def _watched(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function so that its time is added to stand_ins_s."""

        def watched(*arguments: Any, **named: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments, **named)
            finally:
                self.stand_ins_s += time.perf_counter() - start

        return watched

    def __call__(self, scene: Scene) -> Tensor:
        self.stand_ins_s, torch_impl = 0.0, self._torch_impl
        width, height, poses = scene["width"], scene["height"], scene["viewmats"]
        cameras, columns, rows = len(poses), -(-width // TILE), -(-height // TILE)
        covars, _ = torch_impl._quat_scale_to_covar_preci(scene["quats"], scene["scales"], compute_preci=False)
        radii, means2d, depths, conics, _ = torch_impl._fully_fused_projection(
            scene["means"], covars, poses, scene["Ks"], width, height
        )
        _, keys, flat = torch_impl._isect_tiles(means2d, radii, depths, TILE, columns, rows)
        offsets = torch_impl._isect_offset_encode(keys, cameras, columns, rows)
        colors = torch.cat([scene["colors"].expand(cameras, -1, 3), depths[..., None]], dim=-1)
        opacities = scene["opacities"].expand(cameras, -1)
        image, alpha = torch_impl._rasterize_to_pixels(
            means2d, conics, colors, opacities, width, height, TILE, offsets, flat
        )
        return torch.cat([image, alpha], dim=-1)


@torch.no_grad()
def pairs_in_range(
    first: int,
    end: int,
    transmittances: Tensor,  # [C, H, W]
    means2d: Tensor,  # [C, N, 2]
    conics: Tensor,  # [C, N, 3]
    opacities: Tensor,  # [C, N]
    width: int,
    height: int,
    tile: int,
    offsets: Tensor,  # [C, rows, columns]
    flat: Tensor,  # [slots]
) -> tuple[Tensor, Tensor, Tensor]:
    """Stands for gsplat's rasterize_to_indices_in_range: Gaussian, pixel and camera of every pair, [M] each, the pairs
    of a pixel one after the other from front to back."""
    count, batch = means2d.shape[1], tile * tile
    mean, conic, opacity = means2d.reshape(-1, 2), conics.reshape(-1, 3), opacities.reshape(-1)
    starts = [*offsets.flatten().tolist(), len(flat)]
    splats, places = [], []
    for index in range(offsets.numel()):
        camera, place = divmod(index, offsets.shape[1] * offsets.shape[2])
        top, left = (tile * each for each in divmod(place, offsets.shape[2]))
        own = flat[starts[index] : starts[index + 1]][first * batch : end * batch].long()
        i, j = torch.meshgrid(
            torch.arange(top, min(top + tile, height)), torch.arange(left, min(left + tile, width)), indexing="ij"
        )
        pixel = (i * width + j).flatten()
        dx = j.flatten()[:, None] + 0.5 - mean[own, 0]
        dy = i.flatten()[:, None] + 0.5 - mean[own, 1]
        a, b, c = conic[own].unbind(1)
        alpha = opacity[own] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp(max=0.999), 0.0)
        after = transmittances[camera].flatten()[pixel, None] * torch.cumprod(1 - alpha, dim=1)
        of_pixel, of_splat = torch.nonzero((alpha > 0) & (after > MIN_TRANSMITTANCE), as_tuple=True)
        splats.append(own[of_splat])
        places.append(camera * width * height + pixel[of_pixel])
    order = torch.argsort(torch.cat(places), stable=True)
    splat, where = torch.cat(splats)[order], torch.cat(places)[order]
    return splat % count, where % (width * height), where // (width * height)


def weights_from_alphas(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Stands for nerfacc's render_weight_from_alpha: weight and transmittance of every pair, [M] each."""
    logs = torch.log1p(-alphas.double())
    before = torch.cumsum(logs, 0) - logs
    first = torch.searchsorted(ray_indices, ray_indices)
    transmittance = torch.exp(before - before[first]).to(alphas)
    return transmittance * alphas, transmittance


def sums_by_pixel(weights: Tensor, values: Tensor | None, *, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Stands for nerfacc's accumulate_along_rays: sum w v of every pixel, [pixels, D]."""
    products = weights[:, None] if values is None else weights[:, None] * values
    return products.new_zeros(n_rays, products.shape[1]).index_add(0, ray_indices, products)


if __name__ == "__main__":
    main()
