"""One playable file of a feed's recorded packets, without new encoding. A confined process reads the parts."""

from __future__ import annotations

import os
import shutil
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from intrasplat.decode.contained import Decoder
from intrasplat.decode.guard import Allowance
from intrasplat.errors import InputError
from intrasplat.files.durable import flush, temporary_path
from intrasplat.live.parts import Parts

PROGRAM = ("-m", "intrasplat.live.cutting")
MEMORY_BYTES = 2 << 30
MAX_CPU_S = 600
OUTPUT = "cut"
FIELD = "from"


@dataclass(frozen=True)
class Cut:
    """What a cut holds.

    from_s, to_s   source times of its first and last frame
    frames         their number
    is_whole       whether it holds all recorded frames of the range: after a change of coding only what came later
    container      mp4, or mkv for Motion JPEG
    """

    path: Path
    from_s: float
    to_s: float
    frames: int
    bytes: int
    is_whole: bool
    container: str


def cut_parts(parts: Parts, from_s: float, to_s: float, path: Path) -> Cut:
    """Write the recorded packets of [from_s, to_s] in source time to `path`, on disk when this returns.

    It begins at the last key frame that is not after from_s and ends before the first key frame after to_s. Parts that
    are still being written are not in it. If the coding changes on the way, it holds the newest stretch of one coding.

    Raises:
        InputError: nothing of this range is recorded, or the parts cannot be joined.
        UnavailableError: the disk is full, or the system killed the process.
    """
    if not from_s < to_s:
        raise InputError(FIELD, f"{from_s:g} is not before {to_s:g}.", "Give a range of source time in seconds.")
    with parts.pinned(from_s, to_s) as chosen:
        if not chosen:
            index = parts.index()
            there = f"{index[0].from_s:.1f} to {index[-1].to_s:.1f} s" if index else "nothing"
            raise InputError(FIELD, f"{from_s:g} to {to_s:g} s is not recorded.", f"There is {there}.")
        sources = [{"path": str(each.path.absolute()), "from_s": each.from_s} for each in chosen]
        request = {"readable": [each["path"] for each in sources], "parts": sources, "from_s": from_s, "to_s": to_s}
        total = sum(each.bytes for each in chosen)
        with closing(Decoder(PROGRAM)) as cutting:
            cutting.ask(request, Allowance(MEMORY_BYTES, 2 * total + (1 << 20), MAX_CPU_S))
            result = cutting.until_ended()
            _move(cutting.folder / OUTPUT, path)
    return Cut(
        path=path,
        from_s=float(result["from_s"]),
        to_s=float(result["to_s"]),
        frames=int(result["frames"]),
        bytes=path.stat().st_size,
        is_whole=bool(result["is_whole"]),
        container=str(result["container"]),
    )


def _move(source: Path, path: Path) -> None:
    temporary = temporary_path(path)
    descriptor = os.open(source, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        with open(descriptor, "rb") as read, temporary.open("wb") as written:
            shutil.copyfileobj(read, written)
            written.flush()
            os.fsync(written.fileno())
        temporary.rename(path)
    finally:
        temporary.unlink(missing_ok=True)
    flush(path.parent)
