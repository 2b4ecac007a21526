"""How often a Gaussian was seen: drawn on tissue, not hidden by the surface, as sure as its depth was."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.helpers import assert_close
from tests.worker.clips import HEIGHT, WIDTH, plane_clip
from tests.worker.phantoms import prepared
from worker.fusion import COMPLETED_CONFIDENCE
from worker.input.clip import DepthClip
from worker.report.visibility import MAX_UNSEEN_WIDTH, SAMPLED_FRAMES, drop_strays, seen_share
from worker.train.run import Run
from worker.train.targets import TrainingFrames


@pytest.fixture
def clip() -> DepthClip:
    """A plane across which a tool wanders; the camera stands still."""
    return plane_clip(12)


def start(clip: DepthClip) -> Run:
    return prepared(clip, "paper", holdout="none")[0]


def pixels(run: Run, clip: DepthClip) -> NDArray[np.intp]:
    """Flat index of the pixel each Gaussian's centre lies on; the camera is the world."""
    x, y, z = run.model.deformed_mean(0.0)
    camera = clip.intrinsics
    column, row = np.floor(camera.fx * x / z + camera.cx), np.floor(camera.fy * y / z + camera.cy)
    return np.asarray(row * WIDTH + column, np.intp)


def test_a_gaussian_counts_in_the_frames_that_show_its_tissue(clip: DepthClip) -> None:
    run = start(clip)
    shown = clip.tissue.reshape(clip.frame_count, -1).mean(0)[pixels(run, clip)]
    assert shown.min() < 0.9
    seen = seen_share(run.model, [run.frames])
    assert np.abs(seen - shown).mean() < 0.05  # it is drawn around its centre, too
    assert_close(seen[shown == 1], np.ones(int((shown == 1).sum())), absolute=0.5)
    assert np.corrcoef(seen, shown)[0, 1] > 0.9


def test_a_gaussian_whose_centre_no_frame_shows_is_seen_if_tissue_shows_much_of_it(clip: DepthClip) -> None:
    run = start(clip)
    middle = int(np.abs(pixels(run, clip) - (HEIGHT // 2 * WIDTH + WIDTH // 2)).argmin())
    column = int(pixels(run, clip)[middle]) % WIDTH
    shares = []
    for hidden_columns in (column + 1, WIDTH):
        tissue = np.ones_like(clip.tissue)
        tissue[:, :, :hidden_columns] = False
        hidden = TrainingFrames(dataclasses.replace(clip, tissue=tissue), run.frames.indices, run.frames.scale)
        shares.append(float(seen_share(run.model, [hidden])[middle]))
    assert 0.2 < shares[0] < 0.6
    assert shares[1] == 0


def test_unsure_depth_makes_a_gaussian_less_seen(clip: DepthClip) -> None:
    run = start(clip)
    unsure = dataclasses.replace(clip, depth_confidence=np.full_like(clip.depth_confidence, 51))
    assert_close(
        seen_share(run.model, [TrainingFrames(unsure, run.frames.indices, run.frames.scale)]),
        seen_share(run.model, [run.frames]) / 5,
    )


def test_behind_the_surface_behind_the_camera_and_outside_the_image_nothing_is_seen(clip: DepthClip) -> None:
    run = prepared(clip, "fast", holdout="none")[0]
    run.model.opacity_logit[:] = 3
    count, before = run.model.count, seen_share(run.model, [run.frames])
    row, column = np.divmod(pixels(run, clip), WIDTH)
    chosen = np.flatnonzero((row > 32) & (row < 44) & (column > 8) & (column < WIDTH - 8))[::17]
    assert before[chosen].min() > 0.9
    run.model.take(np.concatenate([np.arange(count), np.tile(chosen, 3)]), np.zeros(count + 3 * len(chosen), np.bool_))
    behind, turned_away, outside = count + np.arange(3 * len(chosen)).reshape(3, -1)
    run.model.canonical[:3, behind] *= 1.2
    run.model.canonical[2, turned_away] *= -1
    run.model.canonical[0, outside] += 200
    seen = seen_share(run.model, [run.frames])
    assert not seen[count:].any()
    assert_close(seen[:count], before, absolute=1e-3)


def test_a_wide_gaussian_on_tissue_without_depth_is_no_stray(clip: DepthClip) -> None:
    run = start(clip)
    run.model.canonical[7:10] = np.log(2 * MAX_UNSEEN_WIDTH)
    unsure = dataclasses.replace(clip, depth_confidence=np.zeros_like(clip.depth_confidence))
    seen = seen_share(run.model, [TrainingFrames(unsure, run.frames.indices, run.frames.scale)])
    assert seen.any()
    assert (seen <= COMPLETED_CONFIDENCE + 1e-6).all()
    assert drop_strays(run.model, [TrainingFrames(unsure, run.frames.indices, run.frames.scale)]) == 0


def test_a_long_clip_is_sampled_evenly() -> None:
    clip = plane_clip(2 * SAMPLED_FRAMES)
    clip.tissue[:] = True
    clip.tissue[: clip.frame_count // 2] = False
    run = prepared(clip, "fast", holdout="none")[0]
    assert np.median(seen_share(run.model, [run.frames])) == pytest.approx(0.5, abs=0.05)
