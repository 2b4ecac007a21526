"""The quality report: held-out scores, copy baselines, and warnings about whatever looks wrong.

Symbols: T frames, H W pixels. No scene may fail silently: every doubt becomes a warning in the report, and a number
that is not finite is never published.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import FrameSplit
from intrasplat.clip.types import DepthClip
from intrasplat.errors import TrainingDiverged
from intrasplat.names import Eyes
from intrasplat.notices import Notice, NoticeCode
from intrasplat.quality.baselines import CopyBaselines
from intrasplat.quality.right_eye import RightScores, too_few_steps
from intrasplat.report import DetailScores, FrameScore, LightChanges, Report
from intrasplat.splat.metrics import (
    clear_of_highlights,
    coverage,
    depth_agreement_mm,
    depth_errors_mm,
    psnr_paper,
    psnr_tissue,
    relit,
    ssim,
)
from intrasplat.train.scoring import FrameRenderer, Mapping

MIN_COVERAGE = 0.98
MIN_TRAIN_DB = 25.0
"""A model that scores less on its training frames has not learnt them; good models reach 30 to 38."""
MIN_HELD_OUT_DB = 24.0
"""An error of 6 % of white: clean clips reach 25 within a hundred iterations, clips with cuts or jumps stay below."""
MAX_GAP_DB = 3.0
"""Gap between training and held-out frames; beyond it the model memorised frames, or cannot interpolate them."""
MAX_RIGHT_GAP_DB = 4.0
"""Gap between the left eye and the right eye, which views the tissue from some degrees beside it."""
OUTLIER_DB = 6.0
"""A warning names held-out frames this far below the mean."""
MAX_DEPTH_SHARE = 0.03
"""Share of the depth; beyond it model and stereo disagree by more than the stereo's own noise."""


@dataclass(frozen=True)
class Scores:
    """Scores of some frames. A list has one number per frame, NaN for a frame without tissue.

    relit_db: psnr_tissue_db of renders that are as bright as the frames.
    depth_mm: the stereo's median depth where it was compared with the model's (depth_agreement_mm); both may be NaN.
    """

    frames: tuple[int, ...]
    psnr_tissue_db: tuple[float, ...]
    relit_db: tuple[float, ...]
    psnr_clear_db: tuple[float, ...]
    psnr_paper_db: tuple[float, ...]
    ssim: tuple[float, ...]
    coverage: tuple[float, ...]
    depth_agreement_mm: float
    depth_mm: float


@dataclass(frozen=True)
class Training:
    """What the pipeline knows about a run and the report repeats; intrasplat.report.Report explains the fields."""

    preset: str
    eyes: Eyes
    seed: int
    device: str
    iterations: int
    frames_seen: int
    gaussians: int
    bases: int
    scene_bytes: int
    units_per_mm: float
    seconds: dict[str, float]
    versions: dict[str, str]
    light: LightChanges | None = None
    assumptions: tuple[Notice, ...] = ()
    warnings: tuple[Notice, ...] = ()
    measurements: dict[str, float] = field(default_factory=dict)


SCORES_PENDING = Notice.info(
    NoticeCode.SCORES_PENDING, "The scores are still being measured: ask for the report again in some seconds."
)
_MERGED_FIELDS = ("assumptions", "warnings", "measurements")  # the clip has them, too; the report joins both


Errors = NDArray[np.float32]
NOTHING: Errors = np.zeros(0, np.float32)


def measure(
    clip: DepthClip, frames: Sequence[int], render: FrameRenderer, mapping: Mapping = map, *, compared: bool = True
) -> Scores:
    """Score the renders of these frames (clip indices) against the clip; `mapping` may use several threads.

    compared: compute the scores that compare one scene with another, too; else all but psnr_tissue_db are NaN.

    Raises:
        TrainingDiverged: a render contains NaN or infinity.
    """

    def score(index: int) -> tuple[tuple[float, ...], Errors, Errors]:
        shown, truth, tissue = render(index), clip.rgb[index], clip.tissue[index]
        if not (np.isfinite(shown.rgb).all() and np.isfinite(shown.depth_mm).all() and np.isfinite(shown.alpha).all()):
            raise TrainingDiverged(f"Frame {index} renders as NaN or infinity: training has diverged.")
        tissue_db = psnr_tissue(shown.rgb, truth, tissue)
        if not compared:
            clip.let_go(index)
            return (tissue_db, *(math.nan,) * 5), NOTHING, NOTHING
        relit_db = psnr_tissue(relit(shown.rgb, truth, tissue), truth, tissue)
        clear_db = psnr_tissue(shown.rgb, truth, tissue & clear_of_highlights(shown.rgb, truth))
        paper_db, similarity = psnr_paper(shown.rgb, truth, tissue), ssim(shown.rgb, truth, tissue)
        figures = (tissue_db, relit_db, clear_db, paper_db, similarity, coverage(shown.alpha, tissue))
        depth_mm = clip.depth_mm[index]
        found = figures, depth_errors_mm(shown.depth_mm, depth_mm, tissue), depth_mm[tissue & (depth_mm > 0)]
        clip.let_go(index)
        return found

    found = list(mapping(score, frames))
    figures, errors_mm, depths_mm = zip(*found, strict=True) if found else ((), (), ())
    tissue_db, relit_db, clear_db, paper_db, similarity, covered = zip(*figures, strict=True) if figures else ((),) * 6
    return Scores(
        frames=tuple(frames),
        psnr_tissue_db=tissue_db,
        relit_db=relit_db,
        psnr_clear_db=clear_db,
        psnr_paper_db=paper_db,
        ssim=similarity,
        coverage=covered,
        depth_agreement_mm=depth_agreement_mm(list(errors_mm)),
        depth_mm=depth_agreement_mm(list(depths_mm)),
    )


REMOVED: dict[NoticeCode, frozenset[NoticeCode]] = {
    NoticeCode.EXPOSURE: frozenset({NoticeCode.BRIGHTNESS_CHANGES, NoticeCode.COLOUR_CHANGES}),
    NoticeCode.SMOKE: frozenset({NoticeCode.VEILED, NoticeCode.BRIGHTNESS_CHANGES, NoticeCode.COLOUR_CHANGES}),
}
"""Warnings about a clip's pictures that do not hold once training has removed their cause, by its notice."""


def first_report(clip: DepthClip, split: FrameSplit, training: Training, warnings: Sequence[Notice] = ()) -> Report:
    """The report of a finished scene before it is scored. warnings: the result of clip_warnings()."""
    removed = {code for notice in training.assumptions for code in REMOVED.get(notice.code, ())}
    of_clip = (each for each in warnings if each.code not in removed)
    found = [*clip.warnings, *split.warnings, *training.warnings, *of_clip, SCORES_PENDING]
    return Report(
        scored=False,
        psnr_tissue_db=None,
        psnr_paper_db=None,
        ssim=None,
        baseline_blend_db=None,
        baseline_flow_db=None,
        depth_agreement_mm=None,
        coverage=None,
        train_psnr_tissue_db=None,
        warnings=tuple(dict.fromkeys(found)),
        assumptions=tuple(dict.fromkeys((*clip.assumptions, *training.assumptions))),
        right_eye=clip.registration,
        masks=clip.masks,
        field_of_view=clip.fov,
        poses=clip.poses,
        measurements={**clip.measurements, **training.measurements},
        **{name: value for name, value in vars(training).items() if name not in _MERGED_FIELDS},
        width=clip.intrinsics.width,
        height=clip.intrinsics.height,
        frame_count=clip.frame_count,
        train_count=len(split.train),
        held_out=tuple(split.held_out),
        repeated=tuple(split.repeated),
        frame_times_s=tuple(clip.frame_times_s.tolist()),
    )


def scored_report(
    first: Report,
    held_out: Scores,
    right: RightScores,
    trained: Scores,
    baselines: CopyBaselines,
    detail: DetailScores | None = None,
) -> Report:
    """The report with its scores.

    Args:
        first: first_report() of the scene.
        held_out: measure(clip, first.held_out, ...); without frames if none was held out.
        right: measure_right(clip, first.held_out, ...).
        trained: measure(clip, sample_frames(train), ...), for the comparison.
        baselines: copy_baselines(clip, train, first.held_out).
        detail: measure_detail(clip, first.held_out, ...), of views with detail from recorded frames.
    """
    known = [each for each in first.warnings if each.code is not NoticeCode.SCORES_PENDING]
    shown_db = None if detail is None else detail.psnr_tissue_db
    flickers = any(each.code is NoticeCode.LIGHT_FLICKERS for each in known)
    found = score_warnings(held_out, trained, baselines, shown_db, flickers=flickers)
    found += right_eye_warnings(held_out, right)
    found += too_few_steps(first, _mean(right.psnr_db), _mean(right.warp_db))
    scores = {
        "psnr_tissue_db": _mean(held_out.psnr_tissue_db),
        "psnr_clear_db": _mean(held_out.psnr_clear_db),
        "psnr_right_db": _mean(right.psnr_db),
        "psnr_right_clear_db": _mean(right.clear_db),
        "baseline_warp_db": _mean(right.warp_db),
        "baseline_warp_clear_db": _mean(right.warp_clear_db),
        "psnr_paper_db": _mean(held_out.psnr_paper_db),
        "ssim": _mean(held_out.ssim),
        "detail": detail,
        "baseline_blend_db": _mean(baselines.blend_db),
        "baseline_flow_db": _mean(baselines.flow_db),
        "depth_agreement_mm": _known(held_out.depth_agreement_mm),
        "coverage": _mean(held_out.coverage),
        "train_psnr_tissue_db": _mean(trained.psnr_tissue_db),
        "frames": _frame_scores(held_out, right, baselines),
    }
    return first.model_copy(update={**scores, "scored": True, "warnings": tuple(dict.fromkeys([*known, *found]))})


def detail_scores(tissue_db: Sequence[float], right_db: Sequence[float], ssim: Sequence[float]) -> DetailScores:
    """The report's scores of views with detail, from those of each frame."""
    return DetailScores(psnr_tissue_db=_mean(tissue_db), psnr_right_db=_mean(right_db), ssim=_mean(ssim))


def score_warnings(
    held_out: Scores,
    trained: Scores,
    baselines: CopyBaselines,
    detail_db: float | None = None,
    *,
    flickers: bool = False,
) -> list[Notice]:
    """Warnings about the model that follow from its scores, and reasons for missing scores.

    Args:
        detail_db: psnr_tissue_db with detail from recorded frames; None: there is none.
        flickers: whether light alone may make a held-out frame score less; the motion is judged without it then.
    """
    model_db = _mean(held_out.psnr_tissue_db)
    found = _missing(held_out, model_db)
    found += _worse_than_copying(model_db if detail_db is None else detail_db, baselines)
    if flickers:
        held_out = replace(held_out, psnr_tissue_db=held_out.relit_db)
    model_db = _mean(held_out.psnr_tissue_db)
    train_db = _mean(trained.psnr_tissue_db)
    if train_db is not None and train_db < MIN_TRAIN_DB:
        found.append(
            Notice.warning(
                NoticeCode.TRAINING_SCORE_LOW,
                f"Even frames it was trained on are reproduced at only {train_db:.1f} dB: do not rely on this scene. "
                "Look for inverted masks, a wrong layout or calibration, or a clip in which everything moves.",
            )
        )
    elif model_db is not None and model_db < MIN_HELD_OUT_DB:
        found.append(
            Notice.warning(
                NoticeCode.HELD_OUT_SCORE_LOW,
                f"Held-out frames are reproduced at only {model_db:.1f} dB: do not rely on this scene between the "
                "trained frames. Tissue that is cut, or moves far from one frame to the next, cannot be followed.",
            )
        )
    if model_db is not None and train_db is not None and train_db - model_db > MAX_GAP_DB:
        found.append(
            Notice.warning(
                NoticeCode.GENERALISATION_GAP,
                f"Held-out frames score {train_db - model_db:.1f} dB less than trained ones ({model_db:.1f} and "
                f"{train_db:.1f} dB): between the trained frames the motion is not to be trusted.",
            )
        )
    found += _bad_frames(held_out, model_db)
    judged = held_out if held_out.frames else trained
    covered = _mean(judged.coverage)
    if covered is not None and covered < MIN_COVERAGE:
        found.append(
            Notice.warning(
                NoticeCode.HOLES,
                f"The model leaves {1 - covered:.1%} of the tissue uncovered: renders have holes there.",
            )
        )
    if judged.depth_agreement_mm > MAX_DEPTH_SHARE * judged.depth_mm:
        found.append(
            Notice.warning(
                NoticeCode.DEPTH_DISAGREES,
                f"Rendered and stereo depth differ by {judged.depth_agreement_mm:.1f} mm (median) at a depth of "
                f"{judged.depth_mm:.0f} mm: distances in this scene are not to be trusted.",
            )
        )
    return found


def right_eye_warnings(held_out: Scores, right: RightScores) -> list[Notice]:
    """Warnings about views from beside the left eye that follow from the right eye's scores."""
    left_db, right_db = _mean(held_out.psnr_tissue_db), _mean(right.psnr_db)
    if left_db is None or right_db is None or left_db - right_db <= MAX_RIGHT_GAP_DB:
        return []
    return [
        Notice.warning(
            NoticeCode.RIGHT_EYE_LOW,
            f"Held-out frames of the right eye score {right_db:.1f} dB, {left_db - right_db:.1f} dB less than those of "
            "the left eye: views from other places are less true than the endoscope's own.",
        )
    ]


def _missing(held_out: Scores, model_db: float | None) -> list[Notice]:
    if not held_out.frames:
        return [
            Notice.warning(
                NoticeCode.NOTHING_HELD_OUT,
                "No frames were held out, so the quality between trained frames, where it matters, is not measured.",
            )
        ]
    if model_db is None:
        return [
            Notice.warning(
                NoticeCode.HELD_OUT_WITHOUT_TISSUE, "The held-out frames show no tissue, so quality is not measured."
            )
        ]
    if math.isnan(held_out.depth_agreement_mm):
        return [
            Notice.warning(
                NoticeCode.DEPTH_NOT_COMPARED,
                "No held-out tissue has both rendered and stereo depth, so depth agreement is not measured.",
            )
        ]
    return []


def _worse_than_copying(model_db: float | None, baselines: CopyBaselines) -> list[Notice]:
    """Warn if copying frames would have scored better: then the model is useful only at other poses and times."""
    copies = {"blending": _mean(baselines.blend_db), "warping (optical flow)": _mean(baselines.flow_db)}
    better = {name: score for name, score in copies.items() if score is not None and model_db is not None}
    better = {name: score for name, score in better.items() if score > (model_db or 0.0)}
    if not better:
        return []
    named = " and ".join(f"{name} at {score:.1f} dB" for name, score in better.items())
    return [
        Notice.info(
            NoticeCode.COPYING_SCORES_MORE,
            f"On held-out frames the model scores {model_db:.1f} dB; copying the neighbouring frames scores more: "
            f"{named}. Seen from the endoscope itself, the recorded frames are the better picture; the model adds "
            "other views, depth and what the instrument hides.",
        )
    ]


def _bad_frames(held_out: Scores, model_db: float | None) -> list[Notice]:
    if model_db is None:
        return []
    scores = zip(held_out.frames, held_out.psnr_tissue_db, strict=True)
    bad = [f"{frame} ({score:.1f} dB)" for frame, score in scores if score < model_db - OUTLIER_DB]
    return (
        [Notice.warning(NoticeCode.OUTLIER_FRAMES, f"Far below the others are held-out frames {', '.join(bad)}.")]
        if bad
        else []
    )


def _frame_scores(scores: Scores, right: RightScores, baselines: CopyBaselines) -> tuple[FrameScore, ...]:
    columns = {
        "psnr_tissue_db": scores.psnr_tissue_db,
        **({"psnr_right_db": right.psnr_db} if right.psnr_db else {}),
        "psnr_paper_db": scores.psnr_paper_db,
        "ssim": scores.ssim,
        "coverage": scores.coverage,
        "baseline_blend_db": baselines.blend_db,
        "baseline_flow_db": baselines.flow_db,
    }
    return tuple(
        FrameScore.model_validate({"frame": frame} | {name: _known(each[row]) for name, each in columns.items()})
        for row, frame in enumerate(scores.frames)
    )


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _mean(values: Sequence[float]) -> float | None:
    """The mean of the known values; None if there is none."""
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else None
