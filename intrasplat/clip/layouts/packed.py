"""Layouts "sbs" and "tb": both eyes in one picture, side by side or top-bottom; a video, or images."""

from __future__ import annotations

from intrasplat.clip.bit_depth import at_own_depth
from intrasplat.clip.images import open_images
from intrasplat.clip.layouts.layout import ClipFiles, InputLayout
from intrasplat.clip.packing import Packing, detect_packing
from intrasplat.clip.stereo import packed_clip, two_video_clip
from intrasplat.clip.types import StereoClip


def _recognises(files: ClipFiles, packing: Packing) -> bool:
    return files.sequence is not None and detect_packing(files.sequence) == packing


def _open(files: ClipFiles, packing: Packing) -> StereoClip:
    sequence = files.sequence
    if sequence is None and files.tree is not None:
        if files.videos:
            return two_video_clip(files.tree, files.videos)
        sequence = at_own_depth(open_images(files.tree, files.images))[0]
    assert sequence is not None
    return packed_clip(sequence, packing, files.limits, detected=files.detected)


SBS = InputLayout("sbs", lambda files: _recognises(files, "sbs"), lambda files: _open(files, "sbs"))
TB = InputLayout("tb", lambda files: _recognises(files, "tb"), lambda files: _open(files, "tb"))
