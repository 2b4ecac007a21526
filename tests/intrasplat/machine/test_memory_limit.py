"""The memory that this process may use: the machine's, or less where its control groups are limited."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from intrasplat.machine.memory_limit import memory_bytes

GIB = 1024**3
MACHINE_BYTES = 64 * GIB


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine of MACHINE_BYTES."""
    monkeypatch.setattr(os, "sysconf", {"SC_PAGE_SIZE": 1, "SC_PHYS_PAGES": MACHINE_BYTES}.__getitem__)


def found(folder: Path, own: str, limits: dict[str, str]) -> int | None:
    for name, limit in limits.items():
        path = folder / "groups" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(limit + "\n")
    (folder / "own").write_text(own)
    return memory_bytes(folder / "groups", folder / "own")


@pytest.mark.parametrize(
    ("own", "limits", "expected"),
    [
        ("0::/\n", {"memory.max": str(8 * GIB)}, 8 * GIB),
        ("0::/\n", {"memory.max": "max"}, MACHINE_BYTES),
        ("0::/\n", {"memory.max": str(128 * GIB)}, MACHINE_BYTES),
        ("0::/\n", {}, MACHINE_BYTES),
        (
            "0::/system.slice/intrasplat.service\n",
            {"system.slice/memory.max": str(2 * GIB), "system.slice/intrasplat.service/memory.max": "max"},
            2 * GIB,
        ),
        ("0::/../../other\n", {"memory.max": str(8 * GIB)}, 8 * GIB),
        ("5:cpu:/\n4:memory:/docker/f00\n0::/\n", {"memory/memory.limit_in_bytes": str(8 * GIB)}, 8 * GIB),
        ("4:memory:/\n", {"memory/memory.limit_in_bytes": "9223372036854771712"}, MACHINE_BYTES),
    ],
)
def test_the_least_limit_of_the_control_groups_counts_if_it_is_less_than_the_machine_has(
    tmp_path: Path, own: str, limits: dict[str, str], expected: int
) -> None:
    assert found(tmp_path, own, limits) == expected


def test_where_there_are_no_control_groups_the_machine_tells(tmp_path: Path) -> None:
    assert memory_bytes(tmp_path / "groups", tmp_path / "own") == MACHINE_BYTES


@pytest.mark.parametrize("pages", [-1, None])
def test_where_nothing_tells_nothing_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pages: int | None
) -> None:
    if pages is None:
        monkeypatch.delattr(os, "sysconf")
    else:
        monkeypatch.setattr(os, "sysconf", {"SC_PAGE_SIZE": 1, "SC_PHYS_PAGES": pages}.__getitem__)
    assert memory_bytes(tmp_path / "groups", tmp_path / "own") is None
