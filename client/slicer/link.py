"""Peers over TCP: each gets the newest message of every device, however slowly it reads.

pyigtl's own server keeps a queue of messages and drops a peer that is 10 ms late, so the connections are ours.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any

from client.slicer.messages import HEADER_BYTES, HEARD, DamagedError, Heard, read, read_header
from client.slicer.say import say
from contract.wire.errors import UnavailableError

MAX_PEERS = 8
MAX_HEARD_BYTES, MAX_SKIPPED_BYTES = 1 << 16, 1 << 28
"""Of one message: of a kind that matters, and of another."""
PIECE_BYTES = 1 << 16
SEND_TIMEOUT_S = 30.0
"""A peer that takes this long to take in one message counts as gone."""
FIRST_PAUSE_S, MAX_PAUSE_S = 0.5, 8.0
"""Between attempts to reach a peer that listens."""


class Link:
    """All peers.

    on_heard(message): is called for each transform and text that a peer sends.
    on_come(): is called when a peer has come.
    """

    def __init__(self, on_heard: Callable[[Heard], None], on_come: Callable[[], None]) -> None:
        self._on_heard, self._on_come = on_heard, on_come
        self._newest: dict[str, bytes] = {}
        self._peers: set[_Peer] = set()

    @property
    def has_peers(self) -> bool:
        """Whether anybody is there."""
        return bool(self._peers)

    def send(self, device: str, content: bytes) -> None:
        """Send a message to every peer, now or later, unless a newer one of the device overtakes it."""
        self._newest[device] = content
        for peer in self._peers:
            peer.offer(device, content)

    async def flush(self, within_s: float) -> None:
        """Wait until every peer has taken all, at most so long."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while any(peer.is_behind for peer in self._peers):
                    await asyncio.sleep(0.02)

    async def listen(self, host: str, port: int, on_open: Callable[[int], None]) -> None:
        """Wait for peers, for ever. on_open(port) is called once they can come; port 0 takes a free one.

        Raises:
            UnavailableError: the port cannot be opened.
        """
        try:
            server = await asyncio.start_server(self._met, host, port)
        except OSError as error:
            problem = f"Port {port} of {host} cannot be opened ({error.strerror or type(error).__name__})."
            raise UnavailableError(problem, "Choose another with --port.") from error
        try:
            on_open(server.sockets[0].getsockname()[1])
            await asyncio.Event().wait()
        finally:
            server.close()
            self._hang_up()

    async def reach(self, host: str, port: int) -> None:
        """Stay connected to a peer that listens, for ever."""
        pause_s = FIRST_PAUSE_S
        try:
            while True:
                try:
                    streams = await asyncio.open_connection(host, port)
                except OSError:
                    await asyncio.sleep(pause_s)
                    pause_s = min(2 * pause_s, MAX_PAUSE_S)
                    continue
                pause_s = FIRST_PAUSE_S
                await self._met(*streams)
                await asyncio.sleep(pause_s)
        finally:
            self._hang_up()

    def _hang_up(self) -> None:
        for peer in self._peers:
            peer.hang_up()

    async def _met(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a peer until it goes."""
        host, port = (writer.get_extra_info("peername") or ("somebody", 0))[:2]  # none if it has gone already
        name = f"{host}:{port}"
        if len(self._peers) >= MAX_PEERS:
            writer.close()
            say(f"{name} was turned away: {MAX_PEERS} peers are there")
            return
        peer = _Peer(reader, writer, self._newest, self._on_heard)
        self._peers.add(peer)
        say(f"{name} has come")
        self._on_come()
        try:
            why = await peer.serve()
        finally:
            self._peers.discard(peer)
            writer.close()
        say(f"{name} has gone: {why}")


async def first_ended(*work: Coroutine[Any, Any, None]) -> set[asyncio.Task[None]]:
    """Run the coroutines side by side until one ends, and cancel the others; the tasks that have ended."""
    tasks = [asyncio.create_task(each) for each in work]
    try:
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        return ended
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


class _Peer:
    """One connection: a task that reads, and one that writes the newest message of each device."""

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        newest: dict[str, bytes],
        on_heard: Callable[[Heard], None],
    ) -> None:
        self._reader, self._writer, self._on_heard = reader, writer, on_heard
        self._waiting = dict(newest)
        self._is_sending = False
        self._offered = asyncio.Event()
        self._offered.set()
        writer.transport.set_write_buffer_limits(high=0)  # drain() returns when the system has taken everything

    @property
    def is_behind(self) -> bool:
        """Whether it has not taken everything yet."""
        return self._is_sending or bool(self._waiting)

    def offer(self, device: str, content: bytes) -> None:
        """Send this as soon as it takes it, in place of what waits of the device."""
        self._waiting[device] = content
        self._offered.set()

    def hang_up(self) -> None:
        """End the connection; what it has taken stays readable to the peer."""
        if self.is_behind:
            self._writer.transport.abort()
        else:
            self._writer.close()

    async def serve(self) -> str:
        """Talk to it until it goes; why it went."""
        for task in await first_ended(self._read(), self._write()):
            error = task.exception()
            if isinstance(error, DamagedError):
                return str(error)
            if isinstance(error, TimeoutError):
                return f"it took nothing for {SEND_TIMEOUT_S:g} s"
            if error is not None and not isinstance(error, OSError | asyncio.IncompleteReadError):
                raise error
        return "it closed the connection"

    async def _write(self) -> None:
        while True:
            await self._offered.wait()
            self._offered.clear()
            while self._waiting:
                device = next(iter(self._waiting))
                self._is_sending = True
                self._writer.write(self._waiting.pop(device))
                async with asyncio.timeout(SEND_TIMEOUT_S):
                    await self._writer.drain()
                self._is_sending = False

    async def _read(self) -> None:
        while True:
            header = read_header(await self._reader.readexactly(HEADER_BYTES))
            is_heard = header.kind in HEARD
            if header.body_bytes > (MAX_HEARD_BYTES if is_heard else MAX_SKIPPED_BYTES):
                raise DamagedError(f"it sent a {header.kind} of {header.body_bytes} bytes")
            if is_heard:
                self._on_heard(read(header, await self._reader.readexactly(header.body_bytes)))
            else:
                await self._skip(header.body_bytes)

    async def _skip(self, left: int) -> None:
        while left:
            left -= len(await self._reader.readexactly(min(left, PIECE_BYTES)))
