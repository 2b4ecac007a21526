"""Matching on a GPU: many pairs at once, semi-global in Triton, with OpenCV's core alone.

Importing it needs triton; intrasplat/stereo/depth.py imports it only if the device is "cuda".
"""

from intrasplat.stereo.cuda.matching import agreed_disparities, depth_of, frames_at_once, match_frames

__all__ = ["agreed_disparities", "depth_of", "frames_at_once", "match_frames"]
