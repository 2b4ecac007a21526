"""Gaussians that nothing saw and that grew wide are taken out; all others stay."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from intrasplat.clip import DepthClip
from intrasplat.quality.trust import trust
from intrasplat.quality.visibility import MAX_UNSEEN_WIDTH, drop_strays
from intrasplat.train.loop import step
from intrasplat.train.run import Run
from intrasplat.train.targets import TrainingFrames
from tests.intrasplat.clips import plane_clip
from tests.intrasplat.phantoms import prepared

LOG_SCALE = slice(7, 10)
OUT_OF_SIGHT = 200.0
"""Units to the right: no camera of the clip looks there."""


@pytest.fixture
def clip() -> DepthClip:
    """A plane across which a tool wanders; the camera stands still."""
    return plane_clip(12)


def start(clip: DepthClip, preset: str) -> Run:
    """A run whose first two Gaussians were never seen."""
    run = prepared(clip, preset, holdout="none")[0]
    run.model.canonical[0, :2] += OUT_OF_SIGHT
    return run


@pytest.mark.parametrize("preset", ["fast", "paper", "hexplane"])
def test_a_wide_gaussian_that_nothing_saw_is_taken_out(preset: str, clip: DepthClip) -> None:
    run = start(clip, preset)
    count = run.model.count
    run.model.canonical[LOG_SCALE, 0] = np.log(2 * MAX_UNSEEN_WIDTH)
    kept = run.model.canonical[:3, 1:count].copy()
    assert drop_strays(run.model, [run.frames]) == 1
    np.testing.assert_array_equal(run.model.canonical[:3, : run.model.count], kept)


def test_what_was_seen_may_be_wide_and_what_is_narrow_may_be_unseen(clip: DepthClip) -> None:
    run = start(clip, "fast")
    count = run.model.count
    seen = trust(run.model, [run.frames])
    assert seen[:2].tolist() == [0, 0]
    run.model.canonical[LOG_SCALE, int(seen.argmax())] = np.log(2 * MAX_UNSEEN_WIDTH)
    assert drop_strays(run.model, [run.frames]) == 0
    assert run.model.count == count


@pytest.mark.parametrize("preset", ["fast", "paper", "hexplane"])
def test_adams_moments_go_and_the_model_stays(preset: str, clip: DepthClip) -> None:
    run = prepared(clip, preset, holdout="none")[0]
    step(run, 1)
    trained = {name: values.clone() for name, values in run.model.parameters().items()}
    drop_strays(run.model, [run.frames])
    left = run.model.parameters()
    assert all(torch.equal(values, left[name]) for name, values in trained.items())
    moments = {name: each for name, each in run.model.arrays().items() if name.startswith("moments.")}
    assert moments
    assert not any(bool(each.any()) for each in moments.values())


def test_a_wide_gaussian_that_alone_shows_the_tissue_around_it_stays(clip: DepthClip) -> None:
    run = prepared(clip, "fast", holdout="none")[0]
    camera = run.frames.cameras[run.frames.indices[0]]
    x, y, z = run.model.deformed_mean(0.0)
    off_centre_px = np.hypot(camera[0] * x / z, camera[1] * y / z)
    middle = int(off_centre_px.argmin())
    elsewhere = np.flatnonzero(off_centre_px > 20)
    run.model.take(np.array([middle, *elsewhere], np.int64), np.zeros(1 + len(elsewhere), np.bool_))
    run.model.canonical[LOG_SCALE, 0] = np.log(2 * MAX_UNSEEN_WIDTH)
    height, width = clip.tissue.shape[1:]
    rows, columns = np.mgrid[:height, :width]
    hidden = np.hypot(columns + 0.5 - camera[2], rows + 0.5 - camera[3]) < 5
    under_a_tool = dataclasses.replace(clip, tissue=clip.tissue & ~hidden)
    opacity_logit = run.model.opacity_logit.copy()
    assert drop_strays(run.model, [TrainingFrames(under_a_tool, run.frames.indices, run.frames.scale)]) == 0
    np.testing.assert_array_equal(run.model.opacity_logit, opacity_logit)
