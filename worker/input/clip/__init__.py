"""Decode and validate what the user gave: a stereo clip, or frames whose depth is already known."""

from contract.intake.limits import ClipLimits
from worker.input.clip.opening import find_calibration, open_clip
from worker.input.clip.split import FrameSplit, held_out_frames, split_frames, spread
from worker.input.clip.types import DepthClip, StereoClip

__all__ = [
    "ClipLimits",
    "DepthClip",
    "FrameSplit",
    "StereoClip",
    "find_calibration",
    "held_out_frames",
    "open_clip",
    "split_frames",
    "spread",
]
