"""Streams a zip without a file: each part can be sent before the next is computed."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator


class _Sink(io.RawIOBase):
    """Buffers what a zip writes until take(). It cannot seek, so ZipFile writes a zip that needs no seeking."""

    def __init__(self) -> None:
        self._written = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        content = bytes(memoryview(data))  # type: ignore[arg-type]
        self._written += content
        return len(content)

    def take(self) -> bytes:
        """The bytes written since the last call."""
        taken = bytes(self._written)
        self._written.clear()
        return taken


def zip_parts(members: Iterator[tuple[str, Iterator[bytes]]]) -> Iterator[bytes]:
    """The bytes of a zip of these members, each a name and its content in chunks, stored uncompressed."""
    sink = _Sink()
    with zipfile.ZipFile(sink, "w") as archive:
        for name, pieces in members:
            with archive.open(zipfile.ZipInfo(name), "w", force_zip64=True) as member:
                for piece in pieces:
                    member.write(piece)
                    yield sink.take()
    yield sink.take()
