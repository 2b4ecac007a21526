"""Sends a stream in a file again and again, in real time, as MPEG-TS over TCP on loopback.

    python -m lab.benchmarks.send_stream FILE FPS [PORT]

prints its port. It imports little, so that it is soon there again after a kill.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.error


def sending(path: Path, fps: float, port: int = 0) -> list[str]:
    """The command that sends a file. port 0: any."""
    return [sys.executable, "-m", "lab.benchmarks.send_stream", str(path), str(fps), str(port)]


def send(path: Path, fps: float, port: int) -> None:
    """Serve the stream in a file again and again, in real time, to whoever connects."""
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
        template = container.streams.video[0]
        listener = socket.create_server(("127.0.0.1", port))
        print(listener.getsockname()[1], flush=True)
        while True:
            connection, _ = listener.accept()
            with suppress(OSError, av.error.FFmpegError), connection, connection.makefile("wb", buffering=0) as sink:
                _send(packets, template, fps, sink)


def _send(packets: Sequence[Any], template: Any, fps: float, sink: Any) -> None:
    began_s, tick = time.monotonic(), Fraction(1, 90_000)
    with av.open(sink, "w", format="mpegts", options={"flush_packets": "1"}) as container:
        stream = container.add_stream_from_template(template)
        for number in range(sys.maxsize):
            packet = packets[number % len(packets)]
            again: Any = av.Packet(bytes(packet))
            again.pts = again.dts = round(number / fps / tick)
            again.time_base, again.is_keyframe, again.stream = tick, packet.is_keyframe, stream
            container.mux(again)
            time.sleep(max(0.0, began_s + (number + 1) / fps - time.monotonic()))


if __name__ == "__main__":
    send(Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]))
