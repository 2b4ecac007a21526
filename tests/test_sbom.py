"""The bill of materials names what the three distributions need, the video decoder inside a wheel included."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.test_repository import REPOSITORY, project, requirement_name


def without_parsing_addresses(folder: Path) -> dict[str, str]:
    """The environment of a process whose jsonschema finds no parser of web addresses, and so checks all but those of
    the packages that others made: parsing those takes nine tenths of the time.
    """
    folder.mkdir()
    (folder / "rfc3987_syntax.py").write_text("raise ImportError\n")
    return {**os.environ, "PYTHONPATH": str(folder)}


def test_the_bill_names_every_direct_dependency_and_the_ffmpeg_that_reads_clips(tmp_path: Path) -> None:
    path = tmp_path / "build" / "sbom.json"
    command = [sys.executable, REPOSITORY / "docker" / "sbom.py", path]
    subprocess.run(command, env=without_parsing_addresses(tmp_path / "absent"), check=True, timeout=120)
    bill = json.loads(path.read_text())
    assert bill["bomFormat"] == "CycloneDX"
    versions = {each["name"].lower().replace("_", "-"): each["version"] for each in bill["components"]}
    for distribution in (project(), project("service"), project("client")):
        needed = {requirement_name(each) for each in distribution["dependencies"]}
        assert {distribution["name"], *needed} - versions.keys() == set()
    carried = {each["bom-ref"]: each["version"] for each in bill["components"] if each["name"] == "ffmpeg"}
    assert carried.keys() == {"av/ffmpeg", "opencv-contrib-python-headless/ffmpeg"}
    assert all(int(version.split(".")[0]) >= 8 for version in carried.values())
    assert {"libavcodec", "libavformat", "libswscale"} <= versions.keys()
