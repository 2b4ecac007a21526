"""What it costs to be watched: copies of the model while it trains, and how soon the first one is on the screen.

    python benchmarks/bm_snapshot.py [--iterations 150]

Trains `fast` on a synthetic clip of 640x512 three times, so many iterations each: alone, with a viewer who asks for one
JPEG after the other as fast as they come, and alone again. Prints seconds of training, what a copy took the loop, what
a view took the viewer, and when the first view was there, counted from the start of the loop. Kernels are compiled
before.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from contract.rendering import ImageFormat, RenderRequest
from contract.store import Store
from worker.checkpoint import Scene
from worker.clip import DepthClip, split_frames
from worker.hooks import Hooks
from worker.phantom import PhantomSettings, make_phantom
from worker.pipeline import ReconstructionRequest, prepare, snapshot_of
from worker.presets import PRESETS
from worker.raster.cpu import compile_kernels
from worker.serve import NotYetError
from worker.snapshot import Snapshots
from worker.train import Stopwatch, train
from worker.views import Views

CLIP = PhantomSettings(width=640, height=512, frames=24)
JOB = "0" * 32


@dataclass
class Figures:
    """Of one run."""

    train_s: float = 0.0
    gaussians: int = 0
    copy_ms: list[float] = field(default_factory=list)
    view_ms: list[float] = field(default_factory=list)
    first_view_s: float | None = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=150, help="of each run")
    arguments = parser.parse_args()
    clip = make_phantom(CLIP).depth_clip()
    compile_kernels()
    for watched in (False, True, False):
        figures = trained(clip, arguments.iterations, watched)
        line = f"{'watched' if watched else 'alone  '}  {figures.gaussians} Gaussians  training {figures.train_s:.2f} s"
        line += f"  {len(figures.copy_ms)} copies of {median(figures.copy_ms):.1f} ms"
        if figures.first_view_s is not None:
            line += f"  {len(figures.view_ms)} views of {median(figures.view_ms):.0f} ms"
            line += f"  the first after {figures.first_view_s:.2f} s"
        print(line, flush=True)


def trained(clip: DepthClip, iterations: int, watched: bool) -> Figures:
    """One training run."""
    split = split_frames(clip)
    request = ReconstructionRequest(clip=Path("unused"), iterations=iterations)
    run, scale = prepare(clip, split, PRESETS["fast"], request, Stopwatch())
    snapshots, figures, end = Snapshots(), Figures(gaussians=run.model.count), threading.Event()
    snapshots.begin(JOB)

    def copy() -> Scene:
        start = time.perf_counter()
        scene = snapshot_of(run, clip, split, scale, 0)
        figures.copy_ms.append((time.perf_counter() - start) * 1e3)
        return scene

    start = time.perf_counter()
    viewer = threading.Thread(target=watch, args=(snapshots, figures, start, end))
    if watched:
        viewer.start()
    hooks = Hooks(wants_snapshot=snapshots.wanted, on_snapshot=snapshots.offer)
    train(run, Stopwatch(), lambda: float("nan"), hooks, copy)
    figures.train_s = time.perf_counter() - start
    end.set()
    if watched:
        viewer.join()
    return figures


def watch(snapshots: Snapshots, figures: Figures, began: float, end: threading.Event) -> None:
    """Ask for one view after the other."""
    with tempfile.TemporaryDirectory() as folder:
        views = Views(Store(Path(folder)), snapshots)
        while not end.is_set():
            start = time.perf_counter()
            try:
                views.answer(RenderRequest(scene_id=JOB, t=(start - began) % 1, format=ImageFormat.JPEG))
            except NotYetError:
                end.wait(0.01)
                continue
            figures.view_ms.append((time.perf_counter() - start) * 1e3)
            if figures.first_view_s is None:
                figures.first_view_s = time.perf_counter() - began


if __name__ == "__main__":
    main()
