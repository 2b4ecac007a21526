"""Stage 2: calibration files of every kind, and the lazy rectification of a stereo clip by them."""

from worker.input.calibration.check import check_calibration
from worker.input.calibration.files import load_calibration
from worker.input.calibration.rectify import RectifiedClip, rectify

__all__ = ["RectifiedClip", "check_calibration", "load_calibration", "rectify"]
