"""Files in; a StereoClip, or with depth a DepthClip, out. Verbs: open_clip, find_calibration, split_frames."""

from intrasplat.clip.opening import find_calibration, open_clip
from intrasplat.clip.split import FrameSplit, held_out_frames, split_frames, spread, training_frames
from intrasplat.clip.types import DepthClip, Eye, StereoClip
from intrasplat.intake.limits import ClipLimits

__all__ = [
    "ClipLimits",
    "DepthClip",
    "Eye",
    "FrameSplit",
    "StereoClip",
    "find_calibration",
    "held_out_frames",
    "open_clip",
    "split_frames",
    "spread",
    "training_frames",
]
