"""Layout "stereomis": a StereoMIS sequence, a top-bottom video or left and right images, with its calibration file."""

from __future__ import annotations

from pathlib import PurePosixPath

from intrasplat.clip.layouts.layout import ClipFiles, InputLayout
from intrasplat.clip.packing import detect_packing
from intrasplat.clip.stereo import eye_images_clip, packed_clip, two_video_clip
from intrasplat.clip.types import StereoClip

TITLE = "StereoMIS"
CALIBRATION_FILE = "StereoCalibration.ini"


def _recognises(files: ClipFiles) -> bool:
    names = files.tree.names if files.tree is not None else ()
    return any(PurePosixPath(name).name.lower() == CALIBRATION_FILE.lower() for name in names)


def _open(files: ClipFiles) -> StereoClip:
    tree = files.tree_for("stereomis")
    sequence = files.sequence
    if len(files.videos) > 1:
        return two_video_clip(tree, files.videos)
    if sequence is None or (files.images and not files.videos and not files.detected):
        return eye_images_clip(tree, files.images, TITLE)
    packing = detect_packing(sequence) if files.detected else "tb"
    return packed_clip(sequence, packing, files.limits, detected=files.detected, title=TITLE)


STEREOMIS = InputLayout("stereomis", _recognises, _open, white="tissue", title=TITLE)
