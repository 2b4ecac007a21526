"""The report: right figures, and a plain sentence for every way of failing."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest

from intrasplat.clip import FrameSplit, split_frames
from intrasplat.clip.types import DepthClip, Eye
from intrasplat.errors import TrainingDiverged
from intrasplat.notices import Notice, NoticeCode
from intrasplat.quality.baselines import CopyBaselines, copy_baselines
from intrasplat.quality.checks import clip_warnings
from intrasplat.quality.detail import measure_detail
from intrasplat.quality.report import Scores, Training, first_report, measure, score_warnings, scored_report
from intrasplat.quality.right_eye import RightScores, measure_right
from intrasplat.report import RESEARCH_USE, Report
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.train.hooks import RenderedFrame
from intrasplat.train.scoring import sample_frames
from tests.intrasplat.clips import plane_clip


def info(text: str) -> Notice:
    return Notice.info(NoticeCode.UNCLASSIFIED, text)


TRAINING = Training(
    preset="fast",
    eyes="left",
    seed=0,
    device="cpu",
    iterations=500,
    frames_seen=500,
    gaussians=1000,
    bases=9,
    scene_bytes=123_456,
    units_per_mm=0.8,
    seconds={"t_train_s": 12.5, "t_post_s": 20.0},
    versions={"intrasplat": "0"},
    assumptions=(info("depth: of the model"),),
    measurements={"steps_per_s": 40.0},
)


def long_clip() -> DepthClip:
    """A clip whose frames differ by noise that copying cannot know."""
    clip = plane_clip(frames=24)
    noise = np.random.default_rng(5).integers(-15, 16, clip.rgb.shape)
    clip.rgb[:] = np.clip(clip.rgb + noise, 0, 255)
    return dataclasses.replace(clip, assumptions=(info("masks: as given"),), measurements={"vertical_px": 0.2})


def views(clip: DepthClip, noise: float = 0.01) -> Callable[[int], RenderedFrame]:
    """A model that renders the clip itself, with some noise."""

    def render(index: int) -> RenderedFrame:
        random = np.random.default_rng(index)
        rgb = clip.rgb[index] / 255 + random.normal(0, noise, clip.rgb[index].shape)
        return RenderedFrame(rgb.astype(np.float32), clip.depth_mm[index] + 0.5, np.ones_like(clip.depth_mm[index]))

    return render


def test_views_with_detail_are_scored_like_the_model() -> None:
    clip, frames = long_clip(), [3, 11, 19]
    right = Eye(clip.rgb, clip.tissue, clip.depth_mm, clip.depth_confidence, clip.intrinsics, clip.world_from_camera)
    both = dataclasses.replace(clip, right=right)
    detail, model = measure_detail(both, frames, views(clip), views(clip, 0.02)), measure(clip, frames, views(clip))
    assert detail.psnr_tissue_db == pytest.approx(np.mean(model.psnr_tissue_db))
    assert detail.ssim == pytest.approx(np.mean(model.ssim))
    assert detail.psnr_right_db == pytest.approx(np.mean(measure_right(both, frames, views(clip, 0.02)).psnr_db))
    assert measure_detail(clip, frames, views(clip), views(clip)).psnr_right_db is None


def test_detail_that_is_no_number_is_no_score() -> None:
    clip = long_clip()
    with pytest.raises(TrainingDiverged):
        measure_detail(clip, [3], views(clip, math.nan), views(clip))


def report_of(clip: DepthClip, holdout: str = "every8", noise: float = 0.01) -> Report:
    split = split_frames(clip, holdout)
    held_out = measure(clip, split.held_out, views(clip, noise))
    trained = measure(clip, sample_frames(split.train), views(clip, noise))
    first, copies = first_report(clip, split, TRAINING), copy_baselines(clip, split.train, split.held_out)
    return scored_report(first, held_out, RightScores(), trained, copies)


def scores(psnr_db: float = 35.0, *, covered: float = 1.0, depth_agreement_mm: float = 0.5, frames: int = 3) -> Scores:
    same = (psnr_db,) * frames
    return Scores(
        tuple(range(1, 1 + frames)),
        same,
        same,
        same,
        same,
        (0.9,) * frames,
        (covered,) * frames,
        depth_agreement_mm,
        60.0,
    )


BELOW = CopyBaselines((30.0,) * 3, (31.0,) * 3)


def test_a_good_model_of_a_good_clip_warns_of_nothing() -> None:
    clip = long_clip()
    report = report_of(clip)
    assert report.warnings == ()
    assert report.psnr_tissue_db == pytest.approx(40.0, abs=0.3)
    assert report.psnr_paper_db is not None
    assert report.psnr_paper_db > (report.psnr_tissue_db or 0.0)
    assert report.train_psnr_tissue_db == pytest.approx(40.0, abs=0.3)
    assert report.depth_agreement_mm == pytest.approx(0.5, abs=1e-4)
    assert report.coverage == 1.0
    assert report.held_out == (1, 9, 17)
    assert report.train_count == 21
    assert report.notice == RESEARCH_USE
    assert [each.text for each in report.assumptions] == ["masks: as given", "depth: of the model"]
    assert report.measurements == {"vertical_px": 0.2, "steps_per_s": 40.0}
    assert (report.width, report.height, report.frame_count) == (64, 48, 24)
    assert report.seconds == TRAINING.seconds


def test_a_report_without_scores_says_that_they_are_to_come() -> None:
    clip = long_clip()
    first = first_report(clip, split_frames(clip, "every8"), TRAINING)
    assert not first.scored
    assert (first.psnr_tissue_db, first.baseline_flow_db, first.coverage, first.frames) == (None, None, None, ())
    assert [each.code for each in first.warnings] == [NoticeCode.SCORES_PENDING]
    scored = report_of(clip)
    assert scored.scored
    kept = set(Report.model_fields) - {"scored", "warnings", "frames"}
    assert {name for name in kept if getattr(first, name) != getattr(scored, name)} == {
        name
        for name in kept
        if name.startswith(("psnr", "ssim", "baseline", "depth_a", "coverage", "train_psnr"))
        and getattr(scored, name) is not None
    }


def test_means_are_over_frames_and_each_frame_is_listed() -> None:
    clip = long_clip()
    report = report_of(clip)
    assert [each.frame for each in report.frames] == [1, 9, 17]
    expected = [psnr_tissue(views(clip)(index).rgb, clip.rgb[index], clip.tissue[index]) for index in (1, 9, 17)]
    assert [each.psnr_tissue_db for each in report.frames] == expected
    assert report.psnr_tissue_db == pytest.approx(np.mean(expected))
    assert report.baseline_flow_db == pytest.approx(np.mean([each.baseline_flow_db for each in report.frames]))


def test_the_report_survives_json() -> None:
    report = report_of(long_clip())
    assert Report.model_validate_json(report.model_dump_json()) == report


def test_without_held_out_frames_figures_are_null_and_the_reason_is_given() -> None:
    report = report_of(long_clip(), "none")
    for name in ("psnr_tissue_db", "psnr_paper_db", "ssim", "baseline_blend_db", "depth_agreement_mm", "coverage"):
        assert getattr(report, name) is None
    assert any("No frames were held out" in each.text for each in report.warnings)
    assert json.loads(report.model_dump_json())["psnr_tissue_db"] is None


def test_held_out_frames_without_tissue_are_left_out_of_the_means() -> None:
    clip = long_clip()
    clip.tissue[9] = False
    report = report_of(clip)
    assert report.frames[1].psnr_tissue_db is None
    assert report.psnr_tissue_db == pytest.approx(40.0, abs=0.3)
    clip.tissue[[1, 17]] = False
    assert any("show no tissue" in each.text for each in report_of(clip).warnings)


@pytest.mark.parametrize("broken", ["rgb", "depth_mm", "alpha"])
def test_a_view_that_is_not_finite_stops_the_scene(broken: str) -> None:
    clip = long_clip()

    def render(index: int) -> RenderedFrame:
        view = views(clip)(index)
        getattr(view, broken)[3, 3] = np.nan
        return view

    with pytest.raises(TrainingDiverged, match="Frame 9"):
        measure(clip, [9], render)


@pytest.mark.parametrize(
    ("held_out", "trained", "baselines", "said"),
    [
        (scores(29.0), scores(), BELOW, "copying the neighbouring frames scores more: blending at 30.0 dB and warping"),
        (scores(30.5), scores(31.0), BELOW, "scores more: warping (optical flow) at 31.0 dB"),
        (scores(20.0), scores(20.0), BELOW, "only 20.0 dB: do not rely on this scene"),
        (scores(23.2), scores(25.1), BELOW, "Held-out frames are reproduced at only 23.2 dB"),
        (scores(31.5), scores(37.0), BELOW, "score 5.5 dB less than trained ones"),
        (scores(covered=0.9), scores(), BELOW, "10.0% of the tissue uncovered"),
        (scores(depth_agreement_mm=4.0), scores(), BELOW, "differ by 4.0 mm (median) at a depth of 60 mm"),
        (scores(depth_agreement_mm=math.nan), scores(), BELOW, "depth agreement is not measured"),
        (scores(frames=0), scores(covered=0.5), CopyBaselines((), ()), "50.0% of the tissue uncovered"),
        (
            dataclasses.replace(scores(), psnr_tissue_db=(40.0, 25.0, 40.0)),
            scores(),
            BELOW,
            "held-out frames 2 (25.0 dB)",
        ),
    ],
    ids=[
        "blend",
        "flow",
        "failed",
        "failed between",
        "gap",
        "holes",
        "depth",
        "no depth",
        "nothing held out",
        "one frame",
    ],
)
def test_every_failure_is_told(held_out: Scores, trained: Scores, baselines: CopyBaselines, said: str) -> None:
    assert any(said in each.text for each in score_warnings(held_out, trained, baselines))


def test_motion_is_not_blamed_for_light_that_flickers() -> None:
    clip = long_clip()

    def dimmed(index: int) -> RenderedFrame:
        view = views(clip)(index)
        return dataclasses.replace(view, rgb=view.rgb * np.float32(0.6))

    split, trained = split_frames(clip), measure(clip, [10, 18], views(clip))
    dark = measure(clip, split.held_out, dimmed)
    moved = dataclasses.replace(dark, relit_db=(20.0,) * 3)
    flicker = (Notice.warning(NoticeCode.LIGHT_FLICKERS, "It flickers."),)
    blamed = {NoticeCode.HELD_OUT_SCORE_LOW, NoticeCode.GENERALISATION_GAP}
    for held_out, warnings, fires in ((dark, (), True), (dark, flicker, False), (moved, flicker, True)):
        first = first_report(clip, split, dataclasses.replace(TRAINING, warnings=warnings))
        report = scored_report(first, held_out, RightScores(), trained, BELOW)
        assert report.psnr_tissue_db == pytest.approx(np.mean(dark.psnr_tissue_db))
        assert blamed & {each.code for each in report.warnings} == (blamed if fires else set())


def test_good_scores_are_not_complained_about() -> None:
    assert score_warnings(scores(35.0), scores(36.0), BELOW) == []


def _masked_to_a_corner(clip: DepthClip) -> None:
    clip.tissue[:, 10:] = False


def _without_masks(clip: DepthClip) -> None:
    clip.tissue[:] = True


def _without_depth(clip: DepthClip) -> None:
    clip.depth_confidence[:, :, ::2] = 0


def _without_texture(clip: DepthClip) -> None:
    clip.rgb[:] = np.random.default_rng(6).integers(59, 62, clip.rgb.shape)


def _growing_dark(clip: DepthClip) -> None:
    clip.rgb[:] = (clip.rgb * np.linspace(1, 0.6, clip.frame_count)[:, None, None, None]).astype(np.uint8)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (_masked_to_a_corner, "of the field of view counts as tissue"),
        (_without_masks, "No instrument is masked"),
        (_without_depth, "Stereo depth is missing or unsure on 50%"),
        (_without_texture, "has no texture"),
        (_growing_dark, "brightness changes from"),
    ],
    ids=lambda each: each.__name__.strip("_") if callable(each) else None,
)
def test_every_doubt_about_the_clip_is_told(spoil: Callable[[DepthClip], None], said: str) -> None:
    clip = long_clip()
    train = split_frames(clip).train
    assert clip_warnings(clip, train) == []
    spoil(clip)
    found = clip_warnings(clip, train)
    assert len(found) == 1
    assert said in found[0].text


def test_few_frames_are_told() -> None:
    assert "Only 10 frames" in clip_warnings(long_clip(), list(range(10)))[0].text


def test_held_out_frames_do_not_change_what_is_said_of_the_clip() -> None:
    clip = long_clip()
    split = split_frames(clip)
    clip.rgb[split.held_out] = 0
    clip.tissue[split.held_out] = False
    assert clip_warnings(clip, split.train) == []


def test_the_sample_spans_the_training_frames() -> None:
    assert sample_frames([2, 5, 7]) == [2, 5, 7]
    sampled = sample_frames(list(range(0, 200, 2)))
    assert len(sampled) == 8
    assert (sampled[0], sampled[-1]) == (0, 198)


def test_what_the_clip_and_the_split_warned_of_is_repeated_once() -> None:
    clip = dataclasses.replace(long_clip(), warnings=(info("the sound is missing"), info("the sound is missing")))
    split = FrameSplit([0, *range(2, 24)], [1], [], warnings=(info("1 frame repeats"),))
    held_out, trained = (measure(clip, frames, views(clip)) for frames in ([1], sample_frames(split.train)))
    first = first_report(clip, split, TRAINING)
    report = scored_report(first, held_out, RightScores(), trained, copy_baselines(clip, split.train, [1]))
    assert [each.text for each in report.warnings] == ["the sound is missing", "1 frame repeats"]


@pytest.mark.parametrize(
    ("eyes", "iterations", "right_db", "warned"),
    [("both", 39, 29.0, True), ("both", 39, 31.0, False), ("both", 500, 29.0, False), ("left", 39, 29.0, False)],
)
def test_a_model_that_is_worse_than_the_warped_left_eye_for_lack_of_steps_is_told(
    eyes: Literal["left", "both"], iterations: int, right_db: float, warned: bool
) -> None:
    clip = long_clip()
    training = dataclasses.replace(TRAINING, eyes=eyes, iterations=iterations, frames_seen=iterations)
    right = RightScores((right_db,) * 3, (right_db,) * 3, (30.0,) * 3, (30.0,) * 3)
    for known in ((), (Notice.warning(NoticeCode.TIME_TOO_SHORT, "for the fewest steps"),)):
        first = first_report(clip, split_frames(clip, "every8"), dataclasses.replace(training, warnings=known))
        report = scored_report(first, scores(31.0), right, scores(31.0), BELOW)
        codes = [each.code for each in report.warnings if each.code is NoticeCode.TIME_TOO_SHORT]
        assert len(codes) == max(warned, len(known))
