"""The import rules: which package may import which, in what order its folders are read, and what stays light.

intrasplat <- contract <- worker, service, client; those three never import each other, and nothing that is installed
imports lab or tests. intrasplat_client lies in client/ but is packed alone, so it imports no other package of ours;
client imports it. Inside a package a folder or module imports only those that stand before it in ORDER, so that the
order of imports is the order of reading.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
MAY_IMPORT = {
    "intrasplat": {"intrasplat"},
    "contract": {"intrasplat", "contract"},
    "worker": {"intrasplat", "contract", "worker"},
    "service": {"intrasplat", "contract", "service"},
    "client": {"intrasplat", "contract", "client", "intrasplat_client"},
    "intrasplat_client": {"intrasplat_client"},
}
FOLDERS = {"intrasplat_client": REPOSITORY / "client" / "intrasplat_client"}
"""Of packages that do not lie in the repository's root."""
ORDER = {
    "intrasplat": (
        "errors",
        "codes",
        "names",
        "version",
        "server_parts",
        "notices",
        "options",
        "report",
        "pose",
        "picture",
        "colours",
        "formats",
        "measuring",
        "files",
        "machine",
        "intake",
        "camera",
        "clip",
        "decode",
        "instruments",
        "stereo",
        "motion",
        "poses",
        "fusion",
        "splat",
        "scene",
        "methods",
        "train",
        "view",
        "export",
        "quality",
        "outcome",
        "pipeline",
        "recording",
        "reconstruction",
        "live",
        "commands",
        "__main__",
    ),
    "contract": ("wire", "runtime", "store", "queue", "access", "backup"),
}
"""In the order in which they are read: folders, and modules directly in the package."""
FRAMEWORKS_BANNED = {
    "contract": {"torch", "numba", "cv2", "scipy", "matplotlib", "fastapi", "starlette", "uvicorn"},
    "intrasplat": {"fastapi", "starlette", "uvicorn", "httpx", "redis", "zmq", "websockets"},
    "worker": {"fastapi", "starlette", "uvicorn", "httpx"},
    "service": {"torch", "numba", "cv2", "scipy", "matplotlib"},
    "client": {"torch", "numba", "cv2", "scipy", "fastapi"},  # matplotlib draws the demo's charts
    "intrasplat_client": {"torch", "numba", "cv2", "scipy", "matplotlib", "fastapi", "starlette", "uvicorn", "redis"},
}


@dataclass(frozen=True)
class Import:
    """One import statement: `module` is absolute; `level` counts the dots of a relative one."""

    path: Path
    line: int
    module: str
    level: int

    def __str__(self) -> str:
        return f"{self.path.relative_to(REPOSITORY)}:{self.line} imports {'.' * self.level}{self.module}"


def python_files(package: str) -> list[Path]:
    folder = FOLDERS.get(package, REPOSITORY / package)
    others = [each for each in FOLDERS.values() if each != folder]
    return sorted(path for path in folder.rglob("*.py") if not any(path.is_relative_to(each) for each in others))


def imports_of_source(path: Path, source: str) -> Iterator[Import]:
    """Every import, also inside functions and under TYPE_CHECKING. `from a import b` counts as a and as a.b."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (Import(path, node.lineno, each.name, 0) for each in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            yield Import(path, node.lineno, base, node.level)
            yield from (Import(path, node.lineno, f"{base}.{each.name}", node.level) for each in node.names)


def imports_of(package: str) -> Iterator[Import]:
    for path in python_files(package):
        yield from imports_of_source(path, path.read_text(encoding="utf-8"))


def place_of(module: str) -> str:
    """intrasplat.splat.cpu.blend belongs to splat; worker itself and other packages' modules to no folder ("")."""
    package, *rest = module.split(".")
    return rest[0] if rest and package in ORDER else ""


def module_of(path: Path) -> str:
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def is_out_of_order(importer: str, imported: str) -> bool:
    """Whether a module imports one of a folder that stands later in the same package."""
    package, folder, other = importer.split(".")[0], place_of(importer), place_of(imported)
    if imported.split(".")[0] != package or folder not in ORDER[package] or other not in ORDER[package]:
        return False
    return ORDER[package].index(other) > ORDER[package].index(folder)


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_a_package_imports_only_packages_below_it(package: str) -> None:
    forbidden = MAY_IMPORT.keys() - MAY_IMPORT[package] | {"tests", "lab"}
    assert [str(each) for each in imports_of(package) if each.module.split(".")[0] in forbidden] == []


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_a_package_names_no_framework_that_is_not_its_business(package: str) -> None:
    banned = FRAMEWORKS_BANNED[package]
    assert [str(each) for each in imports_of(package) if each.module.split(".")[0] in banned] == []


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_imports_are_absolute(package: str) -> None:
    assert [str(each) for each in imports_of(package) if each.level] == []


@pytest.mark.parametrize("package", ORDER)
def test_every_module_has_its_place(package: str) -> None:
    unplaced = {place_of(module_of(path)) for path in python_files(package)} - {"", *ORDER[package]}
    assert unplaced == set(), f"add {sorted(unplaced)} to ORDER in {Path(__file__).name}, where it is to be read"


@pytest.mark.parametrize("package", ORDER)
def test_a_module_imports_only_what_stands_above_it(package: str) -> None:
    assert [str(each) for each in imports_of(package) if is_out_of_order(module_of(each.path), each.module)] == []


def test_the_checks_see_imports_inside_functions_and_of_names() -> None:
    source = "def late() -> None:\n    from intrasplat import train\n"
    modules = [each.module for each in imports_of_source(REPOSITORY / "intrasplat" / "splat" / "loss.py", source)]
    assert "intrasplat.train" in modules
    assert is_out_of_order("intrasplat.splat.loss", "intrasplat.train")
    assert not is_out_of_order("intrasplat.train.loop", "intrasplat.splat")


@pytest.mark.parametrize(
    "module", ["intrasplat", "intrasplat.__main__", "contract", "client.cli", "intrasplat_client", "service.app"]
)
def test_importing_it_loads_no_torch(module: str) -> None:
    heavy = ("torch", "numba", "cv2", "scipy", "matplotlib", "worker")
    program = f"import sys, {module}; print(*(each for each in {heavy!r} if each in sys.modules))"
    result = subprocess.run(
        [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []
