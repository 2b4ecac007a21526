"""Names that every process uses: the choices of a caller, and the files of a job. This module imports only the standard
library."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

JOB_ID_PATTERN = r"^[0-9a-f]{32}$"
"""The service creates job ids, never a caller, so they are safe as file names and parts of keys."""

PresetName = Literal["instant", "fast", "quality", "small", "paper"]
"""instant, fast, quality and small are ours; paper is the published method as published (intrasplat/methods)."""

LABORATORY_PRESETS = ("paper-released", "paper-wide", "pfs", "hexplane", "without_mapf")
"""Variants of paper that versions before 0.3 accepted in requests. Only the laboratory trains them now
(lab/evaluate/variants)."""

BUDGETS_S: Mapping[PresetName, float] = {"instant": 5.5, "fast": 60.0, "quality": 240.0, "small": 30.0}
"""Default seconds of training of our presets."""

Layout = Literal["auto", "endonerf", "stereomis", "sbs", "tb", "frames"]
"""How a clip's eyes, depths and masks are laid out (docs/conventions.md); auto detects it."""

MaskPolarity = Literal["auto", "tool", "tissue"]
"""What is bright in the masks."""

MaskSource = Literal["given", "auto", "none"]
"""Where masks of instruments come from. given: from the clip, else from this installation's segmenter, if there is one.
auto: the same, and without either they are found by colour and depth. none: every pixel is tissue."""

PoseConvention = Literal["opengl", "llff"]
"""Axes of the poses in an EndoNeRF folder: as EndoNeRF writes them, or as LLFF does (docs/conventions.md)."""

Fov = Literal["auto", "all"]
"""The part of the pictures that shows the scene. auto: all but black borders, bars and labels. all: everything."""

Poses = Literal["auto", "given", "fixed", "estimate"]
"""Where the camera's poses come from. given: from the clip or a file. fixed: the camera does not move. estimate: from
the pictures. auto: those given, if there are any and the pictures do not contradict them; else check whether the camera
is fixed, and estimate its path if it is not."""
POSES_UNUSED: tuple[Poses, ...] = ("fixed", "estimate")
"""Values of the option that use no given poses."""

Eyes = Literal["left", "both"]
"""The eyes of a stereo clip that a model is trained on."""

Eye = Literal["left", "right"]
"""One eye of a stereo clip."""

Keep = Literal["on", "off"]
"""Whether something is stored with a scene."""

Light = Literal["steady", "recorded"]
"""The light of a render's colours: that of one frame at all times, or that in which the moment was recorded."""

Smoke = Literal["remove", "show"]
"""Whether a render shows the smoke that lay before the tissue when it was recorded."""

Detail = Literal["on", "off"]
"""Whether a render gets what the model misses of the recorded frames."""

UsedFrames = Literal["new", "all"]
"""The frames of a clip that a model may be trained on."""

DeviceName = Literal["auto", "cpu", "cuda"]
"""Where to compute; auto chooses the GPU if it meets all requirements, otherwise the CPU."""

POSES_FILE = "poses_bounds.npy"
"""The file of poses in a clip of EndoNeRF layout."""

SUBMISSION = "submission.json"
LABELS = "labels.json"
"""The labels of a job in the spool, if its caller gave any."""
MANIFEST = "manifest.json"
SCENE = "scene.safetensors"
REPORT = "report.json"
CURVE = "curve.csv"
MASKS = "masks.zip"
"""The masks that were found, if any: one PNG per frame, in the format of a clip's `masks`."""
RECORDED = "recorded.zip"
"""Recorded frames and their masks, unless the caller declined them (intrasplat/scene/recorded_file.py)."""
DETAIL = "detail.mkv"
"""Recorded training frames for views, if recorded frames are kept (intrasplat/scene/training_pictures.py)."""
THUMBNAIL = "thumbnail.jpg"
"""A small picture for lists, created at the first request for it."""
RESUME = "resume.safetensors"
PREPARED = "prepared"
"""The folder with the clip and its depth."""
RESUME_STATE = (RESUME, PREPARED)
"""What a stopped or killed job stores for the next attempt."""
