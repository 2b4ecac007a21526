"""A calibration file and a stereo clip in; the rectified clip out, frame by frame. Verbs: load_calibration, rectify."""

from intrasplat.clip.calibration.files import load_calibration
from intrasplat.clip.calibration.rectify import RectifiedClip, rectify

__all__ = ["RectifiedClip", "load_calibration", "rectify"]
