"""Folders that change while a backup copies them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from contract.backup.copier import _paths_below


@pytest.mark.parametrize("is_gone", [False, True])
def test_a_folder_that_is_removed_while_it_is_read_is_none_and_one_below_it_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_gone: bool
) -> None:
    (tmp_path / "job").mkdir()
    (tmp_path / "job" / "clip.mp4").write_bytes(b"clip")
    read, calls = Path.rglob, []

    def rglob(folder: Path, pattern: str) -> Iterator[Path]:
        calls.append(folder)
        if len(calls) == 1:
            if is_gone:
                shutil.rmtree(folder)
            raise FileNotFoundError(folder)
        return iter(list(read(folder, pattern)))

    monkeypatch.setattr(Path, "rglob", rglob)
    found = [path.name for path in _paths_below(tmp_path / "job")]
    assert found == ([] if is_gone else ["clip.mp4"])
