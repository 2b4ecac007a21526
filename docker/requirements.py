"""`python requirements.py s3,mesh`: what library and server ask for with these extras, a line each.

Their pyproject.toml files lie here and in service/.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

OURS = ("intrasplat==", "intrasplat-client==")


def requirements(folder: Path, extras: list[str]) -> list[str]:
    """The requirements of both and of the extras, without our own distributions; KeyError: there is no such extra."""
    projects = [
        tomllib.loads((folder / path).read_text(encoding="utf-8"))["project"]
        for path in ("pyproject.toml", "service/pyproject.toml")
    ]
    known = {name: each for project in projects for name, each in project["optional-dependencies"].items()}
    needed = [each for project in projects for each in project["dependencies"] if not each.startswith(OURS)]
    return [*dict.fromkeys(needed), *(each for name in extras for each in known[name])]


if __name__ == "__main__":
    print(*requirements(Path(), sys.argv[1].split(",")), sep="\n")
