"""The right eye as a judge: what it sees, what it leaves out, and what warping the left eye scores."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from intrasplat.clip import DepthClip, Eye
from intrasplat.errors import TrainingDiverged
from intrasplat.notices import NoticeCode
from intrasplat.quality.report import Scores, right_eye_warnings
from intrasplat.quality.right_eye import RightScores, measure_right, warped_left
from intrasplat.splat.metrics import clear_of_highlights
from intrasplat.train.hooks import RenderedFrame
from intrasplat.train.scoring import judged_pixels
from tests.intrasplat.clips import HEIGHT, WIDTH, plane_clip

SHIFT_PX, DEPTH_MM = 4, 60.0


def two_eyed() -> DepthClip:
    """A wall at 60 mm that both eyes see, the right one SHIFT_PX farther left; the last columns only the right one."""
    clip = plane_clip(frames=3)
    k = clip.intrinsics
    pose = np.tile(np.eye(4), (3, 1, 1))
    pose[:, 0, 3] = SHIFT_PX * DEPTH_MM / k.fx
    rgb = np.roll(clip.rgb, -SHIFT_PX, axis=2)
    depth_mm = np.full(clip.depth_mm.shape, DEPTH_MM, np.float32)
    there_mm = depth_mm.copy()
    there_mm[:, :, WIDTH - SHIFT_PX :] = 0
    tissue = np.ones(clip.tissue.shape, np.bool_)
    right = Eye(rgb, tissue, there_mm, np.full(tissue.shape, 255, np.uint8), k, pose)
    return dataclasses.replace(clip, tissue=tissue, depth_mm=depth_mm, right=right)


def rendered(rgb: np.ndarray) -> RenderedFrame:
    unit = rgb.astype(np.float32) / 255
    return RenderedFrame(unit, np.ones(unit.shape[:2], np.float32), np.ones(unit.shape[:2], np.float32))


def test_only_what_the_left_eye_sees_too_is_judged() -> None:
    clip = two_eyed()
    assert clip.right is not None
    assert judged_pixels(clip.right, 0)[:, : WIDTH - SHIFT_PX].all()
    assert not judged_pixels(clip.right, 0)[:, WIDTH - SHIFT_PX + 1 :].any()
    clip.right.depth_mm[0, 20, 20] = 0  # where stereo failed, the left eye sees all the same
    assert judged_pixels(clip.right, 0)[20, 20]
    clip.right.tissue[0, 30, 30] = False
    assert not judged_pixels(clip.right, 0)[30, 30]


def test_warping_the_left_eye_shows_what_the_right_eye_sees() -> None:
    clip = two_eyed()
    assert clip.right is not None
    inside = np.s_[:, : WIDTH - SHIFT_PX]
    np.testing.assert_array_equal(warped_left(clip, 0)[inside], clip.right.rgb[0][inside])


def test_a_model_is_scored_from_the_right_eyes_own_pictures() -> None:
    clip = two_eyed()
    right = clip.right
    assert right is not None
    scores = measure_right(clip, [0, 2], lambda index: rendered(right.rgb[index] // 2))
    assert len(scores.psnr_db) == len(scores.warp_db) == 2
    assert all(model < warp for model, warp in zip(scores.psnr_db, scores.warp_db, strict=True))


def test_a_clip_of_one_eye_has_no_right_scores() -> None:
    assert measure_right(plane_clip(frames=3), [0], lambda index: pytest.fail("nothing to render")) == RightScores()


def test_a_render_that_is_not_finite_is_no_score() -> None:
    broken = RenderedFrame(np.full((HEIGHT, WIDTH, 3), np.nan, np.float32), *np.ones((2, HEIGHT, WIDTH), np.float32))
    with pytest.raises(TrainingDiverged, match="right eye"):
        measure_right(two_eyed(), [0], lambda index: broken)


def test_highlights_of_either_picture_are_left_out_with_their_surroundings() -> None:
    shown, truth = (np.full((HEIGHT, WIDTH, 3), 0.3, np.float32) for _ in range(2))
    shown[10, 10] = truth[30, 40] = 0.9
    truth[20, 20, 0] = 1.0  # red tissue is no highlight
    clear = clear_of_highlights(shown, truth)
    assert not clear[7:14, 7:14].any()
    assert not clear[27:34, 37:44].any()
    assert clear[20, 20]
    assert (~clear).sum() == 2 * 49


@pytest.mark.parametrize(("right_db", "warned"), [(33.0, False), (30.0, True)])
def test_a_right_eye_far_below_the_left_is_told(right_db: float, warned: bool) -> None:
    same = (35.0, 35.0)
    held_out = Scores((1, 9), same, same, same, same, (0.9,) * 2, (1.0,) * 2, 0.5, 60.0)
    found = right_eye_warnings(held_out, RightScores((right_db,) * 2, same, same, same))
    assert [each.code for each in found] == [NoticeCode.RIGHT_EYE_LOW] * warned
