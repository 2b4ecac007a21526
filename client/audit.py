"""`intrasplat audit verify`: whether the lines of an audit are as they were written (contract/access/chain.py)."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from contract.access.audit import AUDIT_FILE
from contract.access.chain import HEAD_PATTERN, START, CheckedFile, check_files, has_branches, in_order, unnamed_lines
from contract.runtime.arguments import add_data_dir, settings_of
from intrasplat.commands.arguments import Commands, add_command
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import InputError


def add_audit(commands: Commands) -> None:
    """Add `audit` with verify."""
    parser = commands.add_parser("audit", help="look whether an audit is as it was written", description="The audit.")
    own: Commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    verify = add_command(own, "verify", "say intact, or which line does not follow the one before it", _verify)
    verify.add_argument(
        "files",
        nargs="*",
        type=Path,
        metavar="FILE",
        help=f"all files of one data directory's audit, rotated ones and .gz too (default: {AUDIT_FILE})",
    )
    verify.add_argument("--head", metavar="HASH", help="that was printed earlier: tells whether lines since are gone")
    add_data_dir(verify)


def _verify(options: argparse.Namespace) -> int:
    if options.head is not None and not re.fullmatch(HEAD_PATTERN, options.head):
        raise InputError("--head", f"{options.head[:80]!r} is no hash.", "Give the 64 digits that verify has printed.")
    paths: list[Path] = options.files or [settings_of(options).data_dir.expanduser() / AUDIT_FILE]
    checked = check_files(paths, options.head)
    files = in_order([file for file in checked if file.lines])
    for file in [*(each for each in checked if not each.lines), *files]:
        print(_counts(file))
    for file in files:
        if unnamed_lines(file, files) == 1:
            print(
                f"{file.path}, its last line: no later file names it. The process was killed before the file was moved "
                "away, or the line was added since"
            )
    faults = [*_faults(files), *_fault_of_head(files, options.head)]
    for fault in faults:
        print(fault)
    print("CHANGED" if faults else "intact")
    print(f"head {files[-1].head if files else START}")
    return ExitCode.FAILED if faults else ExitCode.OK


def _counts(file: CheckedFile) -> str:
    if not file.lines:
        return f"{file.path}: no line"
    begins = {None: "begins before there was a chain", START: "begins the audit"}
    text = f"{file.path}: {file.lines} lines, {begins.get(file.begins, f'continues {file.begins}')}"
    if file.unchained:
        numbers = ", ".join(_ranges(file.unchained))
        text += f"; without a chain, of version 0.2 or cut off by a crash: {numbers}"
    return f"{text}; its last line is cut off" if file.is_cut_off else text


def _ranges(numbers: Sequence[int]) -> Iterator[str]:
    first = last = numbers[0]
    for number in (*numbers[1:], 0):
        if number != last + 1:
            yield str(first) if first == last else f"{first}-{last}"
            first = number
        last = number


def _faults(files: Sequence[CheckedFile]) -> Iterator[str]:
    for file in files:
        if (line := file.broken_at) is not None:
            yield (
                f"{file.path}, line {line}: it does not follow line {line - 1}, which was changed, "
                "or lines were removed, inserted or moved here"
            )
        if (unnamed := unnamed_lines(file, files)) > 1:
            yield (
                f"{file.path}, its last {unnamed} lines: no later file names them; they were added since, or the power "
                "failed just before the file was moved away"
            )
        if has_branches(file, files):
            yield f"{file.path}: several files go on from it, of which one at most was written by the service"
    for before, file in pairwise(files):
        if file.begins in (None, START) or not any(file.begins in each.found for each in files if each is not file):
            yield (
                f"{file.path}, line 1: it does not follow the last line of {before.path}, which was changed, "
                "or lines or files between them are missing"
            )


def _fault_of_head(files: Sequence[CheckedFile], head: str | None) -> Iterator[str]:
    if head is None or any(head in file.found for file in files):
        return
    yield f"--head {head}: no line has this hash: the line that had it was changed, or removed with all that followed"
