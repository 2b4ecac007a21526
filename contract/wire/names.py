"""Names that every process uses alike: what a caller chooses among, and the files of a job. Nothing but the standard
library is needed to read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

JOB_ID_PATTERN = r"^[0-9a-f]{32}$"
"""Job ids are made by the service, never by a caller, so they are safe as file names and key parts."""

PresetName = Literal["instant", "fast", "quality", "small", "paper"]
"""instant, fast, quality and small are ours; paper is the published method as published (worker/methods)."""

LABORATORY_PRESETS = ("paper-released", "paper-wide", "pfs", "hexplane", "without_mapf")
"""Variants of paper that versions before 0.3 took in requests. Only the laboratory trains them now
(worker/evaluate/variants)."""

BUDGETS_S: Mapping[PresetName, float] = {"instant": 5.5, "fast": 60.0, "quality": 240.0, "small": 30.0}
"""Seconds of training of our presets, where nothing else is asked for."""

Layout = Literal["auto", "endonerf", "stereomis", "sbs", "tb", "frames"]
"""How a clip's eyes, depths and masks are laid out (docs/conventions.md); auto looks for itself."""

MaskPolarity = Literal["auto", "tool", "tissue"]
"""What is bright in the masks."""

MaskSource = Literal["given", "auto", "none"]
"""Where masks of instruments come from. given: the clip's, if it has any, else those of this installation's segmenter,
if there is one. auto: the same, and with neither they are found by colour and depth. none: every pixel is tissue."""

PoseConvention = Literal["opengl", "llff"]
"""Axes of the poses in an EndoNeRF folder: as EndoNeRF writes them, or as LLFF does (docs/conventions.md)."""

Poses = Literal["auto", "given", "fixed", "estimate"]
"""Where the camera's poses come from: from the clip, from nowhere because the camera is fixed, or from the pictures.
auto takes the clip's; without any it looks whether the camera is fixed, and estimates its path if it is not."""

Eyes = Literal["left", "both"]
"""The eyes of a stereo clip that a model is trained on."""

Eye = Literal["left", "right"]
"""One of them."""

Keep = Literal["on", "off"]
"""Whether something is kept with a scene."""

UsedFrames = Literal["new", "all"]
"""The frames of a clip that a model may be trained on."""

DeviceName = Literal["auto", "cpu", "cuda"]
"""Where to compute; auto chooses the GPU if all of its requirements are met, otherwise the CPU."""

POSES_FILE = "poses_bounds.npy"
"""The poses that a clip in EndoNeRF layout brings."""

SUBMISSION = "submission.json"
LABELS = "labels.json"
"""Of a job in the spool, if its caller has labelled it."""
MANIFEST = "manifest.json"
SCENE = "scene.safetensors"
REPORT = "report.json"
CURVE = "curve.csv"
MASKS = "masks.zip"
"""The masks that were found, if any were: a PNG a frame, as `masks` of a clip are given."""
RECORDED = "recorded.zip"
"""Recorded frames and their masks, unless the caller wanted none (contract/store/recorded.py)."""
THUMBNAIL = "thumbnail.jpg"
"""A small picture for lists, once somebody has asked for it."""
RESUME = "resume.safetensors"
PREPARED = "prepared"
"""A folder: the clip with depth."""
KEPT = (RESUME, PREPARED)
"""What a stopped or killed job leaves for the next attempt."""
