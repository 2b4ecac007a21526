"""Depth of every frame of a rectified clip.

Symbols: T frames, H W pixels of one eye; d disparity, x_left - x_right in px. depth_mm = fx baseline_mm / (d - offset).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.wire.errors import Cancelled, InputError
from contract.wire.notices import Notice, NoticeCode
from contract.wire.options import MAX_DEPTH_MM, MIN_DEPTH_MM
from worker.input.clip.split import spread
from worker.input.clip.types import DepthClip, Eye
from worker.machine.cores import cores
from worker.machine.hooks import Hooks, Progress
from worker.machine.opencv import one_opencv_thread
from worker.stereo.alignment import (
    agreed_disparities,
    choose_range,
    find_features,
    match_features,
    measure_row_shift,
    outside_share,
)
from worker.stereo.matching import MIN_CONFIDENCE, Grey, MatchPlan, match
from worker.stereo.registration import MatchedPair, Registration
from worker.stereo.right_eye import moved_depth, moved_tissue, painted_over

if TYPE_CHECKING:  # matching itself needs no calibration, nor what reads one
    from worker.input.calibration import RectifiedClip

STAGE = "stereo"
COMPILATION = "compile"
"""The stage until the GPU's kernels have run once: the first run may compile them."""
DECODING_SHARE, MEASURING_SHARE = 0.15, 0.05  # of the stage's progress
RANGE_PAIRS, ALIGNMENT_PAIRS = 7, 3
"""Pairs, spread over the measured frames. A pair costs 10 ms for the range and 300 ms for the alignment."""
WARN_OUTSIDE_SHARE = 0.1
WARN_SURE_SHARE = 0.5
SURE, MIN_SURE_SHARE = 128, 0.005
"""Of confidence's 255, and the share of tissue that must have as much: unrelated images have 0.0003 by chance."""
BESIDE_PX = 6
"""Tissue this near to an instrument gets no depth: matching windows reach over the edge and find the instrument."""


def estimate_depth(
    clip: RectifiedClip,
    hooks: Hooks | None = None,
    *,
    measured_frames: Sequence[int] | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    depth_range_mm: tuple[float, float] = (MIN_DEPTH_MM, MAX_DEPTH_MM),
) -> DepthClip:
    """Depth and confidence of every frame. How the eyes differ in turn, rows (up to 8 px) and colour is corrected.

    What the eyes differ by and the disparity range are common to all frames. They are measured on measured_frames alone
    (None: on all); for the rest, a frame's depth depends on its own pair only. So frames outside measured_frames do not
    change the depth of others. On "cuda" another matcher (worker/stereo/cuda, needs triton) matches many pairs at once.

    `measurements` gains vertical_misalignment_px and vertical_residual_px (median |dy| left after the correction),
    min_disparity_px and max_disparity_px (the range searched), depth_valid_share (of tissue pixels) and
    depth_sure_share (those with confidence SURE or more). Nothing outside depth_range_mm is searched or becomes depth.

    Raises:
        ValueError: measured_frames is empty or names a frame that does not exist.
        InputError: there is no depth, the frames are rectified already, the eyes look swapped, or their rows differ by
            more than 8 px.
        Cancelled: hooks.should_stop said so.
    """
    hooks = Hooks() if hooks is None else hooks
    measured = sorted(set(range(clip.frame_count) if measured_frames is None else measured_frames))
    if not measured or measured[0] < 0 or measured[-1] >= clip.frame_count:
        raise ValueError(f"measured_frames {measured} are not some of {clip.frame_count} frames")
    rgb, right_rgb = _decode(clip, hooks)
    if device == "cuda":
        hooks.on_progress(Progress(COMPILATION, 0.0))
    with one_opencv_thread(), _pool() as pool:
        registration, plan, outside = _plan(clip, rgb, right_rgb, measured, pool, device, depth_range_mm)
        middle, never_tissue = measured[len(measured) // 2], np.asarray(~clip.tissue[measured].any(axis=0))
        label = painted_over(rgb[middle], right_rgb[middle], never_tissue)  # as recorded
        registration.recolour(right_rgb)
        if device == "cuda":
            depth_mm, confidence = _match_on_device(clip, rgb, right_rgb, plan, registration, hooks)
        else:
            depth_mm, confidence = _match_all(clip, rgb, right_rgb, plan, registration, pool, hooks)
        right = _right_eye(clip, right_rgb, depth_mm, confidence, registration, label, hooks)
    for tissue, depths_mm, trust in (
        (clip.tissue, depth_mm, confidence),
        (right.tissue, right.depth_mm, right.depth_confidence),
    ):
        _drop_beside_instruments(tissue, depths_mm, trust)
    valid_share, sure_share = (_share_of_tissue(confidence, clip.tissue, least) for least in (1, SURE))
    _check_depth(sure_share)
    return DepthClip(
        rgb=rgb,
        tissue=np.ascontiguousarray(clip.tissue),
        depth_mm=depth_mm,
        depth_confidence=confidence,
        intrinsics=clip.intrinsics,
        world_from_camera=np.tile(np.eye(4), (clip.frame_count, 1, 1)),
        frame_times_s=clip.frame_times_s,
        right=right,
        registration=registration.told,
        assumptions=(*clip.assumptions, _scale_assumption(clip)),
        warnings=clip.warnings
        + registration.notices
        + _warnings(sure_share)
        + _range_warnings(outside, depth_range_mm),
        measurements={
            "vertical_misalignment_px": registration.turn.lower_px,
            "vertical_residual_px": registration.residual_px,
            "vertical_matches": float(registration.matches),
            "min_disparity_px": plan.min_disparity_px,
            "max_disparity_px": plan.max_disparity_px,
            "depth_valid_share": valid_share,
            "depth_sure_share": sure_share,
        },
    )


def _decode(clip: RectifiedClip, hooks: Hooks) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Left and right frames [T, H, W, 3], from one pass over the source."""
    shape = (clip.frame_count, clip.intrinsics.height, clip.intrinsics.width, 3)
    rgb, right = (np.empty(shape, np.uint8) for _ in range(2))
    decoded = 0
    for i, (left_frame, right_frame) in enumerate(clip.pairs()):
        if i >= clip.frame_count:
            break
        _check_stop(hooks)
        rgb[i], right[i] = left_frame, right_frame
        decoded = i + 1
        hooks.on_progress(Progress(STAGE, DECODING_SHARE * decoded / clip.frame_count))
    if decoded < clip.frame_count:
        raise InputError("clip", f"it ended after {decoded} of {clip.frame_count} frames.", "Give the whole recording.")
    return rgb, right


def _plan(
    clip: RectifiedClip,
    rgb: NDArray[np.uint8],
    right: NDArray[np.uint8],
    measured: Sequence[int],
    pool: ThreadPoolExecutor,
    device: str,
    depth_range_mm: tuple[float, float],
) -> tuple[Registration, MatchPlan, float]:
    """How the eyes differ, and the disparity range, from a few pairs spread over the measured frames; outside_share."""
    aligned = spread(measured, ALIGNMENT_PAIRS)
    features = list(pool.map(find_features, [_grey(eye[index]) for index in aligned for eye in (rgb, right)]))
    matches = np.concatenate(list(pool.map(match_features, features[::2], features[1::2])))
    shift = measure_row_shift(matches, clip.disparity_offset_px, clip.equal_rows_px)
    agreed = agreed_disparities
    if device == "cuda":
        from worker.stereo.cuda import agreed_disparities as agreed
    focal_baseline = clip.intrinsics.fx * clip.baseline_mm
    outside = outside_share(matches, shift, clip.disparity_offset_px, focal_baseline, depth_range_mm)
    calibrated = replace(clip.intrinsics, cx=clip.intrinsics.cx - clip.disparity_offset_px)
    coarse = Registration.of_matches(matches, shift, calibrated, clip.baseline_mm)
    pairs = [(_grey(rgb[index]), coarse.rectified(_grey(right[index]))) for index in spread(measured, RANGE_PAIRS)]
    plan = MatchPlan(
        *choose_range(pairs, clip.disparity_offset_px, focal_baseline, depth_range_mm, agreed), depth_range_mm
    )
    found = pool.map(lambda i: MatchedPair.of(rgb[i], coarse.rectified(right[i]), clip.tissue[i], plan), aligned)
    return coarse.refined(list(found), matches), plan, outside


def _match_all(
    clip: RectifiedClip,
    rgb: NDArray[np.uint8],
    right: NDArray[np.uint8],
    plan: MatchPlan,
    registration: Registration,
    pool: ThreadPoolExecutor,
    hooks: Hooks,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth in mm and confidence [T, H, W] of all pairs, matched in parallel."""
    focal_baseline = clip.intrinsics.fx * clip.baseline_mm
    depth_mm = np.zeros(right.shape[:3], np.float32)
    confidence = np.zeros(right.shape[:3], np.uint8)

    def work(i: int) -> None:
        grey = registration.rectified(_grey(right[i]))
        disparity, trust = match(_grey(rgb[i]), grey, plan, clip.tissue[i])
        beyond_infinity_px = disparity - np.float32(clip.disparity_offset_px)
        depth_mm[i], confidence[i] = _to_depth(beyond_infinity_px, trust, focal_baseline, plan.depth_range_mm)

    share = 1 - DECODING_SHARE - MEASURING_SHARE
    jobs = [pool.submit(work, i) for i in range(clip.frame_count)]
    try:
        for left_over, job in zip(reversed(range(len(jobs))), jobs, strict=True):
            _check_stop(hooks)
            job.result()
            hooks.on_progress(Progress(STAGE, 1 - share * left_over / len(jobs)))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return depth_mm, confidence


def _match_on_device(
    clip: RectifiedClip,
    rgb: NDArray[np.uint8],
    right: NDArray[np.uint8],
    plan: MatchPlan,
    registration: Registration,
    hooks: Hooks,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """As _match_all, with as many pairs at once as their cost volumes fit into memory."""
    from worker.stereo.cuda import depth_of, frames_at_once

    depth_mm = np.empty(right.shape[:3], np.float32)
    confidence = np.empty(right.shape[:3], np.uint8)
    at_once = frames_at_once(clip.intrinsics.height, clip.intrinsics.width, plan)
    focal_baseline = clip.intrinsics.fx * clip.baseline_mm
    hooks.on_progress(Progress(COMPILATION, 0.5))
    for first in range(0, len(right), at_once):
        _check_stop(hooks)
        some = slice(first, first + at_once)
        left = np.stack([_grey(frame) for frame in rgb[some]])
        other = np.stack([registration.rectified(_grey(frame)) for frame in right[some]])
        tissue = np.ascontiguousarray(clip.tissue[some])
        depth_mm[some], confidence[some] = depth_of(left, other, tissue, plan, focal_baseline, clip.disparity_offset_px)
        left_over = max(len(right) - first - at_once, 0) / len(right)
        hooks.on_progress(Progress(STAGE, 1 - (1 - DECODING_SHARE - MEASURING_SHARE) * left_over))
    return depth_mm, confidence


def _right_eye(
    clip: RectifiedClip,
    right_rgb: NDArray[np.uint8],
    depth_mm: NDArray[np.float32],
    confidence: NDArray[np.uint8],
    registration: Registration,
    label: NDArray[np.bool_],
    hooks: Hooks,
) -> Eye:
    """The right eye with the left one's depth. It lies on the calibrated baseline, turned as it was measured.

    label: pixels [H, W] that show a label in both eyes.
    """
    focal_baseline, offset_px = clip.intrinsics.fx * clip.baseline_mm, clip.disparity_offset_px
    there_mm, trust = np.empty_like(depth_mm), np.empty_like(confidence)
    tissue = np.ones(depth_mm.shape, np.bool_) if clip.tissue_right is None else clip.tissue_right

    def work(i: int) -> None:
        moved_mm, moved_trust = moved_depth(depth_mm[i], confidence[i], focal_baseline, offset_px)
        there_mm[i], trust[i] = registration.recorded_depth(moved_mm), registration.recorded(moved_trust)
        if clip.tissue_right is None:
            shown = moved_tissue(clip.tissue[i] | label, depth_mm[i], focal_baseline, offset_px)
            tissue[i] = (registration.recorded((~shown).astype(np.uint8)) == 0) & ~label

    with _pool() as pool:
        try:
            for _ in pool.map(work, range(clip.frame_count)):
                _check_stop(hooks)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    return Eye(
        rgb=right_rgb,
        tissue=tissue,
        depth_mm=there_mm,
        depth_confidence=trust,
        intrinsics=registration.camera,
        world_from_camera=np.tile(registration.left_from_right, (clip.frame_count, 1, 1)),
    )


def _to_depth(
    beyond_infinity_px: NDArray[np.float32],
    confidence: NDArray[np.uint8],
    focal_baseline: float,
    depth_range_mm: tuple[float, float],
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth in mm and confidence; both are 0 at invalid pixels."""
    nearest_mm, farthest_mm = depth_range_mm
    valid = confidence >= MIN_CONFIDENCE
    valid &= (beyond_infinity_px >= focal_baseline / farthest_mm) & (beyond_infinity_px <= focal_baseline / nearest_mm)
    depth_mm = np.where(valid, focal_baseline / np.where(valid, beyond_infinity_px, 1.0), 0.0)
    return depth_mm.astype(np.float32), np.where(valid, confidence, 0).astype(np.uint8)


def _drop_beside_instruments(
    tissue: NDArray[np.bool_], depth_mm: NDArray[np.float32], confidence: NDArray[np.uint8]
) -> None:
    """Set depth and confidence [T, H, W] of the tissue within BESIDE_PX of what is not tissue to 0, in place."""
    side = 2 * BESIDE_PX + 1
    for i, shown in enumerate(tissue):
        if not shown.all():
            beside = shown & (cv2.dilate((~shown).astype(np.uint8), np.ones((side, side), np.uint8)) > 0)
            depth_mm[i][beside], confidence[i][beside] = 0, 0


def _share_of_tissue(confidence: NDArray[np.uint8], tissue: NDArray[np.bool_], least: int) -> float:
    """Share of tissue pixels with a confidence of at least so much."""
    found = sum(int(np.count_nonzero(each[mask] >= least)) for each, mask in zip(confidence, tissue, strict=True))
    return found / max(int(np.count_nonzero(tissue)), 1)


def _check_depth(sure_share: float) -> None:
    """Refuse a clip whose share of tissue with sure depth is below MIN_SURE_SHARE."""
    if sure_share < MIN_SURE_SHARE:
        raise InputError(
            "clip",
            f"{sure_share:.1%} of tissue pixels have a depth to rely on, as good as none.",
            "Check focus, that left and right belong together, and that the calibration and masks fit the frames.",
        )


def _range_warnings(outside: float, depth_range_mm: tuple[float, float]) -> tuple[Notice, ...]:
    if outside < WARN_OUTSIDE_SHARE:
        return ()
    text = (
        f"{outside:.0%} of matching features are nearer than {depth_range_mm[0]:g} mm or farther than "
        f"{depth_range_mm[1]:g} mm and get no depth: give min_depth_mm or max_depth_mm, or check the calibration"
    )
    return (Notice.warning(NoticeCode.DEPTH_OUT_OF_RANGE, text),)


def _warnings(sure_share: float) -> tuple[Notice, ...]:
    if sure_share >= WARN_SURE_SHARE:
        return ()
    text = f"only {sure_share:.0%} of tissue has stereo depth to rely on"
    return (Notice.warning(NoticeCode.LITTLE_STEREO_DEPTH, text),)


def _scale_assumption(clip: RectifiedClip) -> Notice:
    """The assumption about the baseline: a wrong one scales every distance, and no picture shows it."""
    text = f"scale: the calibration's baseline of {clip.baseline_mm:.4g} mm; every distance is as right as it is"
    return Notice.info(NoticeCode.BASELINE, text)


def _check_stop(hooks: Hooks) -> None:
    if hooks.should_stop():
        raise Cancelled("stopped while estimating depth")


def _grey(rgb: NDArray[np.uint8]) -> Grey:
    grey: Grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return grey


def _pool() -> ThreadPoolExecutor:
    """One thread per core, one pair per thread: OpenCV releases the GIL, and two threads for one pair are slower."""
    return ThreadPoolExecutor(cores(), thread_name_prefix=STAGE)
