"""Connections to peers over TCP. Each peer gets the newest message of every device, however slowly it reads.

pyigtl's own server queues messages and drops a peer that is 10 ms late, so this module has its own connections.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any

from client.slicer.messages import HEADER_BYTES, HEARD, DamagedError, Heard, read, read_header
from client.slicer.say import say
from intrasplat.errors import UnavailableError

MAX_PEERS = 8
MAX_HEARD_BYTES, MAX_SKIPPED_BYTES = 1 << 16, 1 << 28
"""Maximum bytes of a message of a known kind, and of another kind, which is skipped."""
PIECE_BYTES = 1 << 16
SEND_TIMEOUT_S = 30.0
"""A peer that takes this long to receive one message counts as gone."""
FIRST_PAUSE_S, MAX_PAUSE_S = 0.5, 8.0
"""First and longest pause between attempts to connect to a peer."""


class Link:
    """All peers.

    on_heard(message): called for each transform and text that a peer sends.
    on_come(): called when a peer has connected.
    """

    def __init__(self, on_heard: Callable[[Heard], None], on_come: Callable[[], None]) -> None:
        self._on_heard, self._on_come = on_heard, on_come
        self._newest: dict[str, bytes] = {}
        self._peers: set[_Peer] = set()

    @property
    def has_peers(self) -> bool:
        """Whether a peer is connected."""
        return bool(self._peers)

    def send(self, device: str, content: bytes) -> None:
        """Send a message to every peer as soon as possible. A newer message of the same device replaces it."""
        self._newest[device] = content
        for peer in self._peers:
            peer.offer(device, content)

    async def flush(self, within_s: float) -> None:
        """Wait until every peer has received all messages, at most within_s."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while any(peer.is_behind for peer in self._peers):
                    await asyncio.sleep(0.02)

    async def listen(self, host: str, port: int, on_open: Callable[[int], None]) -> None:
        """Accept peers, for ever. on_open(port) is called once they can connect; port 0 chooses a free one.

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
        """Connect, and reconnect, to a peer that listens, for ever."""
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
        """Serve a peer until it disconnects."""
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
    """Run the coroutines concurrently until one ends, then cancel the others. Returns the ended tasks."""
    tasks = [asyncio.create_task(each) for each in work]
    try:
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        return ended
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


class _Peer:
    """One connection: one task reads, another writes the newest message of each device."""

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
        writer.transport.set_write_buffer_limits(high=0)  # drain() then waits until the system has all bytes

    @property
    def is_behind(self) -> bool:
        """Whether messages still wait for the peer."""
        return self._is_sending or bool(self._waiting)

    def offer(self, device: str, content: bytes) -> None:
        """Send the message as soon as the peer reads, in place of a waiting one of the same device."""
        self._waiting[device] = content
        self._offered.set()

    def hang_up(self) -> None:
        """Close the connection; the peer can still read what was sent."""
        if self.is_behind:
            self._writer.transport.abort()
        else:
            self._writer.close()

    async def serve(self) -> str:
        """Serve the peer until it disconnects. Returns why."""
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
