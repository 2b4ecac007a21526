"""Stage 3: metric depth and its confidence from rectified stereo."""

from worker.stereo.depth import estimate_depth

__all__ = ["estimate_depth"]
