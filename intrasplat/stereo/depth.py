"""Depth of every frame of a rectified clip.

Symbols: T frames, H W pixels of one eye; d disparity, x_left - x_right in px. depth_mm = fx baseline_mm / (d - offset).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.features import Features, find_features
from intrasplat.clip.field_of_view import Fields, Mask
from intrasplat.clip.sampling import SkippedFrames, Thumbnail, skippable_frames, thumbnail
from intrasplat.clip.shown import find_shown
from intrasplat.clip.splashes import TissueOf, find_splashes
from intrasplat.clip.split import spread
from intrasplat.clip.types import DepthClip
from intrasplat.errors import Cancelled, InputError
from intrasplat.instruments import Finder, looked_at
from intrasplat.machine.hooks import Hooks, Progress
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.machine.pool import thread_a_core
from intrasplat.names import Fov
from intrasplat.notices import Notice, NoticeCode
from intrasplat.options import MAX_DEPTH_MM, MIN_DEPTH_MM
from intrasplat.report import Masks
from intrasplat.stereo.alignment import (
    Agreed,
    agreed_disparities,
    choose_range,
    match_features,
    measure_row_shift,
    outside_share,
)
from intrasplat.stereo.frames import FrameWork, grey_of
from intrasplat.stereo.in_step import Profile, find_lag, move_frames, row_profile
from intrasplat.stereo.matching import MatchPlan
from intrasplat.stereo.nearness import nearness
from intrasplat.stereo.registration import MatchedPair, Registration

if TYPE_CHECKING:  # matching itself needs no calibration module
    from intrasplat.clip.calibration import RectifiedClip

FinderOf = Callable[[Iterable[NDArray[np.uint8]], NDArray[np.bool_] | None], Finder]
"""The signature of Finder.of: some pictures, and their field of view."""

STAGE = "stereo"
COMPILATION = "compile"
"""The stage that is reported until the GPU's kernels have run once, because the first run may compile them."""
DECODING_SHARE, MEASURING_SHARE = 0.2, 0.1  # of the stage's progress
RANGE_PAIRS, ALIGNMENT_PAIRS = 7, 3
"""Number of pairs, spread over the measured frames. A pair costs 10 ms for the range and 250 ms for the alignment."""
WARN_OUTSIDE_SHARE = 0.1
WARN_SURE_SHARE = 0.5
MIN_SURE_SHARE = 0.005
"""Minimum share of tissue with sure depth: unrelated images have 0.0003 by chance."""


def estimate_depth(
    clip: RectifiedClip,
    hooks: Hooks | None = None,
    *,
    measured_frames: Sequence[int] | None = None,
    skip_redundant: bool = False,
    most_frames: int | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    depth_range_mm: tuple[float, float] = (MIN_DEPTH_MM, MAX_DEPTH_MM),
    fov: Fov = "all",
    finder_of: FinderOf | None = None,
) -> DepthClip:
    """Depth (mm) and confidence of every frame, corrected for rotation, row shift (up to 8 px) and colour of the eyes.

    The correction and the disparity range are common to all frames. They are measured on measured_frames alone (None:
    on all), and so is the field of view with `fov` "auto" unless the clip has one that was given. Otherwise a frame's
    depth depends on its own pair only, so frames outside measured_frames do not change the depth of others. Frames that
    are damaged or show no whole scene (clip/empty_frames.py) get no depth, nor, with skip_redundant, measured frames
    that show nothing new (clip/sampling.py). If the right eye is out of step (in_step.py), which all frames tell, its
    frames are moved, and frames without a partner are skipped.
    On "cuda" another matcher (intrasplat/stereo/cuda, needs triton) matches many pairs at once. finder_of creates the
    finder of instruments for a clip without masks, from some of its pictures; it runs on each frame by itself, before
    matching. None: `clip.tissue` is used, and changed: masks that can be written become the result's.

    `measurements` gains vertical_misalignment_px and vertical_residual_px (median |dy| after the correction),
    min_disparity_px and max_disparity_px (the range searched), depth_valid_share (of tissue pixels) and
    depth_sure_share (those with confidence SURE or more). Depth outside depth_range_mm is neither searched nor kept.

    Raises:
        ValueError: measured_frames is empty or contains a frame that does not exist.
        InputError: no frame shows anything, there is no depth, the frames are rectified already, the eyes seem to be
            swapped, their rows differ by more than 8 px, or a field of view is given and fov is "all".
        Cancelled: hooks.should_stop said so.
    """
    hooks = Hooks() if hooks is None else hooks
    given = set(range(clip.frame_count) if measured_frames is None else measured_frames)
    measured = sorted(given - set(clip.damaged))
    if not measured or measured[0] < 0 or measured[-1] >= clip.frame_count:
        raise ValueError(f"measured_frames {measured} are not some of {clip.frame_count} frames")
    nearest_px, farthest_px = (
        clip.intrinsics.fx * clip.baseline_mm / each + clip.disparity_offset_px for each in depth_range_mm
    )
    with one_opencv_thread(), thread_a_core(STAGE) as pool:  # two threads for one pair are slower
        received = _receive(clip, spread(measured, ALIGNMENT_PAIRS), pool, hooks)
        lag = find_lag(*received.profiles)
        unpaired: tuple[int, ...] = ()
        if lag is not None:
            sources = lag.sources(clip.frame_count)
            unpaired = tuple(t for t, source in enumerate(sources) if source is None)
            clip = _in_step(clip, received, sources)
            measured = sorted(set(measured) - {*unpaired, *clip.damaged})
        rgb, right_rgb = received.rgb, received.right_rgb
        fields, empty = find_shown(
            [rgb, right_rgb], received.thumbnails, measured, fov, () if finder_of else clip.tissue, pool.map,
            clip.given_fields, may_coincide=farthest_px <= 0 <= nearest_px,
        )  # fmt: skip
        measured = sorted(set(measured) - set(empty.frames))
        matches = received.matches(spread(measured, ALIGNMENT_PAIRS), pool)
        unused = skippable_frames(rgb, measured, most_frames, pool.map) if skip_redundant else SkippedFrames()
        if device == "cuda":
            hooks.on_progress(Progress(COMPILATION, 0.0))
        finder = None if finder_of is None else finder_of((rgb[i] for i in looked_at(measured)), fields.left)
        registration, plan, outside = plan_matching(
            clip, rgb, right_rgb, measured, matches, pool, device, depth_range_mm, finder, fields
        )
        splashes = find_splashes(
            (rgb, right_rgb), _shown_tissue(clip, fields, has_masks=finder is None), measured,
            (plan.min_disparity_px, plan.max_disparity_px), pool,
        )  # fmt: skip
        work = FrameWork.begin(clip, rgb, right_rgb, measured, registration, plan, fields, splashes, finder)
        first, share = measured[0], 1 - DECODING_SHARE - MEASURING_SHARE
        skipped = tuple(sorted({*empty.frames, *unused.frames, *clip.damaged, *unpaired}))
        wanted = sorted(set(range(clip.frame_count)) - set(skipped))
        order = sorted(wanted, key=lambda i: i != first)  # frame `first` is shown as soon as it has depth
        jobs = _match_on_device(work, order, pool, hooks) if device == "cuda" else _match_all(work, order, pool)
        for done, (i, job) in enumerate(jobs, start=1):
            _check_stop(hooks)
            job.result()
            if i == first:
                hooks.on_first_moment(work.matched.moment(i))
            hooks.on_progress(Progress(STAGE, 1 - share * (len(wanted) - done) / len(wanted)))
    pixels, valid, sure = (int(each) for each in work.counts.sum(axis=0))
    valid_share, sure_share = valid / max(pixels, 1), sure / max(pixels, 1)
    _check_depth(sure_share, has_given_field=bool(clip.given_fields))
    share = 1 - pixels / (len(wanted) * work.matched.field_pixels)
    masks, assumptions = Masks(source="given", share=share), clip.assumptions
    mask_warnings: tuple[Notice, ...] = ()
    if finder is not None:
        masks, assumption, mask_warnings = finder.report(share, work.sure[wanted])
        assumptions = (*(each for each in assumptions if each.code is not NoticeCode.MASKS), assumption)
    return replace(
        work.matched,
        skipped=skipped,
        masks=masks,
        rectification=clip.rectification,
        assumptions=(
            *assumptions,
            _scale_assumption(clip),
            *fields.notices,
            *splashes.notices,
            *unused.notices(clip.frame_count),
        ),
        warnings=clip.warnings
        + empty.notices(clip.frame_count)
        + (() if lag is None else (lag.notice(unpaired),))
        + mask_warnings
        + registration.notices(drops=bool(splashes.notices))
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


@dataclass(frozen=True, eq=False)
class _Received:
    """The frames of both eyes.

    rgb, right_rgb  [T, H, W, 3]
    thumbnails      T thumbnails of each eye (clip/sampling.py)
    profiles        T profiles of each eye's rows (in_step.py)
    features        of some frames, by index: those of both eyes
    """

    rgb: NDArray[np.uint8]
    right_rgb: NDArray[np.uint8]
    thumbnails: tuple[list[Thumbnail], list[Thumbnail]]
    profiles: tuple[list[Profile], list[Profile]]
    features: dict[int, tuple[Future[Features], Future[Features]]]

    def matches(self, frames: Sequence[int], pool: ThreadPoolExecutor) -> NDArray[np.float64]:
        """Feature matches [M, 4] of these frames; those without features get theirs now."""
        for i in frames:
            if i not in self.features:
                self.features[i] = _features(self.rgb[i], self.right_rgb[i], pool)
        pairs = [[job.result() for job in self.features[i]] for i in frames]
        return np.concatenate(list(pool.map(match_features, *zip(*pairs, strict=True))))


def _features(
    left: NDArray[np.uint8], right: NDArray[np.uint8], pool: ThreadPoolExecutor
) -> tuple[Future[Features], Future[Features]]:
    return pool.submit(find_features, grey_of(left)), pool.submit(find_features, grey_of(right))


def _receive(clip: RectifiedClip, aligned: Sequence[int], pool: ThreadPoolExecutor, hooks: Hooks) -> _Received:
    """The frames from one pass over the source, and the features of frames `aligned`.

    Thumbnails are made and features are searched while later frames arrive.
    """
    shape = (clip.frame_count, clip.intrinsics.height, clip.intrinsics.width, 3)
    rgb, right = (mapped_zeros(shape, np.uint8) for _ in range(2))
    features: dict[int, tuple[Future[Features], Future[Features]]] = {}
    thumbnails: tuple[list[Future[Thumbnail]], list[Future[Thumbnail]]] = ([], [])
    profiles: tuple[list[Profile], list[Profile]] = ([], [])
    decoded = 0
    for i, (left_frame, right_frame) in enumerate(clip.pairs()):
        if i >= clip.frame_count:
            break
        _check_stop(hooks)
        for frames, frame, rows in ((rgb, left_frame, profiles[0]), (right, right_frame, profiles[1])):
            frames[i] = frame
            rows.append(row_profile(frame))
            let_go(frames[i])
        for eye, frame in zip(thumbnails, (left_frame, right_frame), strict=True):
            eye.append(pool.submit(thumbnail, frame))
        if i in aligned:
            features[i] = _features(left_frame, right_frame, pool)
        decoded = i + 1
        share = DECODING_SHARE * decoded / clip.frame_count
        hooks.on_progress(Progress(STAGE, share, frames=clip.frame_count, megapixels=rgb.size / 3e6))
    if decoded < clip.frame_count:
        raise InputError("clip", f"it ended after {decoded} of {clip.frame_count} frames.", "Give the whole recording.")
    left_small, right_small = ([job.result() for job in eye] for eye in thumbnails)
    return _Received(rgb, right, (left_small, right_small), profiles, features)


def _in_step(clip: RectifiedClip, received: _Received, sources: Sequence[int | None]) -> RectifiedClip:
    """The clip, whose right frames, their thumbnails and masks become those of `sources`; features are found anew.

    A frame counts as damaged if it was, or if its new right frame was.
    """
    move_frames(received.right_rgb, sources)
    chosen = [t if source is None else source for t, source in enumerate(sources)]
    received.thumbnails[1][:] = [received.thumbnails[1][source] for source in chosen]
    received.features.clear()
    damaged = tuple(t for t, source in enumerate(chosen) if {t, source} & set(clip.damaged))
    tissue_right = None if clip.tissue_right is None else clip.tissue_right[chosen]
    return replace(clip, tissue_right=tissue_right, damaged=damaged)


def _shown_tissue(clip: RectifiedClip, fields: Fields, *, has_masks: bool) -> tuple[TissueOf, TissueOf]:
    """The tissue of each eye before any was found: in the field of view, and outside the given masks."""

    def left(frame: int) -> Mask | None:
        return fields.tissue(clip.tissue[frame]) if has_masks else fields.left

    def right(frame: int) -> Mask | None:
        if clip.tissue_right is None:
            return fields.right
        tissue: Mask = clip.tissue_right[frame]
        return tissue if fields.right is None else tissue & fields.right

    return left, right


def plan_matching(
    clip: RectifiedClip,
    rgb: NDArray[np.uint8],
    right: NDArray[np.uint8],
    measured: Sequence[int],
    matches: NDArray[np.float64],
    pool: ThreadPoolExecutor,
    device: str,
    depth_range_mm: tuple[float, float],
    finder: Finder | None,
    fields: Fields,
) -> tuple[Registration, MatchPlan, float]:
    """The registration of the eyes and the disparity range, from a few pairs of the measured frames; outside_share."""
    shift = measure_row_shift(matches, clip.disparity_offset_px, clip.equal_rows_px)
    agreed: Agreed = partial(agreed_disparities, each=pool.map)
    if device == "cuda":
        from intrasplat.stereo.cuda import agreed_disparities as agreed
    focal_baseline = clip.intrinsics.fx * clip.baseline_mm
    outside = outside_share(matches, shift, clip.disparity_offset_px, focal_baseline, depth_range_mm)
    calibrated = replace(clip.intrinsics, cx=clip.intrinsics.cx - clip.disparity_offset_px)
    coarse = Registration.of_matches(matches, shift, calibrated, clip.baseline_mm)
    ranged = spread(measured, RANGE_PAIRS)
    pairs = list(pool.map(lambda i: (grey_of(rgb[i]), coarse.rectified(grey_of(right[i]))), ranged))
    plan = MatchPlan(
        *choose_range(pairs, clip.disparity_offset_px, focal_baseline, depth_range_mm, agreed), depth_range_mm
    )

    def matched_pair(i: int) -> MatchedPair:
        tissue, rectified = fields.tissue(clip.tissue[i]), coarse.rectified(right[i])
        if finder is not None:
            grey, offset_px = grey_of(rectified), clip.disparity_offset_px
            tissue = tissue & ~finder(rgb[i], lambda picture: nearness(picture, grey, plan, offset_px)).tool
        return MatchedPair.of(rgb[i], rectified, tissue, plan)

    found = pool.map(matched_pair, spread(measured, ALIGNMENT_PAIRS))
    return coarse.refined(list(found), matches, pool.map), plan, outside


Jobs = Iterable[tuple[int, Future[None]]]
"""Pairs of a frame and the job that finishes it."""


def _match_all(work: FrameWork, order: Sequence[int], pool: ThreadPoolExecutor) -> Jobs:
    """Match the pairs in parallel, started in this order."""
    return [(i, pool.submit(work.match, i)) for i in order]


def _match_on_device(work: FrameWork, order: Sequence[int], pool: ThreadPoolExecutor, hooks: Hooks) -> Jobs:
    """Match the first pair alone, then batches whose cost volumes fit into memory; the pool finishes each frame."""
    from intrasplat.stereo.cuda import depth_of, frames_at_once

    clip, matched = work.clip, work.matched
    at_once = frames_at_once(clip.intrinsics.height, clip.intrinsics.width, work.plan)
    focal_baseline = clip.intrinsics.fx * clip.baseline_mm
    hooks.on_progress(Progress(COMPILATION, 0.5))
    for batch in (order[:1], *(order[k : k + at_once] for k in range(1, len(order), at_once))):
        _check_stop(hooks)
        left, other = (np.stack(eye) for eye in zip(*pool.map(work.greys, batch), strict=True))
        tissue = np.stack(list(pool.map(work.tell_tissue, batch, other)))
        matched.depth_mm[batch], matched.depth_confidence[batch] = depth_of(
            left, other, tissue, work.plan, focal_baseline, clip.disparity_offset_px
        )
        yield from [(i, pool.submit(work.finish, i)) for i in batch]


def _check_depth(sure_share: float, *, has_given_field: bool) -> None:
    """Refuse a clip whose share of tissue with sure depth is below MIN_SURE_SHARE."""
    if sure_share < MIN_SURE_SHARE:
        masks = "masks fit the frames, and that fov_mask is white inside" if has_given_field else "masks fit the frames"
        raise InputError(
            "clip",
            f"{sure_share:.1%} of tissue pixels have a depth to rely on, as good as none.",
            f"Check focus, that left and right belong together, that the calibration and {masks}.",
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
    """The assumption about the baseline: an error in it scales every distance and is invisible in the pictures."""
    text = f"scale: the calibration's baseline of {clip.baseline_mm:.4g} mm; every distance is as right as it is"
    return Notice.info(NoticeCode.BASELINE, text)


def _check_stop(hooks: Hooks) -> None:
    if hooks.should_stop():
        raise Cancelled("stopped while estimating depth")
