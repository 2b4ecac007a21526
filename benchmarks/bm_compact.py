"""Measure what quantising a scene saves and costs: bytes against decibels, on training and on held-out frames.

    python benchmarks/bm_compact.py [CLIP ...] [--iterations 1200] [--tolerances 0.05 0.1 0.14 0.2 0.4 0.8] [--csv FILE]

Trains `fast` on each clip (default: a synthetic one) for so many iterations, then stores the result at one tolerance
after the other. Prints a row each: megabytes of the floats, of the compact file and of the manifest, the step, what was
lost on the judged training frames and on all held-out ones, and the seconds to shrink, store and load.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from pathlib import Path

from contract.wire.options import ReconstructionOptions
from worker.evaluate.rows import commit, machine, write_rows
from worker.input.clip import DepthClip, open_clip, split_frames
from worker.machine.timing import Stopwatch
from worker.methods.registry import PRESETS
from worker.outcome import scene_of
from worker.phantom import PhantomSettings, make_phantom
from worker.scene.checkpoint import MANIFEST_FILE, SCENE_FILE, load_scene, save_scene
from worker.scene.model import model_of
from worker.train.hooks import TrainingHooks
from worker.train.loop import train
from worker.train.prepare import prepare
from worker.train.rate_distortion import round_model
from worker.train.scoring import HeldOutScore, held_out_score
from worker.train.setup import Setup

FIELDS = (
    "clip", "iterations", "gaussians", "bases", "held_out_db", "tolerance_db", "step", "train_loss_db",
    "held_out_loss_db", "float_mb", "scene_mb", "manifest_mb", "shrink_s", "load_s", "machine", "commit",
)  # fmt: skip
TOLERANCES_DB = (0.05, 0.1, 0.14, 0.2, 0.4, 0.8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="*", type=Path, help="in the EndoNeRF layout (default: synthetic tissue)")
    parser.add_argument("--iterations", type=int, default=1200)
    parser.add_argument("--tolerances", nargs="+", type=float, default=TOLERANCES_DB)
    parser.add_argument("--csv", type=Path, help="write the rows here")
    arguments = parser.parse_args()
    rows: list[dict[str, object]] = []
    for path in arguments.clips or [None]:
        for row in rows_of(path, arguments.iterations, arguments.tolerances):
            print("  ".join(f"{name} {row[name]}" for name in FIELDS[:-2]), flush=True)
            rows.append(row)
            if arguments.csv:
                write_rows(arguments.csv, FIELDS, rows)


def rows_of(path: Path | None, iterations: int, tolerances_db: list[float]) -> list[dict[str, object]]:
    """One training run, stored at each tolerance."""
    clip = open_clip(path) if path else make_phantom(PhantomSettings()).depth_clip()
    if not isinstance(clip, DepthClip):
        raise SystemExit(f"{path} has no depth; give a folder in the EndoNeRF layout.")
    split = split_frames(clip)
    run = prepare(Setup(clip, split, PRESETS["fast"], ReconstructionOptions(iterations=iterations)))
    train(run, Stopwatch(), lambda: HeldOutScore(math.nan, math.nan), TrainingHooks())
    scene = scene_of(run)
    exact_db = held_out_score(run).left_db
    rows: list[dict[str, object]] = []
    for tolerance_db in tolerances_db:
        start = time.perf_counter()
        rounded = round_model(model_of(scene), scene, [run.frames], tolerance_db)
        if rounded is None:
            continue
        quantized = rounded.stored(scene)
        shrink_s = time.perf_counter() - start
        with tempfile.TemporaryDirectory() as folder:
            save_scene(Path(folder), quantized.scene)
            start = time.perf_counter()
            loaded = load_scene(Path(folder))
            load_s = time.perf_counter() - start
            scene_bytes, manifest_bytes = ((Path(folder) / name).stat().st_size for name in (SCENE_FILE, MANIFEST_FILE))
        stored_db = held_out_score(run, model_of(loaded)).left_db
        rows.append(
            {
                "clip": path.name if path else "phantom", "iterations": iterations, "gaussians": len(loaded.gaussians),
                "bases": len(quantized.scene.deformation.constants()["centre"]), "held_out_db": f"{exact_db:.2f}",
                "tolerance_db": tolerance_db, "step": f"{quantized.step:.3g}",
                "train_loss_db": f"{quantized.loss_db:.3f}",
                "held_out_loss_db": f"{exact_db - stored_db:.3f}", "float_mb": f"{scene.byte_count / 1e6:.2f}",
                "scene_mb": f"{scene_bytes / 1e6:.3f}", "manifest_mb": f"{manifest_bytes / 1e6:.3f}",
                "shrink_s": f"{shrink_s:.2f}", "load_s": f"{load_s:.2f}", "machine": machine(), "commit": commit(),
            }
        )  # fmt: skip
    return rows


if __name__ == "__main__":
    main()
