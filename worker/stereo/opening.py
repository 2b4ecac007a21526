"""Files from outside become a clip with depth: decoded, rectified, matched. It needs no torch."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from contract.wire.options import MAX_DEPTH_MM, MIN_DEPTH_MM, ReconstructionOptions
from worker.input.calibration import rectify
from worker.input.calibration.types import StereoCalibration
from worker.input.clip import ClipLimits, DepthClip, StereoClip, training_frames
from worker.input.clip.sampling import most_frames, sampled
from worker.input.decode import DecoderKilledError, decode_clip
from worker.machine.hooks import Hooks, ignore
from worker.machine.timing import Timings
from worker.stereo.depth import estimate_depth

TRIES = 3
"""Of a clip whose decoding process is killed from outside."""

logger = logging.getLogger("intrasplat.worker")


@dataclass(frozen=True)
class ClipPaths:
    """The files of one clip (worker/input/clip/opening.py); clip may be of both eyes."""

    clip: Path
    right: Path | None = None
    calibration: Path | None = None
    masks: Path | None = None


def open_with_depth(
    paths: ClipPaths,
    options: ReconstructionOptions,
    hooks: Hooks,
    timings: Timings,
    *,
    limits: ClipLimits | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    before_matching: Callable[[], None] = ignore,
) -> DepthClip:
    """Decode, and for stereo input rectify and match: the left frames with depth, and the right ones.

    timings get decode_s, until the size of a stereo clip is known, and stereo_s, which includes decoding its frames.

    When something outside kills the decoding process, it is tried again, TRIES times in all.

    Raises:
        InputError: the clip, its calibration, its masks or the holdout cannot be used.
        UnavailableError: the disk is full; or before_matching raised it; or the decoding process was killed every time.
        Cancelled: hooks.should_stop said so.
    """

    def once() -> DepthClip:
        hooks.report_stage("decode", 0.0)
        with timings.measure("decode_s"):
            decoded = decode_clip(
                paths.clip,
                paths.right,
                calibration=paths.calibration,
                masks=paths.masks,
                options=options,
                limits=limits,
                hooks=hooks,
            )
        if isinstance(decoded, DepthClip):
            hooks.on_first_moment(decoded.moment(training_frames(decoded.frame_count, options.holdout)[0]))
            return sampled(decoded, options)
        with closing(decoded):
            return match_eyes(
                decoded.clip,
                decoded.calibration,
                options.holdout,
                hooks,
                timings,
                leave_out=options.use_frames == "new",
                most_frames=most_frames(options),
                device=device,
                before_matching=before_matching,
                depth_range_mm=(options.min_depth_mm, options.max_depth_mm),
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
    leave_out: bool = False,
    most_frames: int | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    before_matching: Callable[[], None] = ignore,
    depth_range_mm: tuple[float, float] = (MIN_DEPTH_MM, MAX_DEPTH_MM),
) -> DepthClip:
    """Rectify a stereo clip and match its eyes, as open_with_depth does."""
    rectified = rectify(clip, calibration)
    measured = training_frames(clip.frame_count, holdout)
    before_matching()
    with timings.measure("stereo_s"):
        return estimate_depth(
            rectified,
            hooks,
            measured_frames=measured,
            leave_out=leave_out,
            most_frames=most_frames,
            device=device,
            depth_range_mm=depth_range_mm,
        )
