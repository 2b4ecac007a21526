"""Layout "frames": left and right images, distinguished by name; or two videos, if the layout is detected."""

from __future__ import annotations

from intrasplat.clip.layouts.layout import ClipFiles, InputLayout
from intrasplat.clip.stereo import eye_images_clip, two_video_clip
from intrasplat.clip.types import StereoClip


def _open(files: ClipFiles) -> StereoClip:
    tree = files.tree_for("frames")
    if files.detected and files.videos:
        return two_video_clip(tree, files.videos)
    return eye_images_clip(tree, files.images, "left and right frames")


FRAMES = InputLayout("frames", lambda files: files.tree is not None, _open)
