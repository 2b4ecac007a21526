"""How exactly is a moving camera's path found, of each path and motion of the phantom and of a real fixed camera?

    python -m lab.benchmarks.bm_poses [--motions breathing pull] [--paths pan ...] [--frames 64] [--seeds 0]
        [--noise 0.25 1.0] [--out poses.csv]

Draws stereo clips of 320x256 whose poses are withheld, and estimates them (`--poses estimate`). Prints and writes of
each: absolute trajectory error in mm and degrees, root mean square after rigid alignment, of training frames and of
held-out ones; what the report says of the path and how sure it is; whether `auto` would have taken the camera as fixed;
the period of the tissue's motion that was found; and the seconds. With INTRASPLAT_DATA set, d4d_stereo, whose camera is
fixed, comes last; its error is the distance from rest.

With --noise the clips come with depth, and with poses that err by so many mm (one sigma per axis) and by as much again
at the tissue by their angles; `auto` decides what of them to trust: error before and after, and what the report says.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from intrasplat.clip import training_frames
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.options import ReconstructionOptions
from intrasplat.poses import camera_rests, with_poses
from intrasplat.poses.estimate import find_path
from intrasplat.poses.trajectory import trajectory_error
from lab.conditions.scenes import noisy
from lab.evaluate.rows import commit
from lab.evaluate.sources import open_source, source_of

PATHS = ("still", "pan", "advance", "roll", "turn", "shake", "swing")
"""still: no path, a fixed camera. With INTRASPLAT_DATA set, its recorded paths may be named, too, such as p1_00240."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motions", nargs="+", default=["breathing", "pull"])
    parser.add_argument("--paths", nargs="+", default=PATHS)
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--holdout", default="every8")
    parser.add_argument("--noise", type=float, nargs="+", metavar="MM")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    layout = ":stereo" if arguments.noise is None else ""
    clips = [
        f"phantom:{motion}{'' if path == 'still' else '+' + path}:{arguments.frames}frames:seed{seed}{layout}"
        for seed in arguments.seeds
        for motion in arguments.motions
        for path in arguments.paths
    ]
    rows: list[dict[str, object]] = []
    for row in _rows(clips, arguments.noise, arguments.holdout):
        rows.append({"commit": commit(), **row})
        print("  ".join(f"{name} {value}" for name, value in row.items()), flush=True)
        if arguments.out:
            write(arguments.out, rows)


def _rows(clips: Sequence[str], noise_mm: Sequence[float] | None, holdout: str) -> Iterator[dict[str, object]]:
    if noise_mm is None:
        for clip in [*clips, "d4d_stereo"] if os.environ.get("INTRASPLAT_DATA") else clips:
            yield {"clip": clip, **measured(clip, holdout)}
    else:
        for clip in clips:
            for level in noise_mm:
                yield {"clip": clip, "noise_mm": level, **steadied(clip, level, holdout)}


def write(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write the rows measured so far."""
    if rows:
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def measured(name: str, holdout: str) -> dict[str, object]:
    """One row."""
    opened = open_source(source_of(name), holdout, Hooks())
    clip, phantom = opened.clip, opened.phantom
    true = np.tile(np.eye(4), (clip.frame_count, 1, 1))
    if phantom is not None:
        true = np.stack([phantom.world_from_camera(i) for i in range(clip.frame_count)])
    train = training_frames(clip.frame_count, holdout)
    held_out = sorted(set(range(clip.frame_count)) - set(train))
    began_s = time.perf_counter()
    rests = camera_rests(clip, train)
    looked_s = time.perf_counter() - began_s
    found = find_path(clip, train)
    path_s = time.perf_counter() - began_s - looked_s
    trained, held = (trajectory_error(found.world_from_camera[some], true[some]) for some in (train, held_out))
    return {
        "ate_mm": f"{trained.mm:.2f}",
        "ate_deg": f"{trained.deg:.2f}",
        "held_out_mm": f"{held.mm:.2f}",
        "held_out_deg": f"{held.deg:.2f}",
        "auto": "rests" if rests else "moves" if found.moves else "fixed",
        "extent_mm": f"{found.extent_mm:.1f}",
        "extent_deg": f"{found.extent_deg:.1f}",
        "sigma_mm": f"{found.sigma_mm:.2f}",
        "sigma_deg": f"{found.sigma_deg:.2f}",
        "rigid_fit_mm": f"{found.rigid_fit_mm:.3f}",
        "tissue_mm": f"{found.tissue_mm:.2f}",
        "period_frames": "" if found.period_frames is None else f"{found.period_frames:.1f}",
        "unsure": len(found.unsure),
        "look_s": f"{looked_s:.2f}",
        "path_s": f"{path_s:.1f}",
    }


def steadied(name: str, noise_mm: float, holdout: str) -> dict[str, object]:
    """One row of a phantom whose given poses err by `noise_mm`."""
    opened = open_source(source_of(name), holdout, Hooks())
    phantom = opened.phantom
    if phantom is None:
        raise ValueError(f"{name} has no true poses.")
    true = np.stack([phantom.world_from_camera(i) for i in range(opened.clip.frame_count)])
    clip = dataclasses.replace(
        opened.clip, world_from_camera=noisy(true, noise_mm, np.random.default_rng(phantom.settings.seed))
    )
    began_s = time.perf_counter()
    result = with_poses(clip, ReconstructionOptions(holdout=holdout), Hooks(), Timings())
    path_s = time.perf_counter() - began_s
    before, after = (trajectory_error(each.world_from_camera, true) for each in (clip, result))
    told = [notice.code.value for notice in result.warnings if notice not in clip.warnings]
    told += [notice.text for notice in result.assumptions if notice not in clip.assumptions]
    return {
        "given_mm": f"{before.mm:.2f}",
        "given_deg": f"{before.deg:.2f}",
        "ate_mm": f"{after.mm:.2f}",
        "ate_deg": f"{after.deg:.2f}",
        "share_mm": f"{after.mm / before.mm:.2f}",
        "share_deg": f"{after.deg / before.deg:.2f}",
        "path_s": f"{path_s:.1f}",
        "told": "; ".join(told),
    }


if __name__ == "__main__":
    main()
