"""A clip with depth in; the same clip with camera poses out. They are estimated if none are given and the camera moves.

Verbs: with_poses; camera_rests; estimate.find_path.
"""

from intrasplat.poses.posed import placed, with_poses
from intrasplat.poses.still import camera_rests

__all__ = ["camera_rests", "placed", "with_poses"]
