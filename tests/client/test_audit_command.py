"""`intrasplat audit verify`: what an operator reads, and the status that a script goes by."""

from __future__ import annotations

import multiprocessing
import os
from pathlib import Path

import pytest

from client.cli import main
from contract.access.audit import AUDIT_FILE, HEAD_FILE, AuditAction, AuditEntry, AuditLog, utc_now
from contract.access.chain import check_file
from intrasplat.commands.exits import ExitCode


def write(folder: Path, count: int) -> Path:
    for _ in range(count):
        AuditLog(folder).append(AuditEntry(time=utc_now(), action=AuditAction.VIEWED, tenant="ward-3"))
    return folder / AUDIT_FILE


def verified(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, list[str]]:
    status = main(["audit", "verify", *map(str, arguments)])
    return status, capsys.readouterr().out.splitlines()


def test_an_audit_that_nobody_touched_is_intact_and_its_head_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, 3)
    status, lines = verified(capsys, "--data-dir", tmp_path)
    assert status == ExitCode.OK
    assert lines == [f"{path}: 3 lines, begins the audit", "intact", f"head {check_file(path).head}"]


def test_rotated_files_are_one_audit_in_whatever_order_they_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("audit.2", "audit.1"):
        write(tmp_path, 2).rename(tmp_path / name)
    newest = write(tmp_path, 1)
    status, lines = verified(capsys, newest, tmp_path / "audit.1", tmp_path / "audit.2")
    assert (status, lines[-2:]) == (ExitCode.OK, ["intact", f"head {check_file(newest).head}"])
    (tmp_path / "empty").touch()
    status, lines = verified(capsys, newest, tmp_path / "audit.1", tmp_path / "audit.2", tmp_path / "empty")
    assert (status, lines[0]) == (ExitCode.OK, f"{tmp_path / 'empty'}: no line")
    status, lines = verified(capsys, newest, tmp_path / "audit.2")
    assert status == ExitCode.FAILED
    assert f"{newest}, line 1: it does not follow the last line of {tmp_path / 'audit.2'}" in lines[2]


def test_a_changed_line_is_named_and_the_status_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, 5)
    lines = path.read_text().splitlines()
    lines[2] = lines[2].replace("ward-3", "ward-4")
    path.write_text("\n".join(lines) + "\n")
    status, told = verified(capsys, path)
    assert (status, told[2]) == (ExitCode.FAILED, "CHANGED")
    assert told[1].startswith(f"{path}, line 4: it does not follow line 3, which was changed")


def test_lines_that_are_gone_at_the_end_show_against_a_head_that_was_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, 5)
    head = verified(capsys, path)[1][-1].removeprefix("head ")
    write(tmp_path, 2)
    assert verified(capsys, path, "--head", head)[0] == ExitCode.OK
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:4]))
    assert verified(capsys, path)[0] == ExitCode.OK
    status, told = verified(capsys, path, "--head", head)
    assert status == ExitCode.FAILED
    assert any(line.startswith(f"--head {head}: no line has this hash") for line in told)


def write_and_be_killed(folder: Path) -> None:
    fsync = os.fsync

    def fsync_and_die(descriptor: int) -> None:
        fsync(descriptor)
        os._exit(9)

    os.fsync = fsync_and_die
    write(folder, 1)


@pytest.mark.parametrize("is_moved", [False, True])
def test_an_audit_whose_process_was_killed_before_it_noted_the_head_is_intact(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], is_moved: bool
) -> None:
    path, old = write(tmp_path, 2), tmp_path / "audit.1"
    kill = multiprocessing.get_context("spawn").Process(target=write_and_be_killed, args=(tmp_path,))
    kill.start()
    kill.join()
    assert kill.exitcode == 9
    if is_moved:
        path.rename(old)
    write(tmp_path, 2)
    status, told = verified(capsys, path, *[old] * is_moved)
    assert (status, told[-2]) == (ExitCode.OK, "intact")
    assert [line.partition(":")[0] for line in told if "names it" in line] == [f"{old}, its last line"] * is_moved
    if is_moved:  # a line that a later file names is still missed
        old.write_text("".join(old.read_text().splitlines(keepends=True)[:1]))
        assert verified(capsys, path, old)[0] == ExitCode.FAILED


def rotated(folder: Path, name: str, count: int, noted: bytes | None = None) -> Path:
    """A file of so many lines that was moved away, and went on from that head if one is given."""
    if noted is not None:
        (folder / HEAD_FILE).write_bytes(noted)
    return write(folder, count).rename(folder / name)


def test_lines_that_no_later_file_names_are_a_fault_unless_a_kill_leaves_as_many(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path, 2)
    noted = (tmp_path / HEAD_FILE).read_bytes()
    old = rotated(tmp_path, "audit.1", 2)
    newest = rotated(tmp_path, "audit.0", 1, noted)
    status, told = verified(capsys, newest, old)
    assert (status, told[-2]) == (ExitCode.FAILED, "CHANGED")
    assert told[2].startswith(f"{old}, its last 2 lines: no later file names them")
    old.write_text("".join(old.read_text().splitlines(keepends=True)[:3]))
    assert verified(capsys, newest, old)[0] == ExitCode.OK


@pytest.mark.parametrize(("main_lines", "side_lines"), [(2, 2), (1, 3), (3, 1)])
@pytest.mark.parametrize("from_end", [False, True])
def test_a_side_branch_is_a_fault_unless_it_is_the_one_line_that_a_kill_leaves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], main_lines: int, side_lines: int, from_end: bool
) -> None:
    write(tmp_path, 1)
    early = (tmp_path / HEAD_FILE).read_bytes()
    first = rotated(tmp_path, "first", 2)
    end = (tmp_path / HEAD_FILE).read_bytes()
    main_file = rotated(tmp_path, "main", main_lines)
    side = rotated(tmp_path, "side", side_lines, end if from_end else early)
    status, told = verified(capsys, side, main_file, first)
    may_be_a_kill = from_end and main_lines == 1
    assert (status == ExitCode.OK) == may_be_a_kill
    assert any("names it" in line for line in told) == may_be_a_kill


def test_a_last_line_that_is_cut_off_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, 3)
    path.write_bytes(path.read_bytes()[:-30])
    status, told = verified(capsys, path)
    assert status == ExitCode.OK
    assert told[0].endswith("its last line is cut off")


def test_old_lines_are_told_and_not_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / AUDIT_FILE).write_text('{"time":"1"}\n{"time":"2"}\n')
    status, told = verified(capsys, write(tmp_path, 1))
    assert status == ExitCode.OK
    assert "begins before there was a chain" in told[0]
    assert told[0].endswith("cut off by a crash: 1-2")


@pytest.mark.parametrize("arguments", [["absent"], ["--head", "12"]])
def test_what_cannot_be_verified_is_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    assert main(["audit", "verify", *arguments, "--data-dir", str(tmp_path)]) == ExitCode.BAD_INPUT
    assert capsys.readouterr().err.startswith("intrasplat: ")
