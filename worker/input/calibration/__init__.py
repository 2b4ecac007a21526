"""A calibration file and a stereo clip in; the rectified clip out, frame by frame. Verbs: load_calibration, rectify."""

from worker.input.calibration.files import load_calibration
from worker.input.calibration.rectify import RectifiedClip, rectify

__all__ = ["RectifiedClip", "load_calibration", "rectify"]
