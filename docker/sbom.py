"""`python docker/sbom.py build/sbom.json`: every component of this environment, as CycloneDX JSON.

cyclonedx-py lists what pip knows. pip does not know the libraries inside the wheels of PyAV, which read untrusted
video, and of OpenCV, which read untrusted pictures. So this program adds each of them with its hash, and each FFmpeg
with its release, by which one finds advisories.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import re
import subprocess
import sys
from importlib.metadata import files
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
CARRIERS = ("av", "opencv-contrib-python-headless")
CARRIED = re.compile(r"(?P<name>lib\w+)-\w+(-\w+)?(\.so)?[.-](?P<version>[\w.]+?)(\.so)?$")
"""As auditwheel names what it puts into a wheel: libavutil-431feb49.so.60.26.102."""


def carried_libraries(carrier: str) -> list[Path]:
    """The shared libraries inside a wheel.

    Raises:
        ValueError: it has none, as on systems for which wheels are built otherwise.
    """
    found = [Path(str(each.locate())) for each in files(carrier) or () if each.parent.name.endswith(".libs")]
    if not found:
        raise ValueError(f"{carrier} carries no libraries here; the bill would leave out what reads video")
    return sorted(found)


def component(carrier: str, path: Path) -> dict[str, Any]:
    """A carried library; its version is that of its interface where its maker counts the two apart."""
    named = CARRIED.match(path.name)
    if named is None:
        raise ValueError(f"{path.name} is named otherwise than what auditwheel puts into a wheel")
    return {
        "type": "library",
        "bom-ref": f"{carrier}/{path.name}",
        "name": named["name"],
        "version": named["version"],
        "description": f"carried by the wheel of {carrier}",
        "hashes": [{"alg": "SHA-256", "content": hashlib.sha256(path.read_bytes()).hexdigest()}],
    }


def ffmpeg(carrier: str, libraries: list[Path]) -> dict[str, Any]:
    """FFmpeg as a whole, with the release that its own libavutil names."""
    library = ctypes.CDLL(str(next(path for path in libraries if path.name.startswith("libavutil"))))
    library.av_version_info.restype = ctypes.c_char_p
    release = library.av_version_info().decode().removeprefix("n")
    return {
        "type": "library",
        "bom-ref": f"{carrier}/ffmpeg",
        "name": "ffmpeg",
        "version": release,
        "cpe": f"cpe:2.3:a:ffmpeg:ffmpeg:{release}:*:*:*:*:*:*:*",
        "description": f"carried by the wheel of {carrier}",
    }


def environment() -> dict[str, Any]:
    """What cyclonedx-py finds installed for this interpreter."""
    command = [sys.executable, "-m", "cyclonedx_py", "environment", "--output-format", "JSON", "--output-reproducible"]
    command += ["--pyproject", str(REPOSITORY / "pyproject.toml"), sys.executable]
    found = subprocess.run(command, check=True, capture_output=True, text=True)
    bill: dict[str, Any] = json.loads(found.stdout)
    return bill


def main(path: Path) -> None:
    """Write the bill of materials."""
    bill = environment()
    for carrier in CARRIERS:
        libraries = carried_libraries(carrier)
        bill["components"] += [ffmpeg(carrier, libraries), *(component(carrier, each) for each in libraries)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(bill, indent=1) + "\n")
    print(f"sbom: {path} names {len(bill['components'])} components")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
