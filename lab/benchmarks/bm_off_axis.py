"""Views beside the endoscope: a sheet of pictures to look at, and where a synthetic clip's error lies.

    python -m lab.benchmarks.bm_off_axis [--clip phantom:pull:stereo] [--iterations 400] [--picture FILE.jpg]

Trains `fast` on the left eye alone, its guesses shown, and on both eyes, with what was never seen marked. A row of the
sheet is a pose in the middle of the clip, 12 and 20 degrees to each side in yaw and pitch; its columns are the truth of
a phantom, the left eye's scene and both eyes' scene. Without --picture none is drawn. Pictures of a patient do not
belong into the repository.

Of a phantom, a line for each training and angle of lab/evaluate/truth.py: of the judged pixels, the area of each
kind, its share of the squared error, and its score in dB. highlights: the lamp is mirrored elsewhere than for the
endoscope, by MIRRORED or more. hidden: some frame showed this tissue, but now an instrument hides it from both eyes.
edges: within EDGE_PX of a step of depth. rest: all others.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import split_frames
from intrasplat.machine.hooks import Hooks
from intrasplat.methods.registry import preset_named
from intrasplat.names import Eyes
from intrasplat.options import ReconstructionOptions
from intrasplat.outcome import scene_of
from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.cpu import compile_kernels
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.prepare import prepare
from intrasplat.train.scoring import HeldOutScore
from intrasplat.train.setup import Setup
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from intrasplat.view.render import render_frame
from intrasplat.view.unseen import hatched
from lab.evaluate.sources import OpenClip, open_source, source_of
from lab.evaluate.truth import Expected, SceneCandidate, Truth, seen_now

HOLDOUT = "every8"
POSES_DEG = ((12, 0), (-12, 0), (0, 12), (0, -12), (20, 0), (-20, 0), (0, 20), (0, -20))
"""Yaw and pitch of the sheet's rows."""
PICTURE_WIDTH = 320
MIRRORED = 0.06
"""Brightness (white is 1) by which a highlight here differs from the endoscope's view of the same tissue."""
EDGE_PX, STEP_MM = 4, 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clip", default="phantom:pull:stereo")
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    compile_kernels()
    opened = open_source(source_of(options.clip), HOLDOUT, Hooks())
    both: tuple[Eyes, ...] = ("left", "both")
    scenes = {eyes: trained(opened, eyes, options.iterations) for eyes in both}
    if opened.phantom is not None:
        split = split_frames(opened.clip, HOLDOUT)
        truth = Truth(opened.phantom, opened.tissue, split.train, split.held_out, opened.tissue_right)
        for eyes, scene in scenes.items():
            for angle_deg, views in truth.off_axis.items():
                print(f"{eyes} at {angle_deg:g} degrees: {parts(opened, scene, views)}", flush=True)
    if options.picture:
        sheet = np.concatenate([np.concatenate(row, axis=1) for row in pictures(opened, scenes)])
        cv2.imwrite(str(options.picture), sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def trained(opened: OpenClip, eyes: Eyes, iterations: int) -> TrainedScene:
    """The scene of `fast` after `iterations` iterations on one eye or both."""
    options = ReconstructionOptions(iterations=iterations, eyes=eyes, holdout=HOLDOUT)
    setup = Setup(opened.clip, split_frames(opened.clip, HOLDOUT), preset_named("fast"), options)
    run = prepare(setup)
    train(run, setup.clock, lambda: HeldOutScore(math.nan, math.nan), TrainingHooks())
    return scene_of(run)


def parts(opened: OpenClip, scene: TrainedScene, views: list[Expected]) -> str:
    """The kinds of pixel, over all views: area, share of the error, dB."""
    assert opened.phantom is not None
    candidate, found = SceneCandidate(scene), []
    for view in views:
        shown = np.clip(candidate.view(view.frame, view.pose).rgb, 0, 1)
        error = np.square(shown - view.rgb).mean(-1)
        mirrored = np.abs(view.rgb - view.baked).max(-1) > MIRRORED
        hidden = ~seen_now(opened.phantom, view, opened.tissue, opened.tissue_right)
        kind = np.select([mirrored, hidden, near_steps(view.depth_mm)], [0, 1, 2], 3)
        found.append(np.stack([kind[view.judged], error[view.judged]]))
    kind, error = np.concatenate(found, axis=1)
    lines = []
    for number, name in enumerate(("highlights", "hidden", "edges", "rest")):
        own = error[kind == number]
        score_db = -10 * math.log10(own.mean()) if own.size else math.nan
        lines.append(f"{name} {own.size / error.size:.1%}, {own.sum() / error.sum():.0%}, {score_db:.1f} dB")
    return "; ".join(lines)


def near_steps(depth_mm: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[H, W] whether depth within EDGE_PX of a pixel differs by more than STEP_MM."""
    box = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    return np.asarray(cv2.dilate(depth_mm, box) - cv2.erode(depth_mm, box) > STEP_MM)


def pictures(opened: OpenClip, scenes: dict[Eyes, TrainedScene]) -> list[list[NDArray[np.uint8]]]:
    """The sheet's rows."""
    rows, frame = [], opened.clip.frame_count // 2
    for yaw_deg, pitch_deg in POSES_DEG:
        orbit, row = OrbitPose(yaw_deg=yaw_deg, pitch_deg=pitch_deg, zoom=1.0), []
        pivot_mm = MEDIAN_DEPTH_UNITS / scenes["both"].units_per_mm
        pose = np.array(world_from_camera(orbit, pivot_mm), np.float64)
        if opened.phantom is not None:
            row.append(small((np.clip(opened.phantom.render(frame, pose)[0], 0, 1) * 255).astype(np.uint8)))
        for eyes, scene in scenes.items():
            shown = render_frame(scene, frame / scene.frame_count, pose)
            row.append(small(shown.rgb if eyes == "left" else hatched(shown.rgb, shown.unseen)))
        rows.append(row)
    return rows


def small(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = picture.shape[:2]
    size = (PICTURE_WIDTH, round(height * PICTURE_WIDTH / width))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


if __name__ == "__main__":
    main()
