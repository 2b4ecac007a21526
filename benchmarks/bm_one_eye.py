"""What one eye can tell of the other: the left eye of a stereo clip teaches, the right eye judges, and what bounds it.

    python benchmarks/bm_one_eye.py [--clip d4d_stereo] [--iterations 300] [--holdout every8] [--seed 0]

A line for each of these, in dB over the held-out frames, also without highlights:

warp             the left eye's picture warped by stereo depth
warp by flow     the same, moved on by optical flow to the right eye's own picture: no depth map gains much more
left eye         `fast` on the left eye
both eyes        `fast` on both eyes without gloss: one colour for both
left's colours   the geometry and motion of `both eyes`, with the colours trained on the left eye alone
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import sys
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.wire.options import ReconstructionOptions
from worker.evaluate.sources import DATA_VARIABLE, open_source, source_of
from worker.input.clip import DepthClip, split_frames
from worker.machine.hooks import Hooks
from worker.methods.method import Preset
from worker.methods.registry import preset_named
from worker.model.metrics import clear_of_highlights, psnr_tissue
from worker.model.optimize import Rate
from worker.raster.cpu import compile_kernels
from worker.report.right_eye import warped_left
from worker.train.loop import step
from worker.train.prepare import prepare
from worker.train.run import Run
from worker.train.schedule import Schedule
from worker.train.scoring import frame_renderer, judged_pixels
from worker.train.setup import Setup

Picture = NDArray[np.uint8] | NDArray[np.float32]
COLOURS = ("colour", "motion_colour")
COLOUR_SHARE = 1 / 3
"""Of the iterations: those in which the colours alone are trained."""


class WithoutGloss(Setup):
    """A run whose Gaussians have one colour for both eyes."""

    @property
    def sides(self) -> tuple[float, float]:
        return 0.0, 0.0


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    clip = open_source(source_of(options.clip), options.holdout, Hooks()).clip
    if clip.right is None:
        print(f"{options.clip} has one eye: give a stereo clip, such as phantom:pull:stereo")
        return 1
    compile_kernels(lambda *_: None)
    preset = preset_named("fast")
    print(f"{'':16}{'left':>8}{'clear':>8}{'right':>8}{'clear':>8}", flush=True)
    held_out = split_frames(clip, options.holdout).held_out
    _print("warp", clip, held_out, None, lambda index: warped_left(clip, index))
    _print("warp by flow", clip, held_out, None, lambda index: warped_by_flow(clip, index))
    for label, kind, eyes in (
        ("left eye", Setup, "left"),
        ("both eyes", WithoutGloss, "both"),
    ):
        given = ReconstructionOptions(
            iterations=options.iterations, eyes=eyes, holdout=options.holdout, seed=options.seed
        )
        run = prepare(kind(clip, split_frames(clip, options.holdout), preset, given))
        _train(run)
        _print_run(label, run)
    run.right, run.preset, run.iteration = None, colours_alone(run.preset), 0
    run.schedule = Schedule(max(round(options.iterations * COLOUR_SHARE), 1))
    _train(run)
    _print_run("left's colours", run)
    return 0


def colours_alone(preset: Preset) -> Preset:
    """The preset with every rate 0 but those of colour and of its motion."""
    held = {
        name: Rate(0.0) for name, rate in vars(preset.rates).items() if isinstance(rate, Rate) and name not in COLOURS
    }
    return dataclasses.replace(preset, rates=dataclasses.replace(preset.rates, **held))


def warped_by_flow(clip: DepthClip, index: int) -> NDArray[np.uint8]:
    """The warped left eye [H, W, 3], moved by its optical flow to the right eye's picture."""
    assert clip.right is not None
    warped = warped_left(clip, index)
    greys = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (clip.right.rgb[index], warped))
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*greys, None)  # type: ignore[call-overload]
    row, column = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    moved = cv2.remap(
        warped, column + flow[..., 0], row + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(moved, np.uint8)


def _train(run: Run) -> None:
    """As training does, without the mean of the last models."""
    while run.iteration < run.iterations:
        run.iteration += 1
        step(run, run.iteration)


def _print_run(label: str, run: Run) -> None:
    clip = run.setup.clip
    left, right = frame_renderer(run), frame_renderer(run, eye=clip.right)
    _print(label, clip, run.setup.split.held_out, lambda i: left(i).rgb, lambda i: right(i).rgb)


def _print(
    label: str,
    clip: DepthClip,
    held_out: Sequence[int],
    left: Callable[[int], Picture] | None,
    right: Callable[[int], Picture],
) -> None:
    """One line: means over the held-out frames of the scores of the left and right eye's pictures."""
    assert clip.right is not None
    rows = []
    for index in held_out:
        shown = left(index) if left is not None else None
        own = _scores(shown, clip.rgb[index], clip.tissue[index]) if shown is not None else (math.nan, math.nan)
        rows.append((*own, *_scores(right(index), clip.right.rgb[index], judged_pixels(clip.right, index))))
    print(f"{label:16}" + "".join(f"{mean:8.2f}" for mean in np.mean(rows, axis=0)), flush=True)


def _scores(shown: Picture, truth: NDArray[np.uint8], judged: NDArray[np.bool_]) -> tuple[float, float]:
    """psnr_tissue in dB of the judged pixels, and without highlights."""
    clear = judged & clear_of_highlights(shown, truth)
    return psnr_tissue(shown, truth, judged), psnr_tissue(shown, truth, clear)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    recorded = "d4d_stereo" if os.environ.get(DATA_VARIABLE) else "phantom:breathing:stereo"
    parser.add_argument("--clip", default=recorded)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--holdout", default="every8")
    parser.add_argument("--seed", type=int, default=0)
    return parser


if __name__ == "__main__":
    sys.exit(main())
