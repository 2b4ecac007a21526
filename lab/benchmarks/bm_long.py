"""A long clip beside parts of it alone: peak memory of each stage, a step's time, held-out score.

    python -m lab.benchmarks.bm_long --cache FOLDER [--motions breathing pull] [--frames 1000] [--parts 0 600] [--part
        100]
        [--width 640] [--height 512] [--seed 0] [--preset fast] [--steps-a-frame 6] [--csv lab/rows/long.csv]

Draws a synthetic clip of each motion in StereoMIS layout, raw frames of two eyes, into FOLDER, where the next run finds
it. A pull takes PULL_FRAMES, a breath as many frames as the phantom's usually does. The clip and its parts, --part
frames from each of --parts on, are reconstructed as the command line does, each in a process of its own, with as many
steps a frame, and scored. A part's row also has what the whole clip's scene scores on the held-out frames in it. Linux
only.
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
from typing import TypeAlias

from intrasplat.machine.cores import cores
from intrasplat.machine.hooks import Hooks
from intrasplat.names import PresetName
from intrasplat.notices import NoticeCode
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import Made, make, score_scene
from intrasplat.quality.score import score_model
from intrasplat.report import Report
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.view.renderer import SceneRenderer
from lab.benchmarks.bm_memory import StageMemory
from lab.evaluate.rows import adding_alone, commit, machine, read_rows, write_rows
from lab.phantom import PhantomSettings, make_phantom
from lab.phantom.writers import write_stereomis_frames

PULL_FRAMES = 250.0
"""Frames of a slow pull: 10 s."""
KEY = ("clip", "preset", "iterations")
WHOLE = ("whole_psnr_db", "whole_right_db")
"""Columns with the scores of the whole clip's scene on a part's frames."""
STAGES = ("decode", "stereo", "motion", "fusion", "start", "train", "finish", "score")
SECONDS = ("finish_s", "shrink_s", "score_s")
FIELDS = (
    *KEY, "gaussians", "bases", "step_ms", "psnr_tissue_db", "psnr_right_db", *WHOLE,
    *(f"{stage}_mib" for stage in STAGES), *SECONDS, "scene_mb", "load", "machine", "commit",
)  # fmt: skip
"""STAGE_mib: the peak of the process's resident memory in that stage. load: of the machine, when training ended."""

Row: TypeAlias = dict[str, object]
Score: TypeAlias = tuple[float | None, float | None]


def main(arguments: Sequence[str] | None = None) -> None:
    options = _parser().parse_args(arguments)
    for motion in options.motions:
        long = PhantomSettings(
            width=options.width, height=options.height, frames=options.frames, motion=motion, seed=options.seed,
            period_frames=PULL_FRAMES if motion == "pull" else PhantomSettings().period_frames,
        )  # fmt: skip
        clip = _drawn(long, options.cache)
        parts = [range(start, start + options.part) for start in options.parts]
        whole, scores = _alone(clip, options, parts)
        rows = [whole]
        for part, score in zip(parts, scores, strict=True):
            row, _ = _alone(_part(clip, part), options)
            rows.append(row | dict(zip(WHOLE, map(_decibels, score), strict=True)))
        for row in rows:
            print(json.dumps(row), flush=True)
        if options.csv:
            with adding_alone(options.csv.parent):
                new = [[str(row[name]) for name in KEY] for row in rows]
                kept = [each for each in read_rows(options.csv) if [each[name] for name in KEY] not in new]
                write_rows(options.csv, FIELDS, [*kept, *rows])


def _alone(path: Path, options: argparse.Namespace, parts: Sequence[range] = ()) -> tuple[Row, list[Score]]:
    """Run measured() in a new process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(measured, path, options.preset, options.steps_a_frame, parts).result()


def measured(path: Path, preset: PresetName, steps_a_frame: int, parts: Sequence[range]) -> tuple[Row, list[Score]]:
    """Reconstruct and score a clip. Returns its row, and the scores of the held-out frames in each part."""
    iterations = steps_a_frame * len(list(path.glob("*l.png")))
    memory = StageMemory()
    hooks = TrainingHooks(on_progress=memory.on_progress)
    with tempfile.TemporaryDirectory(prefix="intrasplat-long-") as folder:
        request = ReconstructionRequest(path, ReconstructionOptions(preset=preset, iterations=iterations), device="cpu")
        made = make(request, Path(folder), hooks)
        report = score_scene(made, hooks)
        memory.end_stage()
        scores = _scores(made, load_scene(Path(folder)), parts) if parts else []
    print(*(each.text for each in report.assumptions if each.code == NoticeCode.BASES), sep="\n")
    return _row(path.name, preset, iterations, report, memory), scores


def _scores(made: Made, scene: TrainedScene, parts: Sequence[range]) -> list[Score]:
    """psnr_tissue in dB of the held-out frames in each part, left eye and right eye."""
    renderer, found = SceneRenderer(scene, made.device), []
    for part in parts:
        held_out = tuple(index for index in made.split.held_out if index in part)
        first = made.report.model_copy(update={"held_out": held_out})
        report = score_model(first, made.clip, made.split.train, renderer.seen_from, Hooks())
        found.append((report.psnr_tissue_db, report.psnr_right_db))
    return found


def _row(name: str, preset: str, iterations: int, report: Report, memory: StageMemory) -> Row:
    return {
        "clip": name, "preset": preset, "iterations": iterations,
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
    """The folder of the clip. If it does not exist, all cores draw its frames."""
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


def _part(clip: Path, part: range) -> Path:
    """A folder with links to some of the clip's frames."""
    folder = clip.with_name(f"{clip.name}-{part.start}to{part.stop}")
    for file in [*clip.glob("*.*"), *clip.glob("masks/*")]:
        if file.name[:6].isdigit() and int(file.name[:6]) not in part:
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
    parser.add_argument("--parts", nargs="+", type=int, default=(0, 600))
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
