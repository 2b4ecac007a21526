"""The recording of a feed on disk: parts whose names say what they hold, so that no index can disagree with them.

    parts/00000012-3-24000000-26000000-1764403200000000-1764403202000000.mp4
          number, segment, first and last source time, arrival of the first and last packet; times in microseconds

The process that reads the source writes into incoming/; from there this process moves complete parts to parts/, which
that one cannot reach.
"""

from __future__ import annotations

import contextlib
import re
import stat
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from intrasplat.files.durable import flush
from intrasplat.live.spec import RecordingSpec

NAME = re.compile(r"(\d{8})-(\d+)-(-?\d+)-(-?\d+)-(\d+)-(\d+)\.mp4", re.ASCII)
MICRO = 1_000_000
MAX_DIGITS = 18
MAX_UNJUDGED_S = 60.0
"""A part that is not judged for longer is deleted."""
Keeps = Callable[[float, float], bool | None]
"""Whether the recording of a range of source times, s, may be stored; None: not known yet."""
MAX_AHEAD_S = 60.0
"""A part that arrives later than now by more is none of ours."""


@dataclass(frozen=True)
class Part:
    """A recorded part. from_s and to_s are the source times of its first and last frame; arrivals are UNIX times, s."""

    path: Path
    number: int
    segment: int
    from_s: float
    to_s: float
    first_arrived_at: float
    last_arrived_at: float
    bytes: int


def part_name(number: int, segment: int, from_s: float, to_s: float, first_at: float, last_at: float) -> str:
    """The name of a part's file."""
    times = "-".join(str(round(each * MICRO)) for each in (from_s, to_s, first_at, last_at))
    return f"{number:08d}-{segment}-{times}.mp4"


def read_part(path: Path) -> Part | None:
    """The part that a file is; None if it is none."""
    match = NAME.fullmatch(path.name)
    if match is None or any(len(each) > MAX_DIGITS for each in match.groups()):
        return None
    try:
        found = path.lstat()
    except OSError:
        return None
    number, segment, *times = (int(each) for each in match.groups())
    if not stat.S_ISREG(found.st_mode):
        return None
    from_s, to_s, first_at, last_at = (each / MICRO for each in times)
    return Part(path, number, segment, from_s, to_s, first_at, last_at, found.st_size)


class Parts:
    """The parts of a feed, in order. Any thread may call it."""

    def __init__(self, spec: RecordingSpec, keeps: Keeps | None = None) -> None:
        """Find the parts of earlier runs.

        keeps: judges each part before it is published; without it all are.

        Raises:
            OSError: the folder cannot be made or read.
        """
        self._spec, self._keeps = spec, keeps
        self._lock = threading.Lock()
        self._pinned: dict[int, int] = {}
        self.incoming, self._folder = spec.folder / "incoming", spec.folder / "parts"
        for folder in (self.incoming, self._folder):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = (read_part(path) for path in self._folder.iterdir())
        self._parts = sorted((each for each in found if each is not None), key=lambda each: each.number)
        if keeps is None:  # else nothing can judge what an earlier run left there
            self.adopt()
        self._clear_incoming(is_all=True)

    @property
    def stored_bytes(self) -> int:
        """Bytes of all parts."""
        with self._lock:
            return sum(each.bytes for each in self._parts)

    def index(self) -> tuple[Part, ...]:
        """All parts, oldest first."""
        with self._lock:
            return tuple(self._parts)

    def adopt(self) -> None:
        """Take over the complete parts in incoming/, in order of their numbers there, which become ours."""
        with contextlib.suppress(OSError), self._lock:
            found = [part for path in sorted(self.incoming.iterdir()) if (part := read_part(path)) is not None]
            for part in found:
                if part.to_s < part.from_s or part.last_arrived_at > time.time() + MAX_AHEAD_S:
                    continue
                keeps = True if self._keeps is None else self._keeps(part.from_s, part.to_s)
                if keeps is None and time.time() - part.last_arrived_at < MAX_UNJUDGED_S:
                    break
                if not keeps:
                    part.path.unlink()
                    continue
                number = self._parts[-1].number + 1 if self._parts else 0
                times = part.from_s, part.to_s, part.first_arrived_at, part.last_arrived_at
                target = self._folder / part_name(number, part.segment, *times)
                part.path.rename(target)
                self._parts.append(replace(part, path=target, number=number))
            if found:
                flush(self._folder)

    def clear_incoming(self) -> None:
        """Remove what a process that ended left unfinished."""
        self._clear_incoming(is_all=self._keeps is None)

    def _clear_incoming(self, *, is_all: bool) -> None:
        """is_all: also the parts that wait to be judged."""
        with contextlib.suppress(OSError):
            for path in self.incoming.iterdir():
                if is_all or read_part(path) is None:
                    with contextlib.suppress(OSError):
                        path.unlink()

    def forget(self, after_s: float) -> None:
        """Delete the parts that end after a source time."""
        with self._lock:
            for part in [each for each in self._parts if each.to_s > after_s]:
                part.path.unlink(missing_ok=True)
                self._parts.remove(part)

    def prune(self) -> None:
        """Delete parts that are too old or too many, oldest first, apart from those that a cut reads."""
        oldest_at = time.time() - self._spec.keep_s
        with self._lock:
            total = sum(each.bytes for each in self._parts)
            for part in tuple(self._parts):
                if part.last_arrived_at >= oldest_at and total <= self._spec.max_bytes:
                    break
                if part.number in self._pinned:
                    continue
                try:
                    part.path.unlink(missing_ok=True)
                except OSError:
                    break
                self._parts.remove(part)
                total -= part.bytes

    @contextmanager
    def pinned(self, from_s: float, to_s: float) -> Iterator[Sequence[Part]]:
        """The parts that hold frames of [from_s, to_s]; none of them is deleted inside the context."""
        with self._lock:
            chosen = [each for each in self._parts if each.to_s >= from_s and each.from_s <= to_s]
            for part in chosen:
                self._pinned[part.number] = self._pinned.get(part.number, 0) + 1
        try:
            yield chosen
        finally:
            with self._lock:
                for part in chosen:
                    self._pinned[part.number] -= 1
                    if not self._pinned[part.number]:
                        del self._pinned[part.number]


def remove_all(spec: RecordingSpec) -> int:
    """Delete a feed's whole recording; its bytes."""
    removed = 0
    for folder in ("incoming", "parts"):
        for path in (spec.folder / folder).glob("*"):
            removed += path.lstat().st_size
            path.unlink()
        with contextlib.suppress(FileNotFoundError):
            (spec.folder / folder).rmdir()
    return removed
