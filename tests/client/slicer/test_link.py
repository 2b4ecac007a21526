"""Peers that read slowly, that come late, and that are too many."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import Callable, Coroutine
from typing import Any

import numpy as np

from client.slicer import messages
from client.slicer.link import MAX_PEERS, Link

SIDE = 600
"""A picture of so many pixels squared is larger than what the system buffers for a socket on the way."""
PICTURES = 60


async def opened(link: Link) -> tuple[asyncio.Task[None], int]:
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    listening = asyncio.create_task(link.listen("127.0.0.1", 0, port.set_result))
    return listening, await port


async def read_message(reader: asyncio.StreamReader) -> tuple[str, bytes]:
    header = messages.read_header(await reader.readexactly(messages.HEADER_BYTES))
    return str(header.fields["device_name"]), await reader.readexactly(header.body_bytes)


def run(use: Callable[[], Coroutine[Any, Any, None]]) -> None:
    async def in_time() -> None:
        async with asyncio.timeout(60):
            await use()

    asyncio.run(in_time())


async def until(what: object) -> None:
    assert callable(what)
    while not what():
        await asyncio.sleep(0.01)


def test_a_slow_peer_skips_to_the_newest_picture_and_other_devices_are_not_lost() -> None:
    async def use() -> None:
        link = Link(lambda heard: None, lambda: None)
        listening, port = await opened(link)
        reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 16)
        await until(lambda: link.has_peers)
        link.send(messages.STATUS, messages.text(messages.STATUS, "first"))
        for shade in range(PICTURES):
            picture = np.full((SIDE, SIDE, 3), shade, np.uint8)
            link.send(messages.PICTURE, messages.image(messages.PICTURE, picture, np.eye(4)))
            await asyncio.sleep(0)  # the peer's turn
        got: list[tuple[str, int]] = []
        while (messages.PICTURE, PICTURES - 1) not in got:
            device, body = await read_message(reader)
            got.append((device, body[-1]))
        shades = [shade for device, shade in got if device == messages.PICTURE]
        assert shades == sorted(shades)
        assert len(shades) < PICTURES / 2
        assert messages.STATUS in [device for device, _ in got]
        await link.flush(5)
        writer.close()
        listening.cancel()

    run(use)


def test_a_late_peer_gets_the_newest_of_each_device() -> None:
    async def use() -> None:
        link = Link(lambda heard: None, lambda: None)
        listening, port = await opened(link)
        for words in ("old", "new"):
            link.send(messages.STATUS, messages.text(messages.STATUS, words))
        link.send(messages.CAMERA, messages.transform(messages.CAMERA, np.eye(4)))
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        device, body = await read_message(reader)
        assert (device, body[4:]) == (messages.STATUS, b"new")
        assert (await read_message(reader))[0] == messages.CAMERA
        writer.close()
        listening.cancel()

    run(use)


def test_what_a_peer_sends_is_heard_and_long_texts_of_other_kinds_are_passed_over() -> None:
    async def use() -> None:
        heard: list[messages.Heard] = []
        link = Link(heard.append, lambda: None)
        listening, port = await opened(link)
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(messages.image("Volume", np.zeros((300, 300), np.float32), np.eye(4)))
        writer.write(messages.text(messages.COMMAND, "play"))
        pose = np.eye(4)
        pose[0, 3] = 2.5
        writer.write(messages.transform(messages.POSE, pose))
        await until(lambda: len(heard) == 2)
        assert (heard[0].device, heard[0].text) == (messages.COMMAND, "play")
        assert heard[1].matrix is not None
        np.testing.assert_array_equal(heard[1].matrix, pose)
        writer.close()
        listening.cancel()

    run(use)


def test_a_message_that_is_far_too_long_ends_the_connection_before_it_is_read() -> None:
    async def use() -> None:
        link = Link(lambda heard: None, lambda: None)
        listening, port = await opened(link)
        for kind, size in ((b"TRANSFORM", 1 << 20), (b"IMAGE", 1 << 40)):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(struct.pack(">H12s20sIIQQ", 1, kind, b"Pose", 0, 0, size, 0))
            assert await reader.read(1) == b""
            writer.close()
        listening.cancel()

    run(use)


def test_more_peers_than_a_few_are_turned_away() -> None:
    async def use() -> None:
        link = Link(lambda heard: None, lambda: None)
        listening, port = await opened(link)
        streams = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MAX_PEERS + 1)]
        assert await streams[-1][0].read(1) == b""
        link.send(messages.STATUS, messages.text(messages.STATUS, "here"))
        for reader, _ in streams[:-1]:
            assert (await read_message(reader))[0] == messages.STATUS
        for _, writer in streams:
            writer.close()
        listening.cancel()

    run(use)


def test_a_peer_that_is_shown_out_while_it_is_sent_to_is_let_go() -> None:
    async def use() -> None:
        link = Link(lambda heard: None, lambda: None)
        listening, port = await opened(link)
        for each in range(200):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            for _ in range(each % 10):
                await asyncio.sleep(0)
            link.send(messages.STATUS, messages.text(messages.STATUS, "here"))
            writer.write(b"GET / HTTP/1.1".ljust(messages.HEADER_BYTES))
            with contextlib.suppress(ConnectionResetError):
                await reader.read()
            writer.close()
        await until(lambda: not link.has_peers)
        listening.cancel()

    run(use)
