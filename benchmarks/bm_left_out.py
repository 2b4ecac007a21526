"""What leaving out frames that show nothing new saves, and what it costs.

    python benchmarks/bm_left_out.py [--frames 256] [--width 320] [--height 256] [--iterations 300] [--only repeats ...]

Draws stereo clips of synthetic tissue whose frames repeat, pause, rest, hardly move, or move. Matches and trains each
with all frames and without those that show nothing new (`--use-frames`). Prints the median seconds of stereo, of three
runs in turn, and psnr_tissue in dB: of the held-out frames and of those that were left out, the mean of both eyes; and
of the left eye's frames, every fifth, against the tissue as it moved: without noise, and between repeats half-way.

repeats   breathing, every frame twice, with the same bits
pulldown  the same, and the second one has noise of its own
frozen    breathing, and in the middle 100 frames of one picture, with the same bits
paused    the same, each with noise of its own
slow      breathing, 16 times as slow
very-slow breathing, 64 times as slow
still     nothing but noise
moving    breathing
pulled    tissue is pulled, held and let go
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from statistics import median

import numpy as np
from numpy.typing import NDArray

from contract.wire.options import ReconstructionOptions
from worker.input.clip import DepthClip, StereoClip, split_frames
from worker.machine.hooks import Hooks
from worker.machine.timing import Timings
from worker.methods.registry import preset_named
from worker.model.metrics import psnr_tissue
from worker.phantom import Motion, Phantom, PhantomSettings, make_phantom
from worker.phantom.shading import add_noise
from worker.raster.cpu import compile_kernels
from worker.stereo.opening import match_eyes
from worker.train.hooks import TrainingHooks
from worker.train.loop import train
from worker.train.prepare import prepare
from worker.train.run import Run
from worker.train.scoring import HeldOutScore, frame_renderer
from worker.train.setup import Setup

FROZEN_FRAMES = 100
REPEATING = ("repeats", "pulldown")
REPEATS = 3
"""Runs of stereo."""


def _frozen(count: int) -> NDArray[np.float64]:
    """Moments of a clip that stands still in its middle."""
    start = (count - FROZEN_FRAMES) // 2
    return np.concatenate([np.arange(start), np.full(FROZEN_FRAMES, start), np.arange(start, count - FROZEN_FRAMES)])


Moments = Callable[[int], NDArray[np.float64]]
CLIPS: dict[str, tuple[Motion, bool, Moments]] = {
    "repeats": ("breathing", False, lambda count: np.arange(count) // 2 * 1.0),
    "pulldown": ("breathing", True, lambda count: np.arange(count) // 2 * 1.0),
    "frozen": ("breathing", False, _frozen),
    "paused": ("breathing", True, _frozen),
    "slow": ("breathing", True, lambda count: np.arange(count) / 16),
    "very-slow": ("breathing", True, lambda count: np.arange(count) / 64),
    "still": ("still", True, lambda count: np.arange(count) * 1.0),
    "moving": ("breathing", True, lambda count: np.arange(count) * 1.0),
    "pulled": ("pull", True, lambda count: np.arange(count) * 1.0),
}
"""By name: the motion, whether each frame has noise of its own, and the moment, in frames, that each frame shows."""


def main(arguments: Sequence[str] | None = None) -> None:
    options = _parser().parse_args(arguments)
    compile_kernels(lambda *_: None)
    columns = ("frames", "trained", "left out", "stereo s", "bases", "held out dB", "left out dB", "true dB")
    print(f"{'clip':10}" + "".join(f"{column:>12}" for column in columns))
    for name in options.only:
        motion, own_noise, moments = CLIPS[name]
        size = {"width": options.width, "height": options.height, "frames": options.frames}
        phantom = make_phantom(PhantomSettings(**size, motion=motion, tools=()))
        drawn = _drawn(phantom, moments(options.frames), own_noise)
        matched = [(each, *_matched(phantom, drawn, each == "new")) for _ in range(REPEATS) for each in ("all", "new")]
        clips = {each: clip for each, clip, _ in matched}
        true_moments = np.arange(options.frames) / 2 if name in REPEATING else moments(options.frames)
        for each, clip in clips.items():
            stereo_s = median(seconds for what, _, seconds in matched if what == each)
            run = _trained(clip, options.iterations)
            scored = run.setup.split.held_out, clips["new"].left_out
            scores = [
                *(_score(run, clips["all"], frames) for frames in scored),
                _true_score(run, phantom, true_moments),
            ]
            counts = f"{len(run.setup.split.train):12}{len(clip.left_out):12}{stereo_s:12.2f}"
            counts += f"{run.model.export()[1].bases:12}"
            print(f"{name:10}{each:>12}{counts}" + "".join(f"{score:12.2f}" for score in scores), flush=True)


def _drawn(phantom: Phantom, moments: NDArray[np.float64], own_noise: bool) -> list[NDArray[np.uint8]]:
    """Frames [2, H, W, 3] of both eyes."""
    pictures: dict[float, NDArray[np.float32]] = {}
    frames: list[NDArray[np.uint8]] = []
    for moment in moments.tolist():
        repeats = moment in pictures
        if not repeats:
            poses = phantom.world_from_camera(moment), phantom.world_from_right(moment)
            pictures[moment] = np.stack([phantom.render(moment, pose)[0] for pose in poses])
        noisy = add_noise(pictures[moment], np.random.default_rng(len(frames))) * 255 + 0.5
        frames.append(frames[-1] if repeats and not own_noise else np.clip(noisy, 0, 255).astype(np.uint8))
    return frames


def _matched(phantom: Phantom, drawn: Sequence[NDArray[np.uint8]], leave_out: bool) -> tuple[DepthClip, float]:
    """The clip with depth, and the seconds of stereo."""
    settings, timings = phantom.settings, Timings()
    times_s = np.arange(len(drawn)) / settings.frame_rate_hz
    clip = StereoClip(len(drawn), settings.height, settings.width, lambda: map(tuple, drawn), None, times_s)
    made = match_eyes(clip, settings.calibration, "every8", Hooks(), timings, leave_out=leave_out)
    return made, timings.seconds["stereo_s"]


def _trained(clip: DepthClip, iterations: int) -> Run:
    run = prepare(Setup(clip, split_frames(clip), preset_named("fast"), ReconstructionOptions(iterations=iterations)))
    train(run, run.setup.clock, lambda: HeldOutScore(np.nan, np.nan), TrainingHooks())
    return run


def _score(run: Run, clip: DepthClip, frames: Iterable[int]) -> float:
    """Mean psnr_tissue of both eyes' frames, dB."""
    assert clip.right is not None
    left, right = frame_renderer(run), frame_renderer(run, eye=clip.right)
    found = []
    for index in frames:
        found.append(psnr_tissue(left(index).rgb, clip.rgb[index], clip.tissue[index]))
        found.append(psnr_tissue(right(index).rgb, clip.right.rgb[index], clip.right.tissue[index]))
    return float(np.mean(found)) if found else float("nan")


def _true_score(run: Run, phantom: Phantom, moments: NDArray[np.float64]) -> float:
    """Mean psnr_tissue of every fifth frame of the left eye against the tissue at its moment, dB."""
    shown, found = frame_renderer(run), []
    for index in range(0, len(moments), 5):
        truth = np.clip(phantom.render(float(moments[index]))[0] * 255 + 0.5, 0, 255).astype(np.uint8)
        found.append(psnr_tissue(shown(index).rgb, truth, np.ones(truth.shape[:2], np.bool_)))
    return float(np.mean(found))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=256)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=256)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--only", nargs="+", choices=CLIPS, default=list(CLIPS))
    return parser


if __name__ == "__main__":
    main()
