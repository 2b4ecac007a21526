"""The phantom: stereo clips of synthetic tissue with true depth and motion.

Functions: make_phantom, write_endonerf, write_stereomis, write_stereo_video.
"""

from lab.phantom.camera import orbit_pose
from lab.phantom.scene import DrawnStereo, Phantom, PhantomFrame, Trajectories, make_phantom
from lab.phantom.settings import CAMERA_PATHS, MOTIONS, TOOLS, CameraPath, Motion, PhantomSettings, Tool
from lab.phantom.writers import write_endonerf, write_stereo_video, write_stereomis

__all__ = [
    "CAMERA_PATHS",
    "MOTIONS",
    "TOOLS",
    "CameraPath",
    "DrawnStereo",
    "Motion",
    "Phantom",
    "PhantomFrame",
    "PhantomSettings",
    "Tool",
    "Trajectories",
    "make_phantom",
    "orbit_pose",
    "write_endonerf",
    "write_stereo_video",
    "write_stereomis",
]
