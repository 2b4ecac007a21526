"""`intrasplat doctor`: what is installed, which queue and device would be used, what is missing and how to fix it."""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from intrasplat.commands.exits import ExitCode
from intrasplat.errors import IntrasplatError, UnavailableError
from intrasplat.machine.cores import cores
from intrasplat.machine.gpu import Gpu, find_gpu, triton_range
from intrasplat.server_parts import server_part

PACKAGES = (
    "torch",
    "numpy",
    "numba",
    "scipy",
    "opencv-contrib-python-headless",
    "av",
    "pydantic",
    "safetensors",
)
OPTIONAL_PACKAGES = {
    "triton": f"only needed for a GPU, {triton_range()}",
    "onnxruntime": "only needed for a segmenter of your own",
    "scikit-image": "only needed to export meshes",
    "matplotlib": "only needed for charts",
    "pillow": "only needed for charts",
}
INSTALL_REMEDY = "in a checkout, run `make setup`, or `pip install .`"

FIXED_FFMPEG = (8, 1, 2)
"""First FFmpeg without CVE-2026-8461, a write out of bounds in one of its video decoders."""

AV_REQUIREMENT = "pip install 'av>=18.1,<19'"

MIN_PYTHON = (3, 11)


@dataclass(frozen=True)
class Diagnosis:
    """One line of the doctor's output. It has a remedy exactly when the user should do something."""

    topic: str
    found: str
    remedy: str | None = None
    blocks: bool = False
    """Whether intrasplat cannot work in this state."""


def examine(device: str = "auto", segmenter: Path | None = None) -> list[Diagnosis]:
    """Findings about everything that the library needs, in the order in which they are printed.

    Args:
        device: the setting to examine: auto, cpu or cuda.
        segmenter: an ONNX file that finds instruments; None: there is none.
    """
    return [
        *_python(),
        *package_findings(PACKAGES, OPTIONAL_PACKAGES),
        *_device(device),
        *_video(),
        *_segmenter(segmenter),
    ]


def format_findings(findings: list[Diagnosis]) -> str:
    """A line for each finding, with its remedy below."""
    lines = []
    for finding in findings:
        mark = "missing" if finding.blocks else ("look" if finding.remedy else "ok")
        lines.append(f"{mark:<8}{finding.topic:<41}{finding.found}")
        if finding.remedy:
            lines.append(f"{'':<8}{'':<41}-> {finding.remedy}")
    return "\n".join(lines)


def _python() -> list[Diagnosis]:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {cores()} cores"
    remedy = None if sys.version_info >= MIN_PYTHON else "install Python 3.11 or newer"
    return [Diagnosis("python", found, remedy, blocks=remedy is not None)]


def package_findings(required: Sequence[str], optional: Mapping[str, str]) -> list[Diagnosis]:
    """A finding for each distribution, with its version. optional: the purpose of each optional distribution."""
    findings = []
    for name in (*required, *optional):
        try:
            findings.append(Diagnosis(name, version(name)))
        except PackageNotFoundError:
            if name in optional:
                findings.append(Diagnosis(name, f"not installed; {optional[name]}"))
            else:
                findings.append(Diagnosis(name, "not installed", INSTALL_REMEDY, blocks=True))
    return findings


def _device(asked: str) -> list[Diagnosis]:
    try:
        return [device_finding(asked, find_gpu())]
    except ImportError:
        return []  # said above


def device_finding(asked: str, gpu: Gpu) -> Diagnosis:
    """The device that training would use with this setting and this GPU."""
    backend = importlib.import_module("intrasplat.splat.backend")
    try:
        device = backend.choose_device(asked, gpu, cpu_by=backend.CPU_BY_VARIABLE)
    except UnavailableError as error:
        return Diagnosis("device", error.problem, error.remedy, blocks=True)
    if device.kind == "cuda":
        return Diagnosis("device", str(device))
    found = f"cpu, {cores()} threads"
    if asked == "auto" and gpu.name is not None:
        return Diagnosis("device", f"{found} (the {gpu.name} is not used: {gpu.missing})", f"{gpu.remedy}.")
    return Diagnosis("device", f"{found} ({gpu.missing or 'the GPU is not asked for'})")


def _video() -> list[Diagnosis]:
    try:
        found = str(importlib.import_module("av").ffmpeg_version_info)
    except ImportError:
        return []  # said above
    return [video_finding(found)]


def video_finding(release: str) -> Diagnosis:
    """The decoder of videos, by the release that PyAV's FFmpeg names."""
    numbers = re.match(r"n?(\d+(?:\.\d+)+)", release)
    if numbers is None:
        return Diagnosis("video decoder", f"FFmpeg {release}", "make sure it is 8.1.2 or newer (CVE-2026-8461)")
    is_fixed = tuple(map(int, numbers[1].split("."))) >= FIXED_FFMPEG
    remedy = None if is_fixed else f"open to CVE-2026-8461: {AV_REQUIREMENT}"
    return Diagnosis("video decoder", f"FFmpeg {numbers[1]}", remedy)


def _segmenter(path: Path | None) -> list[Diagnosis]:
    if path is None:
        return []
    from intrasplat.instruments import load_segmenter  # needs packages that may be missing

    try:
        load_segmenter(path)
    except UnavailableError as error:
        return [Diagnosis("segmenter", error.problem, error.remedy, blocks=True)]
    return [Diagnosis("segmenter", str(path))]


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """doctor has no options."""


def run_cli(options: argparse.Namespace) -> int:
    """Print the findings, also those of an installed server; return UNAVAILABLE if something required is missing."""
    segmenter = os.environ.get("INTRASPLAT_SEGMENTER")
    findings = examine(os.environ.get("INTRASPLAT_DEVICE") or "auto", Path(segmenter) if segmenter else None)
    server = server_part("doctor")
    try:
        findings += [] if server is None else server()
    except IntrasplatError as error:
        findings.append(Diagnosis("settings", str(error), "correct them", blocks=True))
    print(format_findings(findings))
    blocking = sum(finding.blocks for finding in findings)
    print(f"\n{blocking} missing." if blocking else "\nintrasplat can work here.")
    return ExitCode.UNAVAILABLE if blocking else ExitCode.OK
