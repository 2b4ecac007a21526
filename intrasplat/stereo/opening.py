"""Files from outside become a clip with depth: decoded, rectified, matched. It needs no torch."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

from intrasplat.clip import ClipLimits, DepthClip, StereoClip, training_frames
from intrasplat.clip.calibration import rectify
from intrasplat.clip.given_field import Mask, with_field
from intrasplat.clip.sampling import most_frames
from intrasplat.clip.shown import with_shown_parts
from intrasplat.decode import DecoderKilledError, decode_clip
from intrasplat.instruments import Finder, load_segmenter, with_instruments_found
from intrasplat.intake.calibration.types import StereoCalibration
from intrasplat.intake.fit import check_not_all
from intrasplat.machine.hooks import Hooks, ignore
from intrasplat.machine.timing import Timings
from intrasplat.names import Fov, MaskSource
from intrasplat.options import MAX_DEPTH_MM, MIN_DEPTH_MM, ReconstructionOptions
from intrasplat.report import Masks
from intrasplat.stereo.depth import estimate_depth

TRIES = 3
"""How often a clip is tried whose decoding process is killed from outside."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ClipPaths:
    """The files of one clip (intrasplat/clip/opening.py); `clip` may contain both eyes.

    fov_mask: the field of view, a PNG or [H, W] bool (intrasplat/clip/given_field.py); None: it is found.
    """

    clip: Path
    right: Path | None = None
    calibration: Path | None = None
    masks: Path | None = None
    fov_mask: Path | Mask | None = field(default=None, compare=False)


def open_with_depth(
    paths: ClipPaths,
    options: ReconstructionOptions,
    hooks: Hooks,
    timings: Timings,
    *,
    limits: ClipLimits | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    before_matching: Callable[[], None] = ignore,
    segmenter: Path | None = None,
) -> DepthClip:
    """The decoded clip with depth; stereo input is rectified and matched, and keeps its right eye.

    timings get decode_s, until the size of a stereo clip is known, and stereo_s, which includes decoding its frames.

    Without masks, instruments are found (intrasplat/instruments) if there is a segmenter, an ONNX file, or if
    options.mask_source is auto.

    If something outside kills the decoding process, it is restarted, TRIES attempts in all.

    Raises:
        InputError: the clip, its calibration, its masks, its field of view or the holdout cannot be used.
        UnavailableError: the disk is full, before_matching raised it, the segmenter cannot be used, or the decoding
            process was killed every time.
        Cancelled: hooks.should_stop said so.
    """
    if paths.fov_mask is not None:
        check_not_all(options.fov)
    in_memory = None if isinstance(paths.fov_mask, Path) else paths.fov_mask

    def once() -> DepthClip:
        hooks.report_stage("decode", 0.0)
        with timings.measure("decode_s"):
            decoded = decode_clip(
                paths.clip,
                paths.right,
                calibration=paths.calibration,
                masks=paths.masks,
                fov_mask=paths.fov_mask if isinstance(paths.fov_mask, Path) else None,
                options=options,
                limits=limits,
                hooks=hooks,
            )
        if isinstance(decoded, DepthClip):
            clip = with_shown_parts(decoded if in_memory is None else with_field(decoded, in_memory), options)
            measured = sorted(set(training_frames(clip.frame_count, options.holdout)) - set(clip.skipped))
            hooks.on_first_moment(clip.moment(measured[0]))
            without = clip.masks is not None and clip.masks.source == "none"
            if not without or not _finds(options.mask_source, segmenter):
                return clip
            network = None if segmenter is None else load_segmenter(segmenter)
            with timings.measure("masks_s"):
                return with_instruments_found(clip, measured, hooks, network)
        with closing(decoded):
            return match_eyes(
                decoded.clip if in_memory is None else with_field(decoded.clip, in_memory),
                decoded.calibration,
                options.holdout,
                hooks,
                timings,
                skip_redundant=options.use_frames == "new",
                most_frames=most_frames(options),
                device=device,
                before_matching=before_matching,
                depth_range_mm=(options.min_depth_mm, options.max_depth_mm),
                fov=options.fov,
                mask_source=options.mask_source,
                segmenter=segmenter,
            )

    for _ in range(TRIES - 1):
        try:
            return once()
        except DecoderKilledError:
            logger.warning("something killed the process that decodes the clip; it is tried again")
    return once()


def match_eyes(
    clip: StereoClip,
    calibration: StereoCalibration,
    holdout: str,
    hooks: Hooks,
    timings: Timings,
    *,
    skip_redundant: bool = False,
    most_frames: int | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    before_matching: Callable[[], None] = ignore,
    depth_range_mm: tuple[float, float] = (MIN_DEPTH_MM, MAX_DEPTH_MM),
    fov: Fov = "all",
    mask_source: MaskSource = "given",
    segmenter: Path | None = None,
) -> DepthClip:
    """The clip with depth from a decoded stereo clip: rectified and matched as by open_with_depth."""
    finds = clip.tissue is None and _finds(mask_source, segmenter)
    network = load_segmenter(segmenter) if finds and segmenter is not None else None
    rectified = rectify(clip, calibration)
    measured = training_frames(clip.frame_count, holdout)
    before_matching()
    with timings.measure("stereo_s"):
        matched = estimate_depth(
            rectified,
            hooks,
            measured_frames=measured,
            skip_redundant=skip_redundant,
            most_frames=most_frames,
            device=device,
            depth_range_mm=depth_range_mm,
            fov=fov,
            finder_of=partial(Finder.of, segmenter=network) if finds else None,
        )
    return replace(matched, masks=Masks(source="none")) if clip.tissue is None and not finds else matched


def _finds(mask_source: MaskSource, segmenter: Path | None) -> bool:
    """Whether to find instruments in a clip without masks."""
    return mask_source == "auto" or (mask_source == "given" and segmenter is not None)
