"""The chain of an audit's lines: each line names all that stands before it by SHA-256, so that no change goes unseen.

A chained line begins {"chain":"<hash>",... The hash is of the bytes from the start of the chained line before it up to
its own start, without the newline between them: as a rule, of the line before. Lines without a chain, which a crash has
cut off or version 0.2 wrote, are hashed together with that line, or from the start of the file if there is none.

The hash that the next line will name is the head. The first line of a file names the head of the file before it, START
if there is none. Nothing is secret: whoever may write the file can make a whole new chain. That, and lines removed at
the end, show only against a head that was kept elsewhere.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import re
import zlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from intrasplat.errors import InputError

START = "0" * 64
HEAD_PATTERN = r"[0-9a-f]{64}"
CHAINED = re.compile(rb'\{"chain":"([0-9a-f]{64})",')
TIME = re.compile(rb'"time":"([^"]{1,40})"')
TAIL_BYTES = 4096
"""The last line is looked for in so many bytes first; a line has about 350."""
PIECE_BYTES = 1 << 20
"""Then in pieces: an audit of version 0.2 may be larger than the memory."""
BEGINNING_BYTES = len('{"chain":"",') + len(START)


def head_of(descriptor: int) -> str | None:
    """The head of an open file; None if it is empty. Reads TAIL_BYTES, and more only where lines have no chain."""
    size = os.fstat(descriptor).st_size
    start = max(0, size - TAIL_BYTES)
    tail = os.pread(descriptor, size - start, start)
    at = _last_chained(tail, is_whole=start == 0)
    if at is not None or start == 0:
        return hashlib.sha256(tail[at or 0 :].removesuffix(b"\n")).hexdigest() if size else None
    digest, end = hashlib.sha256(), size - tail.endswith(b"\n")
    for begin in range(_chained_before(descriptor, start), end, PIECE_BYTES):
        digest.update(os.pread(descriptor, min(PIECE_BYTES, end - begin), begin))
    return digest.hexdigest()


def _chained_before(descriptor: int, end: int) -> int:
    """Where the last chained line begins that begins at this place or before; 0 if there is none."""
    while end > 0:
        start = max(0, end - PIECE_BYTES)
        piece = os.pread(descriptor, end + BEGINNING_BYTES - start, start)
        if (at := _last_chained(piece, is_whole=start == 0)) is not None:
            return start + at
        end = start
    return 0


def _last_chained(tail: bytes, *, is_whole: bool) -> int | None:
    """Where the last chained line of the tail begins. is_whole: the tail begins with a line."""
    at = tail.rfind(b'{"chain":"')
    while at >= 0:
        if (tail[at - 1 : at] == b"\n" or (at == 0 and is_whole)) and CHAINED.match(tail, at):
            return at
        at = tail.rfind(b'{"chain":"', 0, at)
    return None


def audit_lines(path: Path) -> Iterator[bytes]:
    """The lines of an audit file, of a compressed one (.gz) too, without their newlines.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            for line in file:
                yield line.removesuffix(b"\n")
    except (OSError, EOFError, zlib.error) as error:
        problem = f"{path} cannot be read ({type(error).__name__})."
        raise InputError("FILE", problem, "Name the files of one service's audit, as the user that runs it.") from error


@dataclass
class CheckedFile:
    """What one file's chain says."""

    path: Path
    lines: int = 0
    begun: str = ""
    """The time of its first line."""
    begins: str | None = None
    """The head that its first line names; None: that line has no chain."""
    head: str = START
    """What the next line would name."""
    broken_at: int | None = None
    """The first line, counted from 1, that does not name what stands before it."""
    is_cut_off: bool = False
    """Its last line is not whole."""
    unchained: list[int] = field(default_factory=list)
    found: dict[str, int] = field(default_factory=dict)
    """After which line the head was one that is looked for; 0: before the first."""


def check_files(paths: Sequence[Path], head: str | None = None) -> list[CheckedFile]:
    """Follow the chain through all files of an audit, each looked through for the heads that the others begin with, and
    for `head`. Raises as audit_lines()."""
    named = [CHAINED.match(next(audit_lines(path), b"")) for path in paths]
    wanted = frozenset({each[1].decode() for each in named if each} | ({head} if head else set()))
    return [check_file(path, wanted) for path in paths]


def check_file(path: Path, wanted: Collection[str] = ()) -> CheckedFile:
    """Follow the chain of one file. wanted: heads to look for. Raises as audit_lines()."""
    checked, since = CheckedFile(path), hashlib.sha256()
    for number, line in enumerate(audit_lines(path), 1):
        chained = CHAINED.match(line)
        if number == 1 and (time := TIME.search(line)):
            checked.begun = time[1].decode("ascii", "replace")
        if chained is None:
            checked.unchained.append(number)
            since.update(line if number == 1 else b"\n" + line)
        else:
            named = chained[1].decode()
            if number == 1:
                checked.begins = named
                if named in wanted:
                    checked.found[named] = 0
            elif named != checked.head and checked.broken_at is None:
                checked.broken_at = number
            since = hashlib.sha256(line)
        checked.lines, checked.head, checked.is_cut_off = number, since.hexdigest(), not line.endswith(b"}")
        if checked.head in wanted:
            checked.found[checked.head] = number
    return checked


def in_order(files: Sequence[CheckedFile]) -> list[CheckedFile]:
    """The files, none of them empty, so that each begins where the one before it ends, as far as that can be."""
    waiting = [each for each in files if not any(other.found.get(each.begins or "") for other in files)]
    waiting.sort(key=lambda each: (each.begins not in (None, START), each.begun), reverse=True)
    ordered: list[CheckedFile] = []
    while waiting:
        file = waiting.pop()
        if file not in ordered:
            ordered.append(file)
            following = [each for each in files if file.found.get(each.begins or "")]
            waiting += sorted(following, key=lambda each: each.begun, reverse=True)
    return ordered


def unnamed_lines(file: CheckedFile, files: Sequence[CheckedFile]) -> int:
    """How many lines at the end of a file no later one names, though it names what stands before them. A process that
    was killed before it noted the head leaves one, if the file was moved away at once. files: in order."""
    named = [file.found[each.begins] for each in files if each is not file and each.begins in file.found]
    return file.lines - max(named) if named and file is not files[-1] else 0


def has_branches(file: CheckedFile, files: Sequence[CheckedFile]) -> bool:
    """Whether several files go on from this one. One that holds a single line and ends there does not count, if another
    begins where it does: a kill may leave it, as in unnamed_lines()."""
    followers = [each for each in files if each is not file and file.found.get(each.begins or "")]
    places = {each.begins for each in followers}
    going_on = [each for each in followers if each.lines > 1 or _is_followed(each, files)]
    return len(places) > 1 or len(going_on) > 1


def _is_followed(file: CheckedFile, files: Sequence[CheckedFile]) -> bool:
    return any(file.found.get(each.begins or "") for each in files if each is not file)
