"""Arrays in files: they hold what is written, also when the process has let go of it."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from intrasplat.errors import UnavailableError
from intrasplat.machine.mapped import let_go, mapped_zeros


def resident_bytes() -> int:
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    return int(status["VmRSS"].split()[0]) * 1024


def test_what_was_let_go_is_still_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    array = mapped_zeros((5, 33, 101), np.float32)
    assert not array.any()
    expected = np.random.default_rng(0).random(array.shape).astype(np.float32)
    array[:] = expected
    for frame in array:
        let_go(frame)
    np.testing.assert_array_equal(array, expected)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the kernel tells resident memory on Linux")
def test_resident_memory_falls_by_what_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    array = mapped_zeros((16, 1 << 20), np.uint8)
    before = resident_bytes()
    array[:] = 7
    touched = resident_bytes()
    for frame in array[4:]:
        let_go(frame)
    assert touched - before >= 15 << 20
    assert touched - resident_bytes() >= 11 << 20
    assert (array == 7).all()


def test_other_arrays_are_left_alone() -> None:
    array = np.ones((3, 5000))
    let_go(array[1])
    assert array.all()


def test_a_full_disk_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(UnavailableError, match="The disk is full: 3 MiB"):
        mapped_zeros((3, 1 << 20), np.uint8)
