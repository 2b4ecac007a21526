"""Copying: what it does in simple cases, what it may read, and what it scores on the recorded clip."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import open_clip, split_frames
from intrasplat.clip.types import DepthClip
from intrasplat.quality.baselines import copy_baselines
from intrasplat.splat.metrics import BEST_PSNR_DB, psnr_tissue
from tests.intrasplat.clips import plane_clip

RECORDED = Path(os.environ.get("INTRASPLAT_DATA", "../shared/data")) / "d4d_endonerf"


def sliding_clip(px_a_frame: int, frames: int = 5) -> DepthClip:
    """A smooth pattern that slides to the right."""
    clip = plane_clip(frames)
    rows, columns = np.indices(clip.tissue.shape[1:])
    for index in range(frames):
        shifted = columns - px_a_frame * index
        grey = 128 + 50 * np.sin(shifted / 3) + 50 * np.sin(rows / 4 + shifted / 7)
        clip.rgb[index] = grey[..., None].astype(np.uint8)
    clip.tissue[:] = True
    return clip


def test_the_blend_is_weighted_by_time() -> None:
    clip = plane_clip(frames=5)
    clip.tissue[:] = True
    clip.rgb[0], clip.rgb[4], clip.rgb[1] = 100, 200, 125
    assert copy_baselines(clip, [0, 4], [1]).blend_db == (BEST_PSNR_DB,)


def test_a_pixel_hidden_in_one_neighbour_comes_from_the_other() -> None:
    clip = plane_clip(frames=3)
    clip.tissue[:] = True
    clip.rgb[:] = 90
    clip.tissue[0, :, :20] = False
    clip.rgb[0, :, :20] = 255
    assert copy_baselines(clip, [0, 2], [1]).blend_db == (BEST_PSNR_DB,)


def test_outside_the_training_span_the_nearest_frame_is_copied() -> None:
    clip = plane_clip(frames=4)
    scores = copy_baselines(clip, [1, 2], [0, 3])
    expected = tuple(
        psnr_tissue(clip.rgb[source], clip.rgb[index], clip.tissue[index]) for source, index in ((1, 0), (2, 3))
    )
    assert scores.blend_db == scores.flow_db == expected


def test_flow_follows_a_shift_that_blending_blurs() -> None:
    scores = copy_baselines(sliding_clip(3), [0, 2, 4], [1, 3])
    assert min(scores.flow_db) > max(scores.blend_db) + 10


def test_other_held_out_frames_are_never_copied() -> None:
    clip, poisoned = sliding_clip(2, frames=6), sliding_clip(2, frames=6)
    poisoned.rgb[3] = 0
    poisoned.tissue[3] = False
    first, second = (copy_baselines(each, [0, 1, 4, 5], [2]) for each in (clip, poisoned))
    assert first == second


def test_frames_too_small_for_flow_are_still_scored() -> None:
    clip = sliding_clip(1)
    tiny = DepthClip(**vars(clip) | {"rgb": clip.rgb[:, :8, :8].copy(), "tissue": clip.tissue[:, :8, :8].copy()})
    scores = copy_baselines(tiny, [0, 2], [1])
    assert scores.blend_db == scores.flow_db


def test_nothing_to_copy_from_is_said() -> None:
    with pytest.raises(ValueError, match="1 held-out frames have no training frame"):
        copy_baselines(plane_clip(3), [], [1])
    assert copy_baselines(plane_clip(3), [0, 1, 2], []).blend_db == ()


@pytest.mark.skipif(not RECORDED.is_dir(), reason="needs the recorded clip: set INTRASPLAT_DATA")
def test_on_the_recorded_clip_copying_scores_what_the_conventions_page_warns_of() -> None:
    clip = open_clip(RECORDED)
    assert isinstance(clip, DepthClip)
    means = {}
    for rule in ("every8", "blocks8"):
        split = split_frames(clip, rule)
        scores = copy_baselines(clip, split.train, split.held_out)
        means[rule] = (np.mean(scores.blend_db), np.mean(scores.flow_db))
    assert means["every8"] == pytest.approx((40.2, 41.9), abs=0.15)
    assert means["blocks8"] == pytest.approx((32.3, 33.5), abs=0.15)
