"""What it costs to be watched: copies of the model while it trains, and how soon the first one is on the screen.

    python benchmarks/bm_snapshot.py [--iterations 150]

Trains `fast` on a synthetic clip of 640x512, so many iterations each time: alone, with a viewer who asks for one JPEG
after the other as fast as they come, and with one who is held to the share that a worker gives to renders; the three in
turn, --rounds times. Prints of each the median seconds of training and the process's CPU time, what a copy took the
loop, what a view took to make, how many came a second, and when the first was there, counted from the start of the
loop. Kernels are compiled before.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from contract.store.store import Store
from contract.wire.options import ReconstructionOptions
from contract.wire.rendering import ImageFormat, RenderRequest
from worker.daemon.pace import Pace
from worker.daemon.serve import NotYetError
from worker.daemon.snapshot import Snapshots
from worker.daemon.views import Views
from worker.input.clip import DepthClip, split_frames
from worker.machine.timing import Stopwatch
from worker.methods.registry import PRESETS
from worker.outcome import snapshot_of
from worker.phantom import PhantomSettings, make_phantom
from worker.raster.cpu import compile_kernels
from worker.raster.cpu.threads import cpu_time_s, thread_count
from worker.scene.scene import Scene
from worker.train.hooks import TrainingHooks
from worker.train.loop import train
from worker.train.prepare import prepare
from worker.train.scoring import HeldOutScore
from worker.train.setup import Setup

CLIP = PhantomSettings(width=640, height=512, frames=24)
JOB = "0" * 32


@dataclass
class Figures:
    """Of one run."""

    train_s: float = 0.0
    cpu_s: float = 0.0
    gaussians: int = 0
    copy_ms: list[float] = field(default_factory=list)
    view_ms: list[float] = field(default_factory=list)
    first_view_s: float | None = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=150, help="of each run")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    clip = make_phantom(CLIP).depth_clip()
    compile_kernels()
    trained(clip, 10, None)  # the first run reads what the others find in caches
    paces: dict[str, Callable[[], Pace] | None] = {
        "alone": None,
        "unpaced": _Unpaced,
        "paced": lambda: Pace(thread_count(), used_s=time.process_time),
    }
    runs: dict[str, list[Figures]] = {name: [] for name in paces}
    for _ in range(arguments.rounds):
        for name, pace in paces.items():
            runs[name].append(trained(clip, arguments.iterations, pace and pace()))
    for name, figures in runs.items():
        print(line_of(name, figures), flush=True)


class _Unpaced(Pace):
    """Lets every view begin at once."""

    def rest_s(self) -> float:
        return 0.0


def line_of(name: str, runs: list[Figures]) -> str:
    """What is printed of one way to be watched."""
    train_s = median(each.train_s for each in runs)
    line = f"{name:8} {runs[0].gaussians} Gaussians  training {train_s:.2f} s"
    line += f" and {median(each.cpu_s for each in runs):.2f} s of CPU time"
    line += f"  {median(len(each.copy_ms) for each in runs):g} copies"
    line += f" of {median(ms for each in runs for ms in each.copy_ms):.1f} ms"
    if any(each.view_ms for each in runs):
        a_second = median(len(each.view_ms) / each.train_s for each in runs)
        first_s = median(each.first_view_s for each in runs if each.first_view_s is not None)
        line += f"  {a_second:.1f} views/s of {median(ms for each in runs for ms in each.view_ms):.0f} ms"
        line += f"  the first after {first_s:.2f} s"
    return line


def trained(clip: DepthClip, iterations: int, pace: Pace | None) -> Figures:
    """One training run, with a viewer if there is a pace for one."""
    split = split_frames(clip)
    options = ReconstructionOptions(iterations=iterations)
    run = prepare(Setup(clip, split, PRESETS["fast"], options))
    snapshots, figures, end = Snapshots(), Figures(gaussians=run.model.count), threading.Event()
    snapshots.begin(JOB)

    def copy() -> Scene:
        start = time.perf_counter()
        scene = snapshot_of(run, as_it_lies=True)
        figures.copy_ms.append((time.perf_counter() - start) * 1e3)
        return scene

    hooks = TrainingHooks(wants_snapshot=snapshots.wanted, on_snapshot=snapshots.offer)
    with ExitStack() as beside:
        start, start_cpu_s = time.perf_counter(), time.process_time()
        if pace is not None:
            beside.enter_context(pace.training())
            viewer = threading.Thread(target=watch, args=(snapshots, pace, figures, start, end))
            viewer.start()
            beside.callback(viewer.join)
            beside.callback(end.set)
        train(run, Stopwatch(), lambda: HeldOutScore(math.nan, math.nan), hooks, copy)
        figures.train_s, figures.cpu_s = time.perf_counter() - start, time.process_time() - start_cpu_s
    return figures


def watch(snapshots: Snapshots, pace: Pace, figures: Figures, began: float, end: threading.Event) -> None:
    """Ask for one view after the other, and rest in between as a worker does."""
    with tempfile.TemporaryDirectory() as folder:
        views = Views(Store(Path(folder)), snapshots)
        while not end.wait(pace.rest_s()):
            start, start_cpu_s = time.perf_counter(), cpu_time_s()
            try:
                views.answer(RenderRequest(scene_id=JOB, t=(start - began) % 1, format=ImageFormat.JPEG))
            except NotYetError:
                end.wait(0.01)
                continue
            pace.charge(cpu_time_s() - start_cpu_s)
            figures.view_ms.append((time.perf_counter() - start) * 1e3)
            if figures.first_view_s is None:
                figures.first_view_s = time.perf_counter() - began


if __name__ == "__main__":
    main()
