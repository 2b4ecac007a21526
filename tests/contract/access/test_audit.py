"""The audit: nothing it was given is lost, on a full disk or after a cut either."""

from __future__ import annotations

import json
import multiprocessing
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from contract.access.audit import (
    AUDIT_FILE,
    RESERVE_BYTES,
    RESERVE_FILE,
    RESERVE_PIECE_BYTES,
    AuditAction,
    AuditEntry,
    AuditLog,
    utc_now,
)
from contract.store.disk_errors import StoreFullError
from contract.wire.errors import UnavailableError
from tests.contract.stores import files_no_larger_than


def entry(job_id: str = "a" * 32) -> AuditEntry:
    return AuditEntry(time=utc_now(), action=AuditAction.VIEWED, tenant="t", job_id=job_id)


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / AUDIT_FILE).read_text().splitlines()]


def test_a_line_is_appended_and_the_file_is_the_owners_alone(tmp_path: Path) -> None:
    for number in range(3):
        AuditLog(tmp_path).append(entry(f"{number:032x}"))
    assert [line["job_id"] for line in lines(tmp_path)] == [f"{number:032x}" for number in range(3)]
    assert (tmp_path / AUDIT_FILE).stat().st_mode & 0o777 == 0o600
    assert "address" not in lines(tmp_path)[0]


def test_a_line_after_one_that_was_cut_off_stands_by_itself(tmp_path: Path) -> None:
    log = AuditLog(tmp_path)
    log.append(entry())
    with (tmp_path / AUDIT_FILE).open("ab") as file:
        file.write(b'{"time": "20')
    log.append(entry("b" * 32))
    first, cut_off, last = (tmp_path / AUDIT_FILE).read_text().splitlines()
    assert (json.loads(first)["job_id"], cut_off, json.loads(last)["job_id"]) == ("a" * 32, '{"time": "20', "b" * 32)


def test_an_audit_whose_lines_name_a_hash_is_read_and_appended_to(tmp_path: Path) -> None:
    """Builds of 0.3 before its release wrote the field `chain` in front."""
    chained = b'{"chain":"%s","time":"2026-05-04T09:12:31.204+00:00","action":"viewed","outcome":"ok"}\n' % (b"0" * 64)
    (tmp_path / AUDIT_FILE).write_bytes(chained)
    AuditLog(tmp_path).append(entry())
    assert (tmp_path / AUDIT_FILE).read_bytes().startswith(chained)
    assert [line["action"] for line in lines(tmp_path)] == ["viewed", "viewed"]


def append_many(folder: Path) -> None:
    def append() -> None:
        for _ in range(20):
            AuditLog(folder).append(entry())

    threads = [threading.Thread(target=append) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_threads_and_processes_append_whole_lines(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=append_many, args=(tmp_path,)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [line["job_id"] for line in lines(tmp_path)] == ["a" * 32] * 120


def test_a_file_that_was_moved_away_is_begun_anew(tmp_path: Path) -> None:
    log = AuditLog(tmp_path)
    log.append(entry())
    (tmp_path / AUDIT_FILE).rename(tmp_path / "audit.1")
    log.append(entry())
    assert len(lines(tmp_path)) == 1


def test_a_disk_that_takes_only_half_a_line_refuses_it_and_the_next_is_whole(tmp_path: Path) -> None:
    log = AuditLog(tmp_path)
    log.append(entry())
    size = (tmp_path / AUDIT_FILE).stat().st_size
    with files_no_larger_than(size + 20), pytest.raises(StoreFullError):
        log.append(entry("b" * 32))
    log.append(entry("c" * 32))
    text = (tmp_path / AUDIT_FILE).read_text().splitlines()
    assert [json.loads(text[0])["job_id"], json.loads(text[-1])["job_id"]] == ["a" * 32, "c" * 32]


def test_the_reserve_is_given_up_piece_by_piece_before_anything_is_refused(tmp_path: Path) -> None:
    log = AuditLog(tmp_path)
    log.fill_reserve()
    reserve = tmp_path / RESERVE_FILE
    assert reserve.stat().st_size == RESERVE_BYTES
    assert reserve.stat().st_blocks * 512 >= RESERVE_BYTES
    pieces = RESERVE_BYTES // RESERVE_PIECE_BYTES
    assert [log._shrink_reserve() for _ in range(pieces + 1)] == [True] * pieces + [False]
    log.fill_reserve()
    assert reserve.stat().st_size == RESERVE_BYTES


def test_an_audit_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / AUDIT_FILE).mkdir()
    with pytest.raises(UnavailableError):
        AuditLog(tmp_path).append(entry())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_without_a_reserve_refuses(tmp_path: Path) -> None:
    os.symlink("/dev/full", tmp_path / AUDIT_FILE)
    with pytest.raises(StoreFullError):
        AuditLog(tmp_path).append(entry())
