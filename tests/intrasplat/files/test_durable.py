"""A file or a folder appears whole or not at all, and leaves nothing beside it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from intrasplat.files import durable
from intrasplat.files.durable import FOR_ALL, move_folder, replace_file
from tests.contract.stores import files_no_larger_than


def test_a_file_is_replaced_whole_and_its_owner_alone_may_read_it(tmp_path: Path) -> None:
    for content in (b"old", b"new"):
        replace_file(tmp_path / "file", content)
        assert (tmp_path / "file").read_bytes() == content
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o600
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_file_for_all_obeys_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        replace_file(tmp_path / "file", b"content", FOR_ALL)
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640


def test_a_full_disk_leaves_the_old_file_alone(tmp_path: Path) -> None:
    replace_file(tmp_path / "file", b"old")
    with files_no_larger_than(64), pytest.raises(OSError, match="File too large"):
        replace_file(tmp_path / "file", b"n" * 65)
    assert (tmp_path / "file").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_what_a_crash_left_is_written_over(tmp_path: Path) -> None:
    (tmp_path / ".file.new").write_bytes(b"half of something longer")
    replace_file(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_folder_is_moved_with_all_that_is_in_it(tmp_path: Path) -> None:
    (tmp_path / "source" / "inner").mkdir(parents=True)
    (tmp_path / "source" / "inner" / "file").write_bytes(b"content")
    move_folder(tmp_path / "source", tmp_path / "target")
    assert (tmp_path / "target" / "inner" / "file").read_bytes() == b"content"
    assert not (tmp_path / "source").exists()


def test_a_folder_whose_move_cannot_be_flushed_is_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flush = durable.flush

    def failing(path: Path) -> None:
        if path == tmp_path:
            raise OSError("the disk fails")
        flush(path)

    (tmp_path / "source").mkdir()
    monkeypatch.setattr(durable, "flush", failing)
    with pytest.raises(OSError, match="the disk fails"):
        move_folder(tmp_path / "source", tmp_path / "target")
    assert (tmp_path / "source").is_dir()
