"""Senders of small stereo streams on this machine, for tests of live sources."""

from __future__ import annotations

import http.server
import io
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.live.spec import PICTURE_HEADER
from lab.phantom import Phantom

HEIGHT, WIDTH = 48, 64  # of an eye
RATE_HZ = 30
GOP = 6
OPTIONS = {
    "libx264": {"preset": "ultrafast", "tune": "zerolatency", "g": str(GOP), "crf": "12"},
    "mjpeg": {},
}


def picture(index: int, height: int = HEIGHT, width: int = WIDTH) -> NDArray[np.uint8]:
    """Two eyes side by side, R G B [H, 2 W, 3], of a texture that moves from frame to frame."""
    grey = np.random.default_rng(3).integers(40, 200, (height // 8 + 1, width // 8 + 40), np.uint8)
    grey = cv2.resize(grey, None, fx=8, fy=8, interpolation=cv2.INTER_LINEAR)
    start = 2 * index % 100
    left, right = grey[:height, start : start + width], grey[:height, start + 2 : start + 2 + width]
    return np.repeat(np.concatenate([left, right], axis=1)[:, :, None], 3, axis=2)


class Stream:
    """An encoder into a container in memory, which gives its bytes frame by frame."""

    def __init__(self, form: str = "mpegts", codec: str = "libx264", start_s: float = 0.0, **options: str) -> None:
        self._buffer = io.BytesIO()
        forms = {"mp4": {"movflags": "frag_every_frame+empty_moov+default_base_moof"}, "mpegts": {"flush_packets": "1"}}
        self._container = av.open(self._buffer, "w", format=form, options=forms.get(form, {}))
        self._streams: list[Any] = []
        self._codec, self._options, self._start, self._sent, self._index = codec, options, start_s, 0, 0

    def frame(self, *pictures: NDArray[np.uint8], step: int = 1) -> bytes:
        """The bytes of the next frame; several pictures go to streams of their own."""
        if not self._streams:
            for each in pictures:
                stream: Any = self._container.add_stream(self._codec, rate=RATE_HZ)
                stream.height, stream.width = each.shape[:2]
                stream.pix_fmt = "yuvj420p" if self._codec == "mjpeg" else "yuv420p"
                stream.options = OPTIONS[self._codec] | self._options
                stream.codec_context.time_base = Fraction(1, 90_000)
                self._streams.append(stream)
        for stream, each in zip(self._streams, pictures, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(each), format="rgb24")
            frame.pts = round(self._start * 90_000) + self._index * 90_000 // RATE_HZ
            frame.time_base = Fraction(1, 90_000)
            self._container.mux(stream.encode(frame))
        self._index += step
        return self._new()

    def end(self) -> bytes:
        """The bytes of frames that the encoder still has, and the end of the container."""
        for stream in self._streams:
            self._container.mux(stream.encode(None))
        self._container.close()
        return self._new()

    def _new(self) -> bytes:
        data = self._buffer.getvalue()
        new, self._sent = data[self._sent :], len(data)
        return new


def recorded(frames: int, form: str = "mpegts", codec: str = "libx264", **options: str) -> bytes:
    """A whole stream."""
    stream = Stream(form, codec, **options)
    return b"".join([*(stream.frame(picture(index)) for index in range(frames)), stream.end()])


def in_real_time(frames: int | None = None, start: int = 0) -> Iterator[int]:
    """Numbers of frames, as fast as a camera gives them."""
    began_s, index = time.monotonic(), start
    while frames is None or index < start + frames:
        yield index
        index += 1
        time.sleep(max(0.0, began_s + (index - start) / RATE_HZ - time.monotonic()))


Serve = Callable[[socket.socket], None]


def send_stream(connection: socket.socket, frames: int | None = None, form: str = "mpegts") -> None:
    """Send moving pictures in real time."""
    stream = Stream(form)
    for index in in_real_time(frames):
        connection.sendall(stream.frame(picture(index)))


@contextmanager
def tcp_server(serve: Serve, port: int = 0) -> Iterator[str]:
    """A server that runs `serve` for each connection; its URL."""
    listener = socket.create_server(("127.0.0.1", port))
    connections: list[socket.socket] = []

    def answer(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            serve(connection)

    def accept() -> None:
        with suppress(OSError):
            while True:
                connections.append(listener.accept()[0])
                threading.Thread(target=answer, args=(connections[-1],), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        for each in connections:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
                each.close()


@contextmanager
def http_server(serve: Callable[[Any], None], tls: ssl.SSLContext | None = None) -> Iterator[str]:
    """An HTTP server that answers every GET with `serve(handler)`; its URL."""

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            with suppress(OSError):
                serve(self)

        def log_message(self, *_: Any) -> None:
            """Say nothing."""

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    if tls is not None:
        server.socket = tls.wrap_socket(server.socket, server_side=True)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield f"http{'s' if tls else ''}://127.0.0.1:{server.server_address[1]}/stream"
    finally:
        server.shutdown()
        server.server_close()


def free_port() -> int:
    """A port of UDP that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def video_file(path: Path, frames: int, **options: str) -> Path:
    """A Matroska file of moving pictures."""
    path.write_bytes(recorded(frames, "matroska", **options))
    return path


class PhantomSender:
    """Sends a small phantom's pictures, to and fro, in real time.

    cover  a picture to send instead; None: the phantom
    url    of the server that sends to whoever connects
    """

    def __init__(self, phantom: Phantom, cover: NDArray[np.uint8] | None = None) -> None:
        frames = [phantom.frame(index) for index in range(phantom.settings.frames)]
        self.pictures = [np.concatenate([frame.left, frame.right], axis=1) for frame in frames]
        self.calibration, self.cover, self.url = phantom.settings.calibration, cover, ""

    @contextmanager
    def serving(self) -> Iterator[Self]:
        """Serve at `url`."""
        with tcp_server(self._serve) as self.url:
            yield self

    def stream(self) -> Iterator[bytes]:
        """The pieces of an MPEG-TS, each when it is due."""
        stream = Stream()
        for index in in_real_time():
            yield stream.frame(self._shown(index))

    def jpegs(self) -> Iterator[bytes]:
        """JPEG pictures of both eyes, each after its header and when it is due."""
        for index in in_real_time():
            bgr = cv2.cvtColor(self._shown(index), cv2.COLOR_RGB2BGR)
            content = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            yield PICTURE_HEADER.pack(time.time(), len(content)) + content

    def _shown(self, index: int) -> NDArray[np.uint8]:
        last = len(self.pictures) - 1
        place = index % (2 * last)
        return self.pictures[min(place, 2 * last - place)] if self.cover is None else self.cover

    def _serve(self, connection: socket.socket) -> None:
        for content in self.stream():
            connection.sendall(content)
