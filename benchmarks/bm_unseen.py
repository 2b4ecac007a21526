"""Is what no frame saw marked, and is what a frame saw not? What does it cost a render?

    python benchmarks/bm_unseen.py [--iterations 200] [--rounds 30]

Trains `fast` on a phantom of 320x256 for each motion, under an instrument that never moves: the mask of frame 0 lies on
all frames. Prints of each, in the held-out frames: of the pixels that no frame shows as tissue, and of the tissue, the
share that is hatched (tissue that moves comes out from under the instrument and is seen); psnr_tissue with the hatch,
and of the guess; from 12 degrees off the share of pixels that two planes, weights of all Gaussians and of those seen,
would decide otherwise. Then the medians of so many renders in turn: colour, depth and alpha alone; with the plane that
decides; with a second one; and render_frame with all it does.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from statistics import mean, median

import numpy as np
from numpy.typing import NDArray

from contract.wire.options import ReconstructionOptions
from contract.wire.pose import OrbitPose, world_from_camera
from worker.input.clip import DepthClip, FrameSplit, split_frames
from worker.methods.registry import PRESETS
from worker.model.metrics import COVERED_ALPHA, psnr_tissue
from worker.outcome import scene_of
from worker.phantom import MOTIONS, PhantomSettings, make_phantom
from worker.raster.cpu import compile_kernels
from worker.raster.step import camera_vector
from worker.render.unseen import blended_values, hatched, unseen_pixels
from worker.render.view import render_frame
from worker.scene.model import model_of
from worker.scene.scene import Scene
from worker.train.hooks import TrainingHooks
from worker.train.loop import train
from worker.train.prepare import prepare
from worker.train.scoring import HeldOutScore
from worker.train.setup import Setup
from worker.train.targets import MEDIAN_DEPTH_UNITS, camera_in_units

ASIDE_DEG = ((12, 0), (-12, 0), (0, 12))
"""Yaw and pitch."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=200, help="of each run")
    parser.add_argument("--rounds", type=int, default=30)
    arguments = parser.parse_args()
    compile_kernels()
    for motion in MOTIONS:
        clip = make_phantom(PhantomSettings(width=320, height=256, frames=48, motion=motion)).depth_clip()
        clip = dataclasses.replace(clip, tissue=clip.tissue & clip.tissue[0])
        split = split_frames(clip)
        scene = trained(clip, split, arguments.iterations)
        print(f"{motion:9} {marks(scene, clip, split)}  {differs(scene):.2%} decided otherwise", flush=True)
        print(f"{'':9} {costs(scene, arguments.rounds)}", flush=True)


def trained(clip: DepthClip, split: FrameSplit, iterations: int) -> Scene:
    """The scene after so many iterations."""
    run = prepare(Setup(clip, split, PRESETS["fast"], ReconstructionOptions(iterations=iterations)))
    train(run, run.setup.clock, lambda: HeldOutScore(float("nan"), float("nan")), TrainingHooks())
    return scene_of(run)


def marks(scene: Scene, clip: DepthClip, split: FrameSplit) -> str:
    """What is hatched in the held-out frames, and what that costs their score."""
    never, rows = ~clip.tissue.any(0), []
    for index in split.held_out:
        frame, tissue = render_frame(scene, float(clip.t[index])), clip.tissue[index]
        pictures = (hatched(frame.rgb, frame.unseen), frame.rgb)
        scores_db = (psnr_tissue(each, clip.rgb[index], tissue) for each in pictures)
        rows.append((float(frame.unseen[never].mean()), float(frame.unseen[tissue].mean()), *scores_db))
    hidden, shown, mark_db, guess_db = (mean(column) for column in zip(*rows, strict=True))
    return (
        f"never seen {never.mean():.1%}, of it hatched {hidden:.1%}, of the tissue {shown:.3%}  "
        f"{mark_db:.2f} dB marked, {guess_db:.2f} dB guessed"
    )


def differs(scene: Scene) -> float:
    """Share of pixels from aside in which the weights of Gaussians that some frame saw decide otherwise by majority."""
    model, seen, found = model_of(scene), scene.seen.numpy(), []
    for yaw_deg, pitch_deg in ASIDE_DEG:
        orbit = OrbitPose(yaw_deg=yaw_deg, pitch_deg=pitch_deg, zoom=1)
        pose = np.array(world_from_camera(orbit, MEDIAN_DEPTH_UNITS / scene.units_per_mm))
        *_, alpha, blended = model.render(vector(scene, pose), 0.5, blended_values(seen)).copy()
        seen_weight = model.blend_values((seen > 0).astype(np.float32))
        solid = alpha >= COVERED_ALPHA
        by_majority = unseen_pixels(solid & (seen_weight >= 0.5 * alpha), None)
        found.append(float((unseen_pixels(solid, blended) != by_majority).mean()))
    return mean(found)


def costs(scene: Scene, rounds: int) -> str:
    """Median milliseconds of each way to render."""
    model, seen = model_of(scene), scene.seen.numpy()
    camera, values = vector(scene, scene.world_from_camera[0]), blended_values(seen)

    def twice() -> None:
        model.render(camera, 0.5, values)
        model.blend_values(seen)

    ways: dict[str, Callable[[], object]] = {
        "five planes": lambda: model.render(camera, 0.5),
        "six": lambda: model.render(camera, 0.5, values),
        "seven": twice,
        "render_frame": lambda: render_frame(scene, 0.5),
    }
    taken_ms: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds + 1):  # the first fits the buffers
        for name, way in ways.items():
            start = time.perf_counter()
            way()
            taken_ms[name].append((time.perf_counter() - start) * 1e3)
    return "  ".join(f"{name} {median(each[1:]):.1f} ms" for name, each in taken_ms.items())


def vector(scene: Scene, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """The clip's camera at world_from_camera [4, 4] in mm, as kernels take it."""
    return camera_vector(camera_in_units(scene.intrinsics, pose, scene.units_per_mm))


if __name__ == "__main__":
    main()
