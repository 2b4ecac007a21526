"""Measure what each part of `fast` is worth: train with one part changed at a time.

    python -m lab.benchmarks.bm_ablation [--iterations 400] [--seeds 1] [--csv lab/rows/ablation.csv]
        [--only NAME ...]

The number of iterations is fixed, so the decibels do not depend on how busy the machine is. Clips: the real recording
(named `d4d-a`, if it is there) and two synthetic motions with true depth, 320 x 256, 64 frames. Both splits.
Below 500 iterations a run is one cycle, and `rates fall once, nothing averaged` lacks only the average.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from intrasplat.clip import DepthClip, open_clip, split_frames
from intrasplat.options import ReconstructionOptions
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.splat.optimize import Rate
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.prepare import prepare
from intrasplat.train.presets import PRESETS, Preset
from intrasplat.train.scoring import frame_renderer, held_out_score, sample_frames
from intrasplat.train.setup import Setup
from lab.evaluate.rows import commit, machine
from lab.phantom import PhantomSettings, make_phantom

FIELDS = (
    "change", "clip", "holdout", "iterations", "seed", "start_db", "psnr_tissue_db", "train_db", "gaussians", "bases",
    "machine", "commit",
)  # fmt: skip
_FAST, _PAPER = PRESETS["fast"], PRESETS["paper"]


def _rates(**rates: Rate | float) -> Preset:
    return dataclasses.replace(_FAST, rates=dataclasses.replace(_FAST.rates, **rates))  # type: ignore[arg-type]


_PUBLISHED_MOTION = _PAPER.rates.motion_mean
CHANGES: dict[str, Preset] = {
    "fast": _FAST,
    "without tracks": dataclasses.replace(_FAST, tracks=False),
    "colour at rest": _rates(motion_colour=Rate(0.0)),
    "published rates of motion": _rates(
        motion_mean=_PUBLISHED_MOTION, motion_quaternion=_PUBLISHED_MOTION, motion_log_scale=_PUBLISHED_MOTION
    ),
    "published rates of colour and shape": _rates(
        colour=_PAPER.rates.colour, log_scale=_PAPER.rates.log_scale, quaternion=_PAPER.rates.quaternion
    ),
    "Adam's moments as published": _rates(beta1=_PAPER.rates.beta1, beta2=_PAPER.rates.beta2),
    "without first moments": _rates(beta1=0.0),
    "plain L1 of colour": dataclasses.replace(_FAST, loss=dataclasses.replace(_FAST.loss, colour_huber_delta=0.0)),
    "rates fall once, nothing averaged": dataclasses.replace(_FAST, warm_restarts=False, min_gain_db=None),
    "opacity 0.8, spread 0.6": dataclasses.replace(_FAST, opacity=0.8, spread=0.6),
    "9 bases": dataclasses.replace(_FAST, bases=9),
    "20 k points": dataclasses.replace(_FAST, points_per_image=20_000),
    "40 k points": dataclasses.replace(_FAST, points_per_image=40_000),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", nargs="*", choices=list(CHANGES), help="these changes alone")
    parser.add_argument("--csv", type=Path, help="append the rows here")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("INTRASPLAT_DATA", "../shared/data")))
    arguments = parser.parse_args()
    for clip_name, opened in clips(arguments.data).items():
        clip = opened()
        for holdout in ("every8", "blocks8"):
            for change in arguments.only or CHANGES:
                for seed in range(arguments.seeds):
                    row = measure(change, clip_name, clip, holdout, arguments.iterations, seed)
                    print("  ".join(str(row[name]) for name in FIELDS[:-2]), flush=True)
                    if arguments.csv:
                        append(arguments.csv, row)


def clips(data: Path) -> dict[str, Callable[[], DepthClip]]:
    """The clips by name, opened when they are needed."""

    def real() -> DepthClip:
        clip = open_clip(data / "d4d_endonerf")
        assert isinstance(clip, DepthClip)
        return clip

    def synthetic(motion: str) -> Callable[[], DepthClip]:
        settings = PhantomSettings(width=320, height=256, frames=64, motion=motion, seed=3)
        return lambda: make_phantom(settings).depth_clip()

    found = {f"phantom-{motion}": synthetic(motion) for motion in ("pull", "breathing")}
    return {"d4d-a": real, **found} if (data / "d4d_endonerf").exists() else found


def measure(
    change: str, clip_name: str, clip: DepthClip, holdout: str, iterations: int, seed: int
) -> dict[str, object]:
    """Train and score one cell; its row."""
    split = split_frames(clip, holdout)
    options = ReconstructionOptions(iterations=iterations, seed=seed)
    run = prepare(Setup(clip, split, CHANGES[change], options))
    render = frame_renderer(run)
    start = held_out_score(run).left_db
    train(run, run.setup.clock, lambda: held_out_score(run), TrainingHooks())
    trained = [psnr_tissue(render(i).rgb, clip.rgb[i], clip.tissue[i]) for i in sample_frames(split.train)]
    _, deformation = run.model.export()
    row: dict[str, object] = {
        "change": change, "clip": clip_name, "holdout": holdout, "iterations": iterations, "seed": seed,
        "start_db": start, "psnr_tissue_db": run.curve[-1].psnr_tissue_db, "train_db": float(np.mean(trained)),
        "gaussians": run.model.count, "bases": deformation.parameters()["weight"].shape[-1],
        "machine": machine(), "commit": commit(),
    }  # fmt: skip
    return {name: round(value, 2) if isinstance(value, float) else value for name, value in row.items()}


def append(path: Path, row: dict[str, object]) -> None:
    """Add the row to the CSV, with a header if the file is new; a file of other columns is refused."""
    fresh = not path.exists()
    if not fresh and path.read_text().splitlines()[:1] != [",".join(FIELDS)]:
        raise SystemExit(f"{path} has other columns than {', '.join(FIELDS)}: move it away first.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if fresh:
            writer.writeheader()
        writer.writerow(row)


if __name__ == "__main__":
    main()
