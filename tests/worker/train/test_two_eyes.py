"""Both eyes of a moment in one step; what is held out is held out in both."""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from typing import get_args

import numpy as np
import pytest

from contract.wire.options import Eyes, ReconstructionOptions
from tests.worker.phantoms import bits, trained
from worker.input.calibration import rectify
from worker.input.clip import DepthClip, split_frames
from worker.methods.registry import PRESETS
from worker.model.optimize import rates_at
from worker.phantom import PhantomSettings, make_phantom
from worker.stereo import estimate_depth
from worker.train.loop import step
from worker.train.prepare import prepare
from worker.train.run import Run
from worker.train.scoring import held_out_score
from worker.train.setup import Setup

WIDTH, HEIGHT, FRAMES = 160, 128, 12


@cache
def stereo_clip() -> DepthClip:
    """Callers share the arrays: copy before you write."""
    settings = PhantomSettings(width=WIDTH, height=HEIGHT, frames=FRAMES, motion="breathing", period_frames=12.0)
    recording = make_phantom(settings).stereo_recording()
    return estimate_depth(rectify(recording.clip, recording.calibration), measured_frames=[0, 2, 4, 6])


def prepared(clip: DepthClip, *, eyes: Eyes = "both", preset: str = "fast", iterations: int = 20) -> Run:
    options = ReconstructionOptions(iterations=iterations, eyes=eyes)
    return prepare(Setup(clip, split_frames(clip), PRESETS[preset], options))


def test_a_step_on_both_eyes_descends_the_sum_of_their_losses() -> None:
    """The gradients of two frames of one moment add up before the motion takes them."""
    together, apart = prepared(stereo_clip()), prepared(stereo_clip())
    assert apart.right is not None
    index = apart.frames.indices[3]
    left, right = apart.frames.frame(index), apart.right.frame(index)
    later = dataclasses.replace(right, t=math.nextafter(right.t, 1.0))  # no longer the same moment to the bit
    rates = rates_at(apart.preset.rates, 0.5)
    together.model.step([left, right], apart.preset.loss, rates, 1)
    apart.model.step([left, later], apart.preset.loss, rates, 1)
    for name, values in together.model.arrays().items():
        other = apart.model.arrays()[name]
        np.testing.assert_allclose(values.numpy(), other.numpy(), rtol=1e-3, atol=1e-5, err_msg=name)


def test_a_step_takes_both_eyes_of_its_frame() -> None:
    one, both = prepared(stereo_clip(), eyes="left"), prepared(stereo_clip())
    assert len(one.eyes) == 1
    assert len(both.eyes) == 2
    step(one, 1)
    step(both, 1)
    assert not np.array_equal(one.model.gradient_norm.numpy(), both.model.gradient_norm.numpy())


@pytest.mark.parametrize("preset", ["paper", "pfs"])
def test_the_published_methods_train_on_the_left_eye(preset: str) -> None:
    assert len(prepared(stereo_clip(), preset=preset, iterations=1).eyes) == 1


def test_tissue_that_only_the_right_eye_sees_gets_points() -> None:
    clip = stereo_clip()
    one, both = prepared(clip, eyes="left"), prepared(clip)
    assert clip.right is not None
    k, strip = clip.right.intrinsics, np.s_[:, WIDTH - 6 :]
    assert (clip.right.depth_mm[0][strip] == 0).mean() > 0.9
    alphas = [run.model.render(both.eyes[1].cameras[0], 0.0)[4][strip].mean() for run in (one, both)]
    assert alphas[1] > 0.8
    assert both.model.count > one.model.count
    assert k.width == WIDTH


def test_the_right_eye_gains_where_it_teaches() -> None:
    runs = (trained(prepared(stereo_clip(), eyes=eyes, iterations=150)) for eyes in get_args(Eyes))
    one, both = (held_out_score(run) for run in runs)
    assert both.right_db > one.right_db
    assert both.left_db > one.left_db - 1.0


def test_held_out_moments_are_held_out_in_both_eyes() -> None:
    """Poison: whatever the held-out pictures show, the scene is the same to the bit."""
    clip = stereo_clip()
    held_out = split_frames(clip).held_out
    assert held_out

    def poisoned(values: np.ndarray) -> np.ndarray:
        spoilt = values.copy()
        spoilt[held_out] = np.random.default_rng(0).integers(0, 2, spoilt[held_out].shape).astype(spoilt.dtype)
        return spoilt

    layers = ("rgb", "tissue", "depth_mm", "depth_confidence")
    assert clip.right is not None
    right = dataclasses.replace(clip.right, **{name: poisoned(getattr(clip.right, name)) for name in layers})
    spoilt = dataclasses.replace(clip, right=right, **{name: poisoned(getattr(clip, name)) for name in layers})
    first, second = (bits(trained(prepared(each, iterations=8))) for each in (clip, spoilt))
    assert first == second
