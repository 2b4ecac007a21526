"""Small synthetic clips and runs on them, shared by the tests of training."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np

from contract.wire.options import ReconstructionOptions
from worker.input.clip import DepthClip, FrameSplit, split_frames
from worker.machine.timing import Stopwatch
from worker.methods.method import Preset
from worker.methods.registry import PRESETS
from worker.outcome import scene_of
from worker.phantom import Motion, PhantomSettings, make_phantom
from worker.train.hooks import RenderedFrame, TrainingHooks
from worker.train.loop import train
from worker.train.prepare import prepare
from worker.train.resume import begin_save, resume
from worker.train.run import Run
from worker.train.scoring import HeldOutScore, frame_renderer
from worker.train.setup import Setup

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
