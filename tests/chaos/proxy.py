"""A faulty network: a TCP port in front of the queue's socket that delays, drops, swallows or cuts."""

from __future__ import annotations

import asyncio
import random
import threading
from contextlib import suppress
from enum import StrEnum
from pathlib import Path

CHUNK_BYTES = 1 << 16
DELAY_S = 0.3
DROPPED_SHARE = 0.3


class Fault(StrEnum):
    """What the network does."""

    NONE = "none"
    DELAY = "delayed replies"
    DROP_REPLY = "dropped replies"
    """The command is carried out, the connection ends instead of its answer."""
    HALF_OPEN = "half-open"
    """Connections stand and nothing comes through."""
    PARTITION = "partition"
    """Connections are cut and none is made."""


class ChaosProxy:
    """Forwards a port of the loopback interface to a unix socket; a context manager with a thread of its own."""

    def __init__(self, target: Path, seed: int) -> None:
        self._target = target
        self._random = random.Random(seed)
        self._fault = Fault.NONE
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self.port = 0

    def __enter__(self) -> ChaosProxy:
        self._thread.start()
        self._server = asyncio.run_coroutine_threadsafe(
            asyncio.start_server(self._serve, "127.0.0.1", 0), self._loop
        ).result()
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    def __exit__(self, *exception: object) -> None:
        self._server.close()
        self.set(Fault.PARTITION)
        asyncio.run_coroutine_threadsafe(self._finish_all(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def set(self, fault: Fault) -> None:
        """Set the fault from now on."""
        self._fault = fault
        if fault in (Fault.PARTITION, Fault.NONE):  # after half-open, too, whoever waits must learn of it
            asyncio.run_coroutine_threadsafe(self._cut_all(), self._loop).result()

    async def _cut_all(self) -> None:
        for writer in tuple(self._writers):
            writer.close()

    async def _finish_all(self) -> None:
        while self._writers:
            await self._cut_all()
            await asyncio.sleep(0.01)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._fault is Fault.PARTITION:
            writer.close()
            return
        far_reader, far_writer = await asyncio.open_unix_connection(str(self._target))
        self._writers |= {writer, far_writer}
        try:
            await asyncio.gather(
                self._carry(reader, far_writer, replies=False), self._carry(far_reader, writer, replies=True)
            )
        finally:
            self._writers -= {writer, far_writer}

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, replies: bool) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(CHUNK_BYTES):
                if self._fault is Fault.HALF_OPEN:
                    continue
                if replies and self._fault is Fault.DELAY:
                    await asyncio.sleep(DELAY_S)
                if replies and self._fault is Fault.DROP_REPLY and self._random.random() < DROPPED_SHARE:
                    break
                writer.write(data)
                await writer.drain()
        writer.close()
