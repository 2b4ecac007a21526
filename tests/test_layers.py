"""The import rules: which package may import which, in what order the worker is read, and what stays light.

contract <- worker, service, client; those three never import each other. Inside worker/ a stage imports only stages
that stand before it in STAGES, so that the order of imports is the order of reading.
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
    "contract": {"contract"},
    "worker": {"contract", "worker"},
    "service": {"contract", "service"},
    "client": {"contract", "client"},
}
STAGES = (
    "hooks",
    "opencv",
    "cache",
    "clip",
    "calibration",
    "decode",
    "stereo",
    "fusion",
    "motion",
    "gaussians",
    "deformation",
    "loss",
    "optimize",
    "raster",
    "model",
    "unfused",
    "gpu",
    "backend",
    "metrics",
    "baselines",
    "densify",
    "differences",
    "rangecoder",
    "compact",
    "checkpoint",
    "export",
    "presets",
    "request",
    "trials",
    "capacity",
    "start",
    "targets",
    "visibility",
    "schedule",
    "average",
    "train",
    "looking",
    "prepare",
    "resume",
    "render",
    "shrink",
    "encode",
    "doubts",
    "quality",
    "pipeline",
    "phantom",
    "evaluate",
    "serve",
    "snapshot",
    "pace",
    "views",
    "orders",
    "channel",
    "faults",
    "device",
    "liveness",
    "heartbeat",
    "child",
    "consume",
    "supervisor",
    "doctor",
    "__main__",
)
FRAMEWORKS_BANNED = {
    "contract": {"torch", "numba", "cv2", "scipy", "matplotlib", "fastapi", "starlette", "uvicorn"},
    "worker": {"fastapi", "starlette", "uvicorn", "httpx"},
    "service": {"torch", "numba", "cv2", "scipy", "matplotlib"},
    "client": {"torch", "numba", "cv2", "scipy", "fastapi"},  # matplotlib draws the demo's charts
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
    return sorted((REPOSITORY / package).rglob("*.py"))


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


def stage_of_file(path: Path) -> str:
    """worker/raster/cpu/blend.py belongs to raster, worker/train.py to train, worker/__init__.py to no stage."""
    first = path.relative_to(REPOSITORY / "worker").parts[0]
    return "" if first == "__init__.py" else first.removesuffix(".py")


def stage_of_module(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if parts[0] == "worker" and len(parts) > 1 else None


def is_out_of_order(importer: str, imported: str) -> bool:
    return STAGES.index(imported) > STAGES.index(importer)


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_a_package_imports_only_packages_below_it(package: str) -> None:
    forbidden = MAY_IMPORT.keys() - MAY_IMPORT[package] | {"tests", "benchmarks"}
    assert [str(each) for each in imports_of(package) if each.module.split(".")[0] in forbidden] == []


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_a_package_names_no_framework_that_is_not_its_business(package: str) -> None:
    banned = FRAMEWORKS_BANNED[package]
    assert [str(each) for each in imports_of(package) if each.module.split(".")[0] in banned] == []


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_imports_are_absolute(package: str) -> None:
    assert [str(each) for each in imports_of(package) if each.level] == []


def test_every_module_of_the_worker_has_a_place_in_the_order() -> None:
    unplaced = {stage_of_file(path) for path in python_files("worker")} - {"", *STAGES}
    assert unplaced == set(), f"add {sorted(unplaced)} to STAGES in {Path(__file__).name}, where it is to be read"


def test_a_stage_imports_only_earlier_stages() -> None:
    wrong = []
    for each in imports_of("worker"):
        importer, imported = stage_of_file(each.path), stage_of_module(each.module)
        if importer in STAGES and imported in STAGES and is_out_of_order(importer, imported):
            wrong.append(str(each))
    assert wrong == []


def test_the_checks_see_imports_inside_functions_and_of_names() -> None:
    source = "def late() -> None:\n    from worker import train\n"
    modules = [each.module for each in imports_of_source(REPOSITORY / "worker" / "loss.py", source)]
    assert "worker.train" in modules
    assert is_out_of_order("loss", "train")
    assert not is_out_of_order("train", "loss")


@pytest.mark.parametrize("module", ["contract", "client", "client.cli", "service.app"])
def test_importing_it_loads_no_torch(module: str) -> None:
    heavy = ("torch", "numba", "cv2", "scipy", "matplotlib", "worker")
    program = f"import sys, {module}; print(*(each for each in {heavy!r} if each in sys.modules))"
    result = subprocess.run(
        [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []
