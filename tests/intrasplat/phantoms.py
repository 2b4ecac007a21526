"""Small synthetic clips and runs on them, shared by the tests of training."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, FrameSplit, split_frames
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Stopwatch, Timings
from intrasplat.methods.method import Preset
from intrasplat.methods.registry import PRESETS
from intrasplat.options import ReconstructionOptions
from intrasplat.outcome import scene_of
from intrasplat.stereo import match_eyes
from intrasplat.train.hooks import RenderedFrame, TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.prepare import prepare
from intrasplat.train.resume import begin_save, resume
from intrasplat.train.run import Run
from intrasplat.train.scoring import HeldOutScore, frame_renderer
from intrasplat.train.setup import Setup
from lab.phantom import Motion, PhantomSettings, make_phantom

WIDTH, HEIGHT, FRAMES = 96, 80, 12


@cache
def phantom_clip(
    motion: Motion = "breathing",
    *,
    frames: int = FRAMES,
    width: int = WIDTH,
    height: int = HEIGHT,
    moving_camera: bool = False,
    tools: bool = True,
    noise: bool = True,
) -> DepthClip:
    """A phantom's left eye with true depth. Callers share the arrays: copy before you write."""
    settings = PhantomSettings(
        width=width,
        height=height,
        frames=frames,
        motion=motion,
        camera=("swing",) * moving_camera,
        tools=("grasper",) * tools,
        noise=noise,
        period_frames=12.0,
    )
    return make_phantom(settings).depth_clip()


def matched_stereo(settings: PhantomSettings) -> tuple[DepthClip, NDArray[np.float64]]:
    """A stereo clip without poses, whose depth is stereo's, and its true poses [T, 4, 4], mm."""
    phantom = make_phantom(settings)
    drawn = phantom.stereo_recording()
    clip = match_eyes(drawn.clip, drawn.calibration, "every8", Hooks(), Timings())
    return clip, np.stack([phantom.world_from_camera(i) for i in range(settings.frames)])


def prepared(
    clip: DepthClip, preset: str | Preset = "fast", *, iterations: int = 20, seed: int = 0, holdout: str = "every8"
) -> tuple[Run, FrameSplit]:
    """A run before its first step, and the split it trains on."""
    split = split_frames(clip, holdout)
    return prepared_on(clip, split, preset, iterations=iterations, seed=seed), split


def prepared_on(
    clip: DepthClip, split: FrameSplit, preset: str | Preset = "fast", *, iterations: int = 20, seed: int = 0
) -> Run:
    """The same on a given split."""
    chosen = PRESETS[preset] if isinstance(preset, str) else preset
    options = ReconstructionOptions(iterations=iterations, seed=seed)
    return prepare(Setup(clip, split, chosen, options))


def trained(run: Run, hooks: TrainingHooks | None = None) -> Run:
    """The run after its last step, nothing scored."""
    train(run, Stopwatch(), lambda: HeldOutScore(math.nan, math.nan), hooks or TrainingHooks())
    return run


def keep(directory: Path, run: Run, t_train_s: float = 0.0) -> None:
    begin_save(directory, run, t_train_s)()


def kept(directory: Path, new: Run) -> Run:
    """The run that is kept there, resumed with the setup of a new one."""
    run = resume(directory, new.setup)
    assert run is not None
    return run


def view(run: Run, index: int) -> RenderedFrame:
    """Frame `index` as the model shows it from the endoscope's pose."""
    return frame_renderer(run)(index)


def bits(run: Run) -> dict[str, bytes]:
    """Every tensor of the scene that the run makes, as bytes."""
    scene = scene_of(run)
    return {name: np.ascontiguousarray(each.numpy()).tobytes() for name, each in scene.tensors().items()}
