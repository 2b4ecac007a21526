"""Files in; a StereoClip, or a DepthClip if depth came along, out. Verbs: open_clip, find_calibration, split_frames."""

from contract.intake.limits import ClipLimits
from worker.input.clip.opening import find_calibration, open_clip
from worker.input.clip.split import FrameSplit, held_out_frames, split_frames, spread, training_frames
from worker.input.clip.types import DepthClip, Eye, StereoClip

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
