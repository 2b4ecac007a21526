"""Decode and validate what the user gave: a stereo clip, or frames whose depth is already known."""

from worker.clip.types import DepthClip, StereoClip

__all__ = ["DepthClip", "StereoClip"]
