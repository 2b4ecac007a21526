"""How likely a Gaussian is right: seen on tissue, in the image, not behind the surface, in colour and at its depth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.quality.trust import SAMPLED_PICTURES, evidence, trust
from intrasplat.quality.visibility import MAX_UNSEEN_WIDTH, drop_strays
from intrasplat.train.run import Run
from intrasplat.train.targets import TrainingFrames
from tests.helpers import assert_close
from tests.intrasplat.clips import HEIGHT, WIDTH, plane_clip
from tests.intrasplat.phantoms import prepared


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


def share(run: Run, *eyes: TrainingFrames) -> NDArray[np.float64]:
    """[N] share of the training frames that saw each Gaussian."""
    return evidence(run.model, eyes or [run.frames])[0]


def as_given(run: Run, clip: DepthClip) -> TrainingFrames:
    """The run's frames of another clip."""
    return TrainingFrames(clip, run.frames.indices, run.frames.scale)


def test_a_gaussian_counts_in_the_frames_that_show_its_tissue(clip: DepthClip) -> None:
    run = start(clip)
    shown = clip.tissue.reshape(clip.frame_count, -1).mean(0)[pixels(run, clip)]
    assert shown.min() < 0.9
    seen = share(run)
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
        shares.append(float(share(run, hidden)[middle]))
    assert 0.2 < shares[0] < 0.6
    assert shares[1] == 0


def test_of_two_eyes_the_one_counts_that_saw_it_oftener(clip: DepthClip) -> None:
    run = start(clip)
    blind = as_given(run, dataclasses.replace(clip, tissue=np.zeros_like(clip.tissue)))
    sampled = share(run, run.frames, run.frames)
    assert_close(share(run, run.frames, blind), sampled, name="shares")


def test_behind_the_surface_behind_the_camera_and_outside_the_image_nothing_is_seen(clip: DepthClip) -> None:
    run = prepared(clip, "fast", holdout="none")[0]
    run.model.opacity_logit[:] = 3
    count, before = run.model.count, share(run)
    row, column = np.divmod(pixels(run, clip), WIDTH)
    chosen = np.flatnonzero((row > 32) & (row < 44) & (column > 8) & (column < WIDTH - 8))[::17]
    assert before[chosen].min() > 0.9
    run.model.take(np.concatenate([np.arange(count), np.tile(chosen, 3)]), np.zeros(count + 3 * len(chosen), np.bool_))
    behind, turned_away, outside = count + np.arange(3 * len(chosen)).reshape(3, -1)
    run.model.canonical[:3, behind] *= 1.2
    run.model.canonical[2, turned_away] *= -1
    run.model.canonical[0, outside] += 200
    seen = share(run)
    assert not seen[count:].any()
    assert not trust(run.model, [run.frames])[count:].any()
    assert_close(seen[:count], before, absolute=1e-3)


def test_wrong_colours_and_wrong_depth_make_a_gaussian_less_trusted_where_it_shows_them(clip: DepthClip) -> None:
    run = start(clip)
    column = pixels(run, clip) % WIDTH
    spoilt, sound = column < 20, column > 40
    before = evidence(run.model, [run.frames])[1]
    trusted = trust(run.model, [run.frames])
    other_rgb, other_mm = clip.rgb.copy(), clip.depth_mm.copy()
    other_rgb[:, :, :30] = 255
    other_mm[:, :, :30] *= 1.1
    for changed in (dataclasses.replace(clip, rgb=other_rgb), dataclasses.replace(clip, depth_mm=other_mm)):
        frames = as_given(run, changed)
        errors = evidence(run.model, [frames])[1]
        assert np.median(errors[spoilt]) > np.median(before[spoilt]) + 1
        assert_close(errors[sound], before[sound], name="errors elsewhere")
        now = trust(run.model, [frames])
        assert np.median(now[spoilt]) < np.median(trusted[spoilt]) - 0.01
        assert_close(now[sound], trusted[sound], name="trust elsewhere")


def test_a_wide_gaussian_on_tissue_without_depth_is_no_stray(clip: DepthClip) -> None:
    run = start(clip)
    run.model.canonical[7:10] = np.log(2 * MAX_UNSEEN_WIDTH)
    unsure = as_given(run, dataclasses.replace(clip, depth_mm=np.zeros_like(clip.depth_mm)))
    assert trust(run.model, [unsure]).any()
    assert drop_strays(run.model, [unsure]) == 0


def test_a_long_clip_is_sampled_evenly() -> None:
    clip = plane_clip(2 * SAMPLED_PICTURES)
    clip.tissue[:] = True
    clip.tissue[: clip.frame_count // 2] = False
    run = prepared(clip, "fast", holdout="none")[0]
    assert np.median(share(run)) == pytest.approx(0.5, abs=0.05)
