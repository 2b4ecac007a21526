"""The client's wheel: small, and without the names and the packages that only a service or a worker needs."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from email.parser import Parser
from pathlib import Path
from typing import Any

import pytest

import client
from tests.test_layers import imports_of
from tests.test_repository import REPOSITORY, project, requirement_name

FOLDER = Path(client.__file__).parent
BUILD = "import sys; from setuptools import build_meta; print(build_meta.build_wheel(sys.argv[1]))"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[zipfile.ZipFile]:
    """The wheel that `pip install ./client` installs."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "LICENSE"):
        shutil.copy(FOLDER / name, source)
    shutil.copytree(FOLDER / "intrasplat_client", source / "intrasplat_client")
    command = [sys.executable, "-c", BUILD, str(source)]
    built = subprocess.run(command, cwd=source, capture_output=True, text=True, check=True, timeout=120)
    with zipfile.ZipFile(source / built.stdout.splitlines()[-1]) as file:
        yield file


def requirements(wheel: zipfile.ZipFile) -> set[str]:
    """What the wheel needs, without its extras."""
    (path,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    found = Parser().parsestr(wheel.read(path).decode()).get_all("Requires-Dist", [])
    return {requirement_name(each) for each in found if "extra ==" not in each}


def test_it_needs_three_packages(wheel: zipfile.ZipFile) -> None:
    assert requirements(wheel) == {"httpx", "pydantic", "websockets"}


def test_it_brings_one_top_level_name_and_its_types(wheel: zipfile.ZipFile) -> None:
    names = wheel.namelist()
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"intrasplat_client"}
    assert "intrasplat_client/py.typed" in names
    packed = {Path(name).name for name in names if name.startswith("intrasplat_client/")}
    assert packed == {path.name for path in (FOLDER / "intrasplat_client").iterdir() if path.is_file()}


def test_it_imports_what_it_needs_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    needed = requirements(wheel) | {"anyio", "typing_extensions"}  # httpx brings the one, pydantic the other
    modules = {each.module.split(".")[0] for each in imports_of("intrasplat_client")}
    assert modules - sys.stdlib_module_names - {"intrasplat_client", "numpy"} <= needed


def test_it_has_the_version_and_the_ranges_of_the_whole_project() -> None:
    document = tomllib.loads((FOLDER / "pyproject.toml").read_text(encoding="utf-8"))
    table: dict[str, Any] = document["project"]
    assert table["version"] == project()["version"]
    assert table["requires-python"] == project()["requires-python"]
    assert set(table["dependencies"]) <= set(project("service")["dependencies"])
    assert (FOLDER / "LICENSE").read_text(encoding="utf-8") == (REPOSITORY / "LICENSE").read_text(encoding="utf-8")
