"""A clip with depth in; the same clip with its camera's poses out, estimated if nobody gave them and the camera moves.

Verbs: with_poses; camera_rests, and find_path of estimate.py.
"""

from intrasplat.poses.posed import placed, with_poses
from intrasplat.poses.still import camera_rests

__all__ = ["camera_rests", "placed", "with_poses"]
