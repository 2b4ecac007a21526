"""Measure what a right eye that is turned or of other colours costs, with and without registration.

    python -m benchmarks.bm_registration [--iterations 300] [--frames 16] [--motion breathing]

Synthetic tissue of 320x256 whose right pictures are redrawn. `rows` corrects a row shift alone. moved: by how many
px registration moved the right eye; depth: median error in mm where confidence is a half or more; left: psnr_tissue of
held-out frames (every8); right: that of the render from the true right camera against the right pictures before they
were redrawn, which training never saw. Notices are those of stereo.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from functools import partial
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.wire.options import ReconstructionOptions
from worker.input.calibration import RectifiedClip, rectify
from worker.input.clip import DepthClip, Eye, held_out_frames, split_frames
from worker.machine.timing import Stopwatch
from worker.methods.registry import PRESETS
from worker.model.metrics import psnr_tissue
from worker.phantom import Phantom, PhantomSettings, make_phantom
from worker.raster.cpu import compile_kernels
from worker.stereo import depth, estimate_depth
from worker.stereo.registration import Registration
from worker.stereo.turn import Turn
from worker.train.hooks import TrainingHooks
from worker.train.loop import train
from worker.train.prepare import prepare
from worker.train.run import Run
from worker.train.scoring import HeldOutScore, frame_renderer
from worker.train.setup import Setup

HOLDOUT, SURE, STRIP = "every8", 128, 0.1
Picture = NDArray[np.uint8]


class RowsAlone(Registration):
    """What stereo corrected before it registered the right eye."""

    @classmethod
    def of_matches(cls, matches, shift, calibrated, baseline_mm):  # type: ignore[no-untyped-def]
        """The row shift."""
        shown_px = shift.shift_px if abs(shift.shift_px) >= 0.2 else 0.0
        return cls(calibrated, baseline_mm, Turn(shown_px), matches=shift.matches, residual_px=shift.residual_px)

    def refined(self, *_: object) -> RowsAlone:
        """Itself."""
        return self


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--motion", default="breathing")
    options = parser.parse_args()
    compile_kernels(lambda _: None)
    settings = PhantomSettings(width=320, height=256, frames=options.frames, motion=options.motion, period_frames=16)
    phantom = make_phantom(settings)
    recording = phantom.stereo_recording()
    clip = rectify(recording.clip, recording.calibration)
    pairs = list(clip.pairs())
    _print_masks(clip, recording.tissue_right)
    print(f"{'right eye':28}{'corrects':>10}{'moved':>7}{'depth':>7}{'left':>7}{'right':>7}  notices")
    for name, change in _cases(clip).items():
        spoilt = dataclasses.replace(clip, pairs=partial(iter, [(left, change(right)) for left, right in pairs]))
        for corrects, kind in (("rows", RowsAlone), ("all", Registration)):
            with patch.object(depth, "Registration", kind):
                _print(f"{name:28}{corrects:>10}", phantom, spoilt, [right for _, right in pairs], options.iterations)


def _print_masks(clip: RectifiedClip, truth: NDArray[np.bool_] | None) -> None:
    right = estimate_depth(clip).right
    assert right is not None
    assert truth is not None
    missed, lost = right.tissue[~truth].mean(), (~right.tissue[truth]).mean()
    print(f"moved masks: {missed:.2%} of the instrument is taken for tissue, {lost:.2%} of the tissue for instrument")


def _cases(clip: RectifiedClip) -> dict[str, Callable[[Picture], Picture]]:
    turns = {f"roll {degrees} degrees": Turn(roll_rad=np.deg2rad(degrees)) for degrees in (0.05, 0.1, 0.5)}
    turns["pitch 0.1 degrees"] = Turn(lower_px=np.deg2rad(0.1) * clip.intrinsics.fy, pitch_rad=np.deg2rad(0.1))
    return {
        "as drawn": lambda right: right,
        **{name: partial(_turned, turn, clip) for name, turn in turns.items()},
        "gain 1.1": partial(_brightened, np.array([1.1, 1.1, 1.1]), 0.0),
        "gain 1.1, 1, 0.9, offset 5": partial(_brightened, np.array([1.1, 1.0, 0.9]), 5.0),
    }


def _turned(turn: Turn, clip: RectifiedClip, right: Picture) -> Picture:
    matrix, size = turn.from_rectified(clip.intrinsics), (clip.intrinsics.width, clip.intrinsics.height)
    return np.asarray(
        cv2.warpPerspective(right, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), np.uint8
    )


def _brightened(gain: NDArray[np.float64], offset: float, right: Picture) -> Picture:
    return np.clip(np.rint(right * gain + offset), 0, 255).astype(np.uint8)


def _print(head: str, phantom: Phantom, spoilt: RectifiedClip, truth: list[Picture], iterations: int) -> None:
    held_out = held_out_frames(spoilt.frame_count, HOLDOUT)
    clip = estimate_depth(spoilt, measured_frames=[i for i in range(spoilt.frame_count) if i not in held_out])
    assert clip.registration is not None
    assert clip.right is not None
    run = _trained(clip, iterations)
    k = spoilt.intrinsics
    exact = dataclasses.replace(
        clip.right,
        intrinsics=k,
        world_from_camera=np.stack([phantom.world_from_right(i) for i in range(clip.frame_count)]),
    )
    tissue_right = phantom.stereo_recording().tissue_right.copy()
    tissue_right[:, :, -round(STRIP * k.width) :] = False
    left_db = _score(run, clip, clip.rgb, clip.tissue, None)
    right_db = _score(run, clip, np.stack(truth), tissue_right, exact)
    first = phantom.frame(0)
    sure = (clip.depth_confidence[0] >= SURE) & first.tissue & (first.depth_mm > 0)
    off_mm = float(np.median(np.abs(clip.depth_mm[0] - first.depth_mm)[sure]))
    told = " ".join(str(each.code) for each in clip.warnings)
    print(f"{head}{clip.registration.moved_px:7.2f}{off_mm:7.2f}{left_db:7.2f}{right_db:7.2f}  {told}", flush=True)


def _trained(clip: DepthClip, iterations: int) -> Run:
    options = ReconstructionOptions(iterations=iterations, holdout=HOLDOUT)
    run = prepare(Setup(clip, split_frames(clip, HOLDOUT), PRESETS["fast"], options))
    train(run, Stopwatch(), lambda: HeldOutScore(float("nan"), float("nan")), TrainingHooks())
    return run


def _score(run: Run, clip: DepthClip, rgb: Picture, tissue: NDArray[np.bool_], eye: Eye | None) -> float:
    render = frame_renderer(run, None, eye)
    return float(np.mean([psnr_tissue(render(i).rgb, rgb[i], tissue[i]) for i in run.setup.split.held_out]))


if __name__ == "__main__":
    main()
