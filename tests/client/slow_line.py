"""A slow line to a service: a proxy with little bandwidth and much latency, for all connections together."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager

CHUNK_BYTES = 1400
QUEUED_CHUNKS = 24


class SlowLine:
    """bit_per_s: from the service to the browser; latency_s: there and back."""

    def __init__(self, port: int, bit_per_s: float, latency_s: float) -> None:
        self._service_port, self._byte_s, self._one_way_s = port, 8 / bit_per_s, latency_s / 2
        self._free_at_s = 0.0

    async def serve(self, on_ready: Callable[[int], None], ended: asyncio.Event) -> None:
        """Carry connections until it has ended."""
        carrying: set[asyncio.Task[None]] = set()

        def connect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            carrying.add(asyncio.create_task(self._connect(reader, writer)))

        server = await asyncio.start_server(connect, "127.0.0.1", 0)
        on_ready(server.sockets[0].getsockname()[1])
        await ended.wait()
        server.close()
        for task in carrying:
            task.cancel()
        await asyncio.gather(*carrying, return_exceptions=True)
        await asyncio.sleep(0.1)  # transports close

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there_reader, there_writer = await asyncio.open_connection("127.0.0.1", self._service_port)
        ways = (reader, there_writer, 0.0), (there_reader, writer, self._byte_s)
        try:
            await asyncio.gather(*(self._carry(*way) for way in ways))
        finally:
            there_writer.close()
            writer.close()

    async def _carry(self, source: asyncio.StreamReader, target: asyncio.StreamWriter, byte_s: float) -> None:
        loop = asyncio.get_running_loop()
        on_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(QUEUED_CHUNKS)

        async def arrive() -> None:
            while True:
                due_s, chunk = await on_way.get()
                await asyncio.sleep(due_s - loop.time())
                if byte_s:
                    self._free_at_s = max(loop.time(), self._free_at_s) + byte_s * len(chunk)
                    await asyncio.sleep(self._free_at_s - loop.time())
                if not chunk:
                    return target.close()
                target.write(chunk)

        arriving = asyncio.create_task(arrive())
        try:
            with contextlib.suppress(OSError):
                while chunk := await source.read(CHUNK_BYTES):
                    await on_way.put((loop.time() + self._one_way_s, chunk))
            await on_way.put((loop.time() + self._one_way_s, b""))
            await arriving
        finally:
            arriving.cancel()
            await asyncio.gather(arriving, return_exceptions=True)


@contextmanager
def slow_line(port: int, bit_per_s: float, latency_s: float) -> Iterator[int]:
    """The port of the line to the service at another one."""
    ready: Future[tuple[int, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def run() -> None:
        ended = asyncio.Event()
        loop = asyncio.get_running_loop()
        await SlowLine(port, bit_per_s, latency_s).serve(lambda at: ready.set_result((at, loop, ended)), ended)

    thread = threading.Thread(target=lambda: asyncio.run(run()))
    thread.start()
    line_port, loop, ended = ready.result(5)
    try:
        yield line_port
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()
