"""Small synthetic clips and runs on them, shared by the tests of training."""

from __future__ import annotations

from functools import cache

import numpy as np

from contract.wire.options import ReconstructionOptions
from worker.input.clip import DepthClip, FrameSplit, split_frames
from worker.machine.hooks import Hooks
from worker.phantom import Motion, PhantomSettings, make_phantom
from worker.pipeline import scene_of
from worker.train.looking import View, view_function
from worker.train.loop import Run, Stopwatch, train
from worker.train.prepare import prepare
from worker.train.presets import PRESETS, Preset

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
        moving_camera=moving_camera,
        tools=tools,
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
    return prepare(clip, split, chosen, options, Stopwatch())[0]


def trained(run: Run, hooks: Hooks | None = None) -> Run:
    """The run after its last step, nothing scored."""
    train(run, Stopwatch(), lambda: float("nan"), hooks or Hooks())
    return run


def view(run: Run, index: int) -> View:
    """Frame `index` as the model shows it from the endoscope's pose."""
    return view_function(run, run.frames.scale)(index)


def bits(run: Run, clip: DepthClip, split: FrameSplit) -> dict[str, bytes]:
    """Every tensor of the scene that the run makes, as bytes."""
    scene = scene_of(run, clip, split, run.frames.scale, run.seed)
    return {name: np.ascontiguousarray(each.numpy()).tobytes() for name, each in scene.tensors().items()}
