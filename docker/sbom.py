"""`python docker/sbom.py build/sbom.json`: every component of this environment, as CycloneDX JSON.

cyclonedx-py lists what pip knows. pip does not know the libraries inside OpenCV's wheel, which read untrusted video
(FFmpeg above all). So this program adds each of them with its hash, and FFmpeg with its release, by which one finds
advisories.
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
CARRIER = "opencv-contrib-python-headless"
CARRIED = re.compile(r"(?P<name>lib\w+)-\w+(-\w+)?(\.so)?[.-](?P<version>[\w.]+?)(\.so)?$")
"""As auditwheel names what it puts into a wheel: libavutil-431feb49.so.60.26.102."""


def carried_libraries() -> list[Path]:
    """The shared libraries inside OpenCV's wheel.

    Raises:
        ValueError: it has none, as on systems for which wheels are built otherwise.
    """
    found = [Path(str(each.locate())) for each in files(CARRIER) or () if each.parent.name.endswith(".libs")]
    if not found:
        raise ValueError(f"{CARRIER} carries no libraries here; the bill would leave out what reads video")
    return sorted(found)


def component(path: Path) -> dict[str, Any]:
    """A carried library; its version is that of its interface where its maker counts the two apart."""
    named = CARRIED.match(path.name)
    if named is None:
        raise ValueError(f"{path.name} is named otherwise than what auditwheel puts into a wheel")
    return {
        "type": "library",
        "bom-ref": f"{CARRIER}/{path.name}",
        "name": named["name"],
        "version": named["version"],
        "description": f"carried by the wheel of {CARRIER}",
        "hashes": [{"alg": "SHA-256", "content": hashlib.sha256(path.read_bytes()).hexdigest()}],
    }


def ffmpeg(libraries: list[Path]) -> dict[str, Any]:
    """FFmpeg as a whole, with the release that its own libavutil names."""
    library = ctypes.CDLL(str(next(path for path in libraries if path.name.startswith("libavutil"))))
    library.av_version_info.restype = ctypes.c_char_p
    release = library.av_version_info().decode().removeprefix("n")
    return {
        "type": "library",
        "bom-ref": f"{CARRIER}/ffmpeg",
        "name": "ffmpeg",
        "version": release,
        "cpe": f"cpe:2.3:a:ffmpeg:ffmpeg:{release}:*:*:*:*:*:*:*",
        "description": f"carried by the wheel of {CARRIER}",
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
    bill, libraries = environment(), carried_libraries()
    bill["components"] += [ffmpeg(libraries), *map(component, libraries)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(bill, indent=1) + "\n")
    print(f"sbom: {path} names {len(bill['components'])} components")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
