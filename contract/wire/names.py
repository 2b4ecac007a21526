"""Names that every process uses alike: what a caller chooses among, and the files of a job. Nothing but the standard
library is needed to read them."""

from __future__ import annotations

from typing import Literal

PresetName = Literal[
    "instant", "fast", "quality", "small", "paper", "paper-released", "paper-wide", "pfs", "hexplane", "without_mapf"
]
"""instant, fast, quality and small are ours; paper is the published method as published; the others are compared with
it (worker/train/presets.py)."""

Layout = Literal["auto", "endonerf", "stereomis", "sbs", "tb", "frames"]
"""How a clip's eyes, depths and masks are laid out (docs/conventions.md); auto looks for itself."""

MaskPolarity = Literal["auto", "tool", "tissue"]
"""What is bright in the masks."""

PoseConvention = Literal["opengl", "llff"]
"""Axes of the poses in an EndoNeRF folder: as EndoNeRF writes them, or as LLFF does (docs/conventions.md)."""

Eyes = Literal["left", "both"]
UsedFrames = Literal["new", "all"]
"""The eyes of a stereo clip that a model is trained on."""

DeviceName = Literal["auto", "cpu", "cuda"]
"""Where to compute; auto chooses the GPU if all of its requirements are met, otherwise the CPU."""

SUBMISSION = "submission.json"
MANIFEST = "manifest.json"
REPORT = "report.json"
CURVE = "curve.csv"
RESUME = "resume.safetensors"
PREPARED = "prepared"
"""A folder: the clip with depth."""
KEPT = (RESUME, PREPARED)
"""What a stopped or killed job leaves for the next attempt."""
