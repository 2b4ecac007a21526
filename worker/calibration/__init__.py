"""Stage 2: calibration files of every kind, and the lazy rectification of a stereo clip by them."""

from worker.calibration.check import check_calibration
from worker.calibration.files import load_calibration
from worker.calibration.rectify import RectifiedClip, rectify

__all__ = ["RectifiedClip", "check_calibration", "load_calibration", "rectify"]
