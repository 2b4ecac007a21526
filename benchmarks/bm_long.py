"""A long clip beside its first frames alone: peak memory of each stage, a step's time, held-out score.

    python -m benchmarks.bm_long --cache FOLDER [--motions breathing pull] [--frames 1000] [--part 100]
        [--width 640] [--height 512] [--seed 0] [--preset fast] [--steps-a-frame 6] [--csv docs/results/long.csv]

Draws a synthetic clip of each motion in StereoMIS layout, raw frames of two eyes, into FOLDER, where the next run finds
it. A pull takes PULL_FRAMES, a breath as many frames as the phantom's usually does. Both clips are reconstructed as the
command line does, each in a process of its own, with as many steps a frame, and scored. Linux only.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path

from benchmarks.bm_memory import StageMemory
from contract.wire.notices import NoticeCode
from contract.wire.options import ReconstructionOptions
from worker.evaluate.rows import adding_alone, commit, machine, read_rows, write_rows
from worker.machine.cores import cores
from worker.phantom import PhantomSettings, make_phantom
from worker.phantom.writers import write_stereomis_frames
from worker.pipeline import reconstruct
from worker.train.hooks import TrainingHooks
from worker.train.request import ReconstructionRequest

PULL_FRAMES = 250.0
"""Of a slow pull: 10 s."""
KEY = ("clip", "preset", "iterations")
STAGES = ("decode", "stereo", "motion", "fusion", "start", "train", "finish", "score")
SECONDS = ("finish_s", "shrink_s", "score_s")
FIELDS = (
    *KEY, "gaussians", "bases", "step_ms", "psnr_tissue_db", "psnr_right_db",
    *(f"{stage}_mib" for stage in STAGES), *SECONDS, "scene_mb", "load", "machine", "commit",
)  # fmt: skip
"""STAGE_mib: the peak of the process's resident memory in that stage. load: of the machine, when training ended."""


def main(arguments: Sequence[str] | None = None) -> None:
    options = _parser().parse_args(arguments)
    for motion in options.motions:
        long = PhantomSettings(
            width=options.width, height=options.height, frames=options.frames, motion=motion, seed=options.seed,
            period_frames=PULL_FRAMES if motion == "pull" else PhantomSettings().period_frames,
        )  # fmt: skip
        clip = _drawn(long, options.cache)
        for path in (_part(clip, options.part), clip):
            row = _alone(path, options)
            print(json.dumps(row), flush=True)
            if options.csv:
                with adding_alone(options.csv.parent):
                    kept = [
                        each for each in read_rows(options.csv) if any(each[name] != str(row[name]) for name in KEY)
                    ]
                    write_rows(options.csv, FIELDS, [*kept, row])


def _alone(path: Path, options: argparse.Namespace) -> dict[str, object]:
    """The row of one reconstruction, made in a new process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(measured, path, options.preset, options.steps_a_frame).result()


def measured(path: Path, preset: str, steps_a_frame: int) -> dict[str, object]:
    """Reconstruct and score a clip; what was measured, as a row."""
    iterations = steps_a_frame * len(list(path.glob("*l.png")))
    memory = StageMemory()
    with tempfile.TemporaryDirectory(prefix="intrasplat-long-") as folder:
        request = ReconstructionRequest(path, ReconstructionOptions(preset=preset, iterations=iterations), device="cpu")
        report = reconstruct(request, Path(folder) / "scene", TrainingHooks(on_progress=memory.on_progress))
        memory.end_stage()
    print(*(each.text for each in report.assumptions if each.code == NoticeCode.BASES), sep="\n")
    return {
        "clip": path.name, "preset": preset, "iterations": iterations,
        "gaussians": report.gaussians, "bases": report.bases,
        "step_ms": f"{1000 * report.seconds['optimise_s'] / iterations:.1f}",
        "psnr_tissue_db": _decibels(report.psnr_tissue_db), "psnr_right_db": _decibels(report.psnr_right_db),
        **{f"{stage}_mib": f"{memory.peaks_mib[stage]:.0f}" for stage in STAGES},
        **{name: f"{report.seconds[name]:.1f}" for name in SECONDS},
        "scene_mb": f"{report.scene_bytes / 1e6:.1f}", "load": f"{os.getloadavg()[1]:.1f}",
        "machine": machine(), "commit": commit(),
    }  # fmt: skip


def _decibels(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _drawn(settings: PhantomSettings, cache: Path) -> Path:
    """The folder of the clip; every core draws some of its frames if it is not there."""
    name = f"phantom-{settings.motion}-{settings.width}x{settings.height}-{settings.frames}frames-stereo"
    folder = cache / (name + f"-seed{settings.seed}" * bool(settings.seed))
    if not folder.exists():
        unfinished = folder.with_suffix(".part")
        parts = [range(place, settings.frames, cores()) for place in range(cores())]
        with ProcessPoolExecutor(cores(), mp_context=multiprocessing.get_context("spawn")) as pool:
            list(pool.map(_draw, repeat(settings), repeat(unfinished), parts))
        unfinished.rename(folder)
    return folder


def _draw(settings: PhantomSettings, folder: Path, frames: range) -> None:
    write_stereomis_frames(make_phantom(settings), folder, frames)


def _part(clip: Path, frames: int) -> Path:
    """The folder of the clip's first frames, links to the clip's files."""
    folder = clip.with_name(f"{clip.name}-first{frames}")
    for file in [*clip.glob("*.*"), *clip.glob("masks/*")]:
        if file.name[:6].isdigit() and int(file.name[:6]) >= frames:
            continue
        link = folder / file.relative_to(clip)
        link.parent.mkdir(parents=True, exist_ok=True)
        if not link.exists():
            os.link(file, link)
    return folder


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--motions", nargs="+", choices=("breathing", "pull"), default=("breathing", "pull"))
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--part", type=int, default=100)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=512)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--steps-a-frame", type=int, default=6)
    parser.add_argument("--csv", type=Path)
    return parser


if __name__ == "__main__":
    main()
