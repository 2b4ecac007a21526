"""Every script has its file, a header that says what it does, and a place in the wheel."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from contract.queue.lua import NAMES, load_script

REPOSITORY = Path(__file__).resolve().parents[3]


def test_the_files_are_those_that_the_queue_runs() -> None:
    files = {path.stem for path in (REPOSITORY / "contract" / "queue" / "scripts").iterdir()}
    assert files == {*NAMES, "common"}


@pytest.mark.parametrize("name", NAMES)
def test_a_script_begins_with_its_flags_and_says_what_it_does(name: str) -> None:
    text = load_script(name)
    assert text.startswith("#!lua")
    assert f"\n-- {name.upper()}: " in text
    assert all(f"\n-- {part}" in text for part in ("Keys", "Answer"))


def test_the_wheel_carries_the_scripts() -> None:
    project = tomllib.loads((REPOSITORY / "service" / "pyproject.toml").read_text())
    assert "scripts/*.lua" in project["tool"]["setuptools"]["package-data"]["contract.queue"]
