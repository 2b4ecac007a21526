"""How well is tissue rendered that comes into view later, and how good are estimated poses compared with true ones?

    python -m lab.benchmarks.bm_keyframes [--motions breathing pull] [--paths still pan ...] [--frames 128] [--seeds 0
        1]
        [--iterations 600] [--out keyframes.csv]

Draws stereo clips of 320x256 and trains `fast` on each with true poses and with those that `auto` finds, or with a
file of the true poses (--poses file), in metres and from world to camera, which nothing in the file says. Prints and
writes of each run: held-out psnr_tissue of the left and the right eye; the share of the tissue seen by any frame that
the scene covers (lab/evaluate/seen.py); Gaussians, bases, and seconds of poses and of tracks. Then of what has left
the view, from where the camera was a quarter of the clip before: the median error of its depth in mm, had it stayed
as it was then (rest_mm), and as the scene shows it (gone_mm); the mean confidence there, and that of what is in view.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import mean

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import unproject
from intrasplat.fusion.points import cells_of
from intrasplat.machine.hooks import Hooks
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.poses import placed
from intrasplat.poses.rigid import inverse
from intrasplat.poses.trajectory import write_tum
from intrasplat.report import CameraPoses, Report
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.view.render import render_frame
from lab.benchmarks.bm_poses import PATHS, write
from lab.evaluate.rows import commit
from lab.evaluate.seen import seen_points, share_covered
from lab.evaluate.sources import OpenClip, open_source, source_of
from lab.phantom import Phantom

HOLDOUT = "every8"
EVERY = 4
"""Coverage is measured in every fourth frame."""
LEFT_AFTER = 0.25
"""Share of the clip: tissue seen from the pose this long ago, and out of view now, counts as tissue that has left."""
MIN_LEFT_SHARE = 0.05
"""A view is measured if at least this share of it shows tissue that has left."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motions", nargs="+", default=["breathing"])
    parser.add_argument("--paths", nargs="+", default=PATHS)
    parser.add_argument("--frames", type=int, default=128)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--poses", nargs="+", choices=("true", "auto", "file"), default=["true", "auto"])
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rows: list[dict[str, object]] = []
    for motion in arguments.motions:
        for path in arguments.paths:
            for seed in arguments.seeds:
                moving = "" if path == "still" else f"+{path}"
                name = f"phantom:{motion}{moving}:{arguments.frames}frames:seed{seed}:stereo"
                opened = open_source(source_of(name), HOLDOUT, Hooks())
                for poses in arguments.poses:
                    found = measured(opened, poses, arguments.iterations)
                    rows.append({"commit": commit(), "clip": name, "poses": poses, **found})
                    print("  ".join(f"{key} {value}" for key, value in rows[-1].items() if key != "commit"), flush=True)
                    if arguments.out:
                        write(arguments.out, rows)


def measured(opened: OpenClip, poses: str, iterations: int) -> dict[str, object]:
    """One row."""
    clip, phantom = opened.clip, opened.phantom
    assert phantom is not None
    true = np.stack([phantom.world_from_camera(index) for index in range(clip.frame_count)])
    if poses == "true":
        clip = replace(placed(clip, true), poses=CameraPoses(source="given"))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "poses.tum" if poses == "file" else None
        if file is not None:
            write_tum(file, clip.frame_times_s, inverse(true))
        options = ReconstructionOptions(preset="fast", iterations=iterations, holdout=HOLDOUT)
        report = reconstruct(ReconstructionRequest(clip, options, poses=file), Path(folder), TrainingHooks())
        scene = load_scene(Path(folder))
    return {
        "iterations": iterations,
        "taken_as": report.poses.source if report.poses else "",
        "left_db": f"{report.psnr_tissue_db:.2f}",
        "right_db": f"{report.psnr_right_db:.2f}",
        "covered": f"{covered(scene, opened):.4f}",
        **gone(scene, phantom),
        "gaussians": report.gaussians,
        "bases": report.bases,
        **seconds(report),
    }


def seconds(report: Report) -> dict[str, str]:
    """Seconds of the stages poses, tracks, points and start."""
    return {name: f"{report.seconds.get(name, 0):.1f}" for name in ("poses_s", "motion_s", "fusion_s", "start_s")}


def covered(scene: TrainedScene, opened: OpenClip) -> float:
    """Share of the tissue seen by any frame that the scene covers, from its own poses."""
    assert opened.phantom is not None
    frames = range(0, scene.frame_count, EVERY)
    seen = seen_points(opened.phantom, frames, opened.tissue, opened.tissue_right)
    views = [render_frame(scene, index / scene.frame_count) for index in frames]
    return share_covered(opened.phantom, seen, np.stack([(view.depth_mm > 0) & ~view.unseen for view in views]))


def gone(scene: TrainedScene, phantom: Phantom) -> dict[str, str]:
    """Depth error and confidence of tissue that has left the view. Empty if too little has left.

    The lamp moves with the camera, so colours are not compared.
    """
    count, before = scene.frame_count, round(LEFT_AFTER * scene.frame_count)
    found: dict[str, list[float]] = {name: [] for name in ("rest_mm", "gone_mm", "gone_confidence", "confidence")}
    for index in range(before, count, EVERY):
        pose, true_pose = scene.world_from_camera[index - before], phantom.world_from_camera(index - before)
        true_mm = phantom.surface_pixels(index, true_pose).depth_mm
        left = (true_mm > 0) & ~in_view(phantom, index, true_mm, true_pose)
        if left.mean() < MIN_LEFT_SHARE:
            continue
        view, own = render_frame(scene, index / count, pose), render_frame(scene, index / count)
        still_mm = phantom.surface_pixels(index - before, true_pose).depth_mm
        shown = left & (view.depth_mm > 0)
        found["rest_mm"].append(float(np.median(np.abs(still_mm - true_mm)[shown])))
        found["gone_mm"].append(float(np.median(np.abs(view.depth_mm - true_mm)[shown])))
        found["gone_confidence"].append(float(view.confidence[left].mean()))
        found["confidence"].append(float(own.confidence.mean()))
    return {name: f"{mean(values):.2f}" if values else "" for name, values in found.items()}


def in_view(
    phantom: Phantom, frame: int, depth_mm: NDArray[np.float32], world_from_camera: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """[H, W] whether the endoscope sees, at a frame, the tissue that the pixels of another view show."""
    places = cells_of(
        unproject(np.arange(depth_mm.size), depth_mm.ravel(), phantom.settings.intrinsics, world_from_camera),
        phantom.settings.intrinsics,
        phantom.world_from_camera(frame),
        stride=1,
    )[1]
    inside = np.zeros(depth_mm.size, np.bool_)
    inside[places] = True
    return inside.reshape(depth_mm.shape)


if __name__ == "__main__":
    main()
