"""Export the endoscope's path as a TUM file."""

from __future__ import annotations

from intrasplat.scene.scene import TrainedScene


def export_tum(scene: TrainedScene) -> bytes:
    """A line `timestamp tx ty tz qx qy qz qw` for every frame, in seconds and metres.

    The pose is world_from_camera of the left eye.
    """
    from intrasplat.poses.trajectory import tum_lines  # imported late: renders do not need what it imports

    return tum_lines(scene.frame_times_s, scene.world_from_camera).encode()
