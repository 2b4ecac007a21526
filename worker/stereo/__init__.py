"""Rectified stereo clip in; depth in mm and its confidence for every frame out. Verb: estimate_depth."""

from worker.stereo.depth import estimate_depth

__all__ = ["estimate_depth"]
