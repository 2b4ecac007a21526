"""`python requirements.py s3,mesh`: what pyproject.toml, beside it, asks for with these extras, a line each."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path


def requirements(pyproject: Path, extras: list[str]) -> list[str]:
    """The project's requirements and those of the extras; KeyError: there is no such extra."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    return [*project["dependencies"], *(each for name in extras for each in project["optional-dependencies"][name])]


if __name__ == "__main__":
    print(*requirements(Path("pyproject.toml"), sys.argv[1].split(",")), sep="\n")
