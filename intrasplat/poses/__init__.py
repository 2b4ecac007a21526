"""A clip with depth in; the same clip with camera poses out. They are estimated if none are given and the camera moves.

Verbs: with_poses; read_poses; camera_rests; estimate.find_path.
"""

from intrasplat.poses.placing import placed
from intrasplat.poses.pose_file import StoredPoses, read_poses
from intrasplat.poses.posed import with_poses
from intrasplat.poses.still import camera_rests

__all__ = ["StoredPoses", "camera_rests", "placed", "read_poses", "with_poses"]
