"""The cost of viewers during training: snapshots of the model, and how soon the first view is there.

    python -m lab.benchmarks.bm_snapshot [--iterations 150]

Trains `fast` on a synthetic clip of 640x512 for --iterations iterations: alone, with a viewer who requests one JPEG
after the other without a pause, and with one who is limited to the share that a worker gives to renders; the three in
order, --rounds times. Prints for each the median seconds of training and of CPU time, the time of a snapshot in the
loop, the time to render a view, views per second, and the time of the first view since the start of the loop. Kernels
are compiled before.
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
from contract.wire.rendering import RenderRequest
from intrasplat.clip import DepthClip, split_frames
from intrasplat.machine.timing import Stopwatch
from intrasplat.methods.registry import PRESETS
from intrasplat.options import ReconstructionOptions
from intrasplat.outcome import snapshot_of
from intrasplat.picture import ImageFormat
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.cpu import compile_kernels
from intrasplat.splat.cpu.threads import cpu_time_s, thread_count
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.prepare import prepare
from intrasplat.train.scoring import HeldOutScore
from intrasplat.train.setup import Setup
from lab.phantom import PhantomSettings, make_phantom
from worker.pace import RenderPace
from worker.reply import NotYetError
from worker.snapshot import Snapshots
from worker.views import Views

CLIP = PhantomSettings(width=640, height=512, frames=24)
JOB = "0" * 32


@dataclass
class Figures:
    """The figures of one run."""

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
    trained(clip, 10, None)  # an untimed run that fills caches
    paces: dict[str, Callable[[], RenderPace] | None] = {
        "alone": None,
        "unpaced": _Unpaced,
        "paced": lambda: RenderPace(thread_count(), used_s=time.process_time),
    }
    runs: dict[str, list[Figures]] = {name: [] for name in paces}
    for _ in range(arguments.rounds):
        for name, pace in paces.items():
            runs[name].append(trained(clip, arguments.iterations, pace and pace()))
    for name, figures in runs.items():
        print(line_of(name, figures), flush=True)


class _Unpaced(RenderPace):
    """Lets every view start at once."""

    def rest_s(self) -> float:
        return 0.0


def line_of(name: str, runs: list[Figures]) -> str:
    """The printed line of one kind of viewer."""
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


def trained(clip: DepthClip, iterations: int, pace: RenderPace | None) -> Figures:
    """One training run, with a viewer if there is a pace for one."""
    split = split_frames(clip)
    options = ReconstructionOptions(iterations=iterations)
    run = prepare(Setup(clip, split, PRESETS["fast"], options))
    snapshots, figures, end = Snapshots(), Figures(gaussians=run.model.count), threading.Event()
    snapshots.begin(JOB)

    def copy() -> TrainedScene:
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


def watch(snapshots: Snapshots, pace: RenderPace, figures: Figures, began: float, end: threading.Event) -> None:
    """Render one view after the other, with a worker's pauses in between."""
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
