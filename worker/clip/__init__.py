"""Decode and validate what the user gave: a stereo clip, or frames whose depth is already known."""

from contract.clip_limits import ClipLimits
from worker.clip.opening import find_calibration, open_clip
from worker.clip.split import FrameSplit, held_out_frames, split_frames, spread
from worker.clip.types import DepthClip, StereoClip

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
