"""The chain of the audit: what was changed is found, and a crash, a full disk or a rotation breaks nothing."""

from __future__ import annotations

import gzip
import hashlib
import multiprocessing
import re
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from contract.access import audit, chain
from contract.access.audit import AUDIT_FILE, HEAD_FILE, AuditAction, AuditEntry, AuditLog, utc_now
from contract.access.chain import START, CheckedFile, audit_lines, check_file, check_files, in_order
from intrasplat.errors import InputError
from intrasplat.files.disk_errors import StoreFullError
from tests.contract.stores import files_no_larger_than


def write(folder: Path, count: int = 1, mark: str = "a") -> Path:
    log = AuditLog(folder)
    for number in range(count):
        log.append(AuditEntry(time=utc_now(), action=AuditAction.VIEWED, tenant=mark, job_id=f"{number:032x}"))
    return folder / AUDIT_FILE


def is_intact(checked: CheckedFile) -> bool:
    return checked.broken_at is None


def rewritten(path: Path, change: Callable[[list[bytes]], list[bytes]]) -> CheckedFile:
    path.write_bytes(b"\n".join(change(list(audit_lines(path)))) + b"\n")
    return check_file(path)


def test_each_line_names_the_line_before_it_and_the_first_names_none(tmp_path: Path) -> None:
    lines = write(tmp_path, 4).read_bytes().splitlines()
    named = [re.match(rb'\{"chain":"([0-9a-f]{64})",', line) for line in lines]
    expected = [START, *(hashlib.sha256(line).hexdigest() for line in lines)]
    assert [each[1].decode() for each in named if each] == expected[:-1]
    checked = check_file(tmp_path / AUDIT_FILE)
    assert (checked.lines, checked.begins, checked.head, checked.unchained) == (4, START, expected[-1], [])
    assert is_intact(checked)


@pytest.mark.parametrize(
    ("change", "broken_at"),
    [
        (lambda lines: [*lines[:2], lines[2].replace(b"viewed", b"purged"), *lines[3:]], 4),
        (lambda lines: [*lines[:2], *lines[3:]], 3),
        (lambda lines: [*lines[:2], lines[0], *lines[2:]], 3),
        (lambda lines: [*lines[:2], b'{"time":"now"}', *lines[2:]], 4),
        (lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]], 3),
        (lambda lines: [lines[0].replace(b"viewed", b"purged"), *lines[1:]], 2),
    ],
    ids=["changed", "removed", "inserted", "inserted without a chain", "reordered", "the first changed"],
)
def test_the_first_line_that_does_not_follow_is_named(
    tmp_path: Path, change: Callable[[list[bytes]], list[bytes]], broken_at: int
) -> None:
    assert rewritten(write(tmp_path, 6), change).broken_at == broken_at


def test_lines_of_before_there_was_a_chain_are_told_and_sealed_by_the_first_that_has_one(tmp_path: Path) -> None:
    old = b"".join(b'{"time":"%d","action":"viewed","outcome":"ok"}\n' % number for number in range(300))
    (tmp_path / AUDIT_FILE).write_bytes(old)
    checked = check_file(write(tmp_path, 2))
    assert (checked.begins, checked.unchained, checked.lines) == (None, list(range(1, 301)), 302)
    assert is_intact(checked)
    assert rewritten(tmp_path / AUDIT_FILE, lambda lines: lines[1:]).broken_at == 300


@pytest.mark.parametrize("kept", [1, 9, 40, 100, 200])
def test_a_line_that_a_crash_has_cut_off_breaks_nothing_and_hides_nothing(tmp_path: Path, kept: int) -> None:
    whole = write(tmp_path, 3).read_bytes()
    last = whole.splitlines()[-1]
    path = tmp_path / AUDIT_FILE
    path.write_bytes(whole[: -len(last) - 1] + last[:kept])
    head = check_file(path).head
    write(tmp_path, 2)
    checked = check_file(path, [head])
    assert is_intact(checked)
    assert (checked.lines, checked.found) == (5, {head: 3})
    without_the_second = rewritten(path, lambda lines: [lines[0], *lines[2:]])
    assert not is_intact(without_the_second)


def test_a_line_that_lacks_its_newline_alone_is_chained_as_it_is(tmp_path: Path) -> None:
    path = write(tmp_path, 2)
    path.write_bytes(path.read_bytes()[:-1])
    checked = check_file(write(tmp_path))
    assert (checked.lines, checked.unchained) == (3, [])
    assert is_intact(checked)


def test_a_disk_that_takes_half_a_line_breaks_nothing_even_at_the_start_of_a_file(tmp_path: Path) -> None:
    path = write(tmp_path, 2)
    head = check_file(path).head
    path.rename(tmp_path / "audit.1")
    with files_no_larger_than(100), pytest.raises(StoreFullError):
        write(tmp_path)
    checked = check_file(write(tmp_path))
    assert (checked.begins, checked.lines, checked.unchained) == (head, 1, [])


def test_the_next_file_goes_on_where_the_one_that_was_moved_away_ended(tmp_path: Path) -> None:
    for number in (3, 2, 1):
        write(tmp_path, number).rename(tmp_path / f"audit.{number}")
    write(tmp_path)
    packed = tmp_path / "audit.3.gz"
    packed.write_bytes(gzip.compress((tmp_path / "audit.3").read_bytes()))
    paths = [tmp_path / AUDIT_FILE, tmp_path / "audit.1", tmp_path / "audit.2", packed]
    files = in_order(check_files(paths))
    assert [each.path for each in files] == paths[::-1]
    assert [each.begins for each in files] == [START, *(each.head for each in files[:-1])]


def test_the_head_is_taken_from_the_file_itself_while_there_is_one(tmp_path: Path) -> None:
    path = write(tmp_path, 2)
    (tmp_path / HEAD_FILE).write_text("f" * 64)
    assert is_intact(check_file(write(tmp_path)))
    assert (tmp_path / HEAD_FILE).read_text() == check_file(path).head
    (tmp_path / HEAD_FILE).write_bytes(b"\xff damaged")
    assert is_intact(check_file(write(tmp_path)))


def test_a_head_that_was_kept_tells_what_was_added_and_that_lines_are_gone(tmp_path: Path) -> None:
    path = write(tmp_path, 3)
    head = check_file(path).head
    assert check_file(path, [head]).found == {head: 3}
    assert check_file(write(tmp_path, 2), [head]).found == {head: 3}
    cut = rewritten(path, lambda lines: lines[:2])
    assert is_intact(cut)
    assert check_file(path, [head]).found == {}


def append_many(folder: Path) -> None:
    threads = [threading.Thread(target=write, args=(folder, 20)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_threads_and_processes_write_one_chain(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=append_many, args=(tmp_path,)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    checked = check_file(tmp_path / AUDIT_FILE)
    assert (checked.lines, checked.unchained) == (120, [])
    assert is_intact(checked)


def test_a_line_costs_a_look_at_the_end_of_the_file_whatever_its_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, 40)
    read: list[int] = []
    pread = chain.os.pread
    monkeypatch.setattr(chain.os, "pread", lambda *place: (read.append(place[1]), pread(*place))[1])
    write(tmp_path)
    assert audit.os is chain.os
    assert sum(read) <= chain.TAIL_BYTES + len(START) + 1


@pytest.mark.parametrize("before", [0, 1, 70, 500])
@pytest.mark.parametrize("end", [b"\n", b""])
def test_many_lines_without_a_chain_are_read_in_pieces_wherever_the_last_chained_line_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: int, end: bytes
) -> None:
    monkeypatch.setattr(chain, "PIECE_BYTES", 200, raising=False)
    read: list[int] = []
    pread = chain.os.pread
    old, path = b'{"time":"then"}\n', tmp_path / AUDIT_FILE
    for after in range(0, 420, 3):
        path.write_bytes(old * before)
        write(tmp_path)
        with path.open("ab") as file:
            file.write(b"x" * after + b"\n" + old * 300 + b"cut" + end)
        with path.open("rb") as file, monkeypatch.context() as counting:
            counting.setattr(chain.os, "pread", lambda *place: (read.append(place[1]), pread(*place))[1])
            assert chain.head_of(file.fileno()) == check_file(path).head
    assert max(read) <= chain.TAIL_BYTES


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "audit.gz").write_bytes(b"no gzip")
    damaged = bytearray(gzip.compress(b"a line of an audit\n" * 100))
    damaged[14] ^= 0xFF
    (tmp_path / "damaged.gz").write_bytes(damaged)
    for name in ("audit.gz", "damaged.gz", "absent", "."):
        with pytest.raises(InputError, match="cannot be read"):
            check_file(tmp_path / name)
