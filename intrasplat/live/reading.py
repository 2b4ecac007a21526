"""Packets of a source, as the confined process reads them: the connection that it inherited, a file, a device, or an
RTSP relay."""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from typing import Any, cast

import av
import av.container
import av.error

from intrasplat.intake.video_header import CODECS
from intrasplat.live.spec import PICTURE_HEADER, STREAM_HEAD_BYTES, stream_format
from intrasplat.live.state import FeedReason

PICTURE_CODECS = {b"\xff\xd8\xff": "mjpeg", b"RIFF": "webp"}
MAX_PICTURE_BYTES = 32 << 20
PICTURE_TICK = Fraction(1, 1_000_000)
PICTURE_JITTER = 500_000
"""Times of pushed pictures that fall by fewer ticks are taken for the one before."""
PROBE = {"probesize": str(1 << 20), "analyzeduration": "500000", "fpsprobesize": "0"}
"""FFmpeg looks at the start of a stream for this many bytes or microseconds, and not at all to guess its rate."""
MAX_ERRORS = 100
"""This many damaged packets in a row end the connection."""
MAX_STREAMS = 2
NOT_OPENED: dict[type[Exception], str] = {
    av.error.HTTPUnauthorizedError: ": the server asks for another user and password",
    av.error.HTTPForbiddenError: ": the server forbids it",
    av.error.HTTPNotFoundError: ": the server has no such stream",
    av.error.InvalidDataError: ": its beginning cannot be read",
    PermissionError: ": access is denied",
    FileNotFoundError: ": it is not there",
}
"""What is said of errors of opening; their own text is not for whoever looks at the feed."""
NOT_FRAGMENTED = "the mp4 is not fragmented, and its index comes last; send it with -movflags frag_keyframe+empty_moov"


class SourceEnd(Exception):
    """The source cannot be read any further."""

    def __init__(self, reason: FeedReason, text: str) -> None:
        super().__init__(text)
        self.reason, self.text = reason, text


@dataclass(frozen=True)
class Arrived:
    """A packet. stream counts the source's video streams; arrived_at is UNIX time, s."""

    packet: av.Packet[Any]
    stream: int
    arrived_at: float
    codec: str

    @property
    def shown_s(self) -> float:
        """When it is shown, s of the source's clock."""
        return float(Fraction(self.packet.pts or 0) * self.packet.time_base)

    @property
    def decoding_s(self) -> float:
        """When it is decoded, s of the source's clock."""
        stamp = self.packet.dts if self.packet.dts is not None else self.packet.pts
        return float(Fraction(stamp or 0) * self.packet.time_base)

    def picture_size(self) -> tuple[int, int] | None:
        """Height and width of a picture that is coded by itself; None if it is damaged."""
        try:
            frames = cast(av.VideoCodecContext, av.CodecContext.create(self.codec, "r")).decode(self.packet)
        except (av.error.FFmpegError, ValueError):
            return None
        return (frames[0].height, frames[0].width) if frames else None


class Bytes:
    """An inherited connection or pipe as a file that can only be read forward. arrived_at: when it last gave bytes."""

    def __init__(self, source: int | HTTPResponse) -> None:
        self._source, self._rest = source, b""
        self.arrived_at = time.time()

    def read(self, size: int = 1 << 15) -> bytes:
        """Some bytes, at most `size`; none at the end."""
        if not self._rest:
            most = max(size, 1 << 16)  # a datagram comes whole
            if isinstance(self._source, int):
                self._rest = os.read(self._source, most)
            else:
                self._rest = self._source.read1(most)
            self.arrived_at = time.time()
        piece, self._rest = self._rest[:size], self._rest[size:]
        return piece

    def exactly(self, size: int) -> bytes:
        """`size` bytes, or fewer at the end."""
        pieces = []
        while size and (piece := self.read(size)):
            pieces.append(piece)
            size -= len(piece)
        return b"".join(pieces)

    def head(self, size: int) -> bytes:
        """The next bytes, which are read again."""
        found = self.exactly(size)
        self._rest = found + self._rest
        return found


class PacketSource:
    """A source that was opened. Its container, or None for pushed pictures."""

    def __init__(self, request: dict[str, Any], max_pixels: int) -> None:
        """Raises SourceEnd if it cannot be opened."""
        self._request, self._max_pixels = request, max_pixels
        self._bytes: Bytes | None = None
        self._at_end = (FeedReason.CLOSED, "the source closed the connection")
        self.is_paced = "file" in request
        if "http" in request:
            response = _answer(request["input"], request["http"])
            self._bytes = Bytes(response)
            if response.length is not None:
                self._at_end = (FeedReason.END_OF_FILE, "the file has ended")
                self.is_paced = True
        elif "input" in request:
            self._bytes = Bytes(int(request["input"]))
        elif "file" in request:
            self._at_end = (FeedReason.END_OF_FILE, "the file has ended")
        self.container = None if request.get("pictures") else self._opened()
        self.streams = [] if self.container is None else self._videos(self.container)

    def packets(self) -> Iterator[Arrived]:
        """Packets as they come in, with times. Raises SourceEnd when there are no more."""
        yield from self._pictures() if self.container is None else self._demuxed(self.container)
        raise SourceEnd(*self._at_end)

    def _opened(self) -> av.container.InputContainer:
        options = {"codec_whitelist": ",".join(CODECS), "max_pixels": str(self._max_pixels)}
        try:
            if "rtsp" in self._request:
                own = {"protocol_whitelist": "rtsp,rtp,tcp", "rtsp_transport": "tcp"}
                return av.open(str(self._request["rtsp"]), "r", format="rtsp", options=options | PROBE | own)
            if "device" in self._request:
                options["codec_whitelist"] += ",rawvideo"
                options |= {str(name): str(value) for name, value in self._request["options"].items()}
                own = {"protocol_whitelist": "file"}
                return av.open(str(self._request["device"]), "r", format="video4linux2", options=options | own)
            if self._bytes is None:
                path = Path(self._request["file"])
                with path.open("rb") as file:
                    form = _format(file.read(STREAM_HEAD_BYTES))
                return av.open(str(path), "r", format=form, options=options | {"protocol_whitelist": "file"})
            form = _format(self._bytes.head(STREAM_HEAD_BYTES))
            return av.open(self._bytes, "r", format=form, options=options | PROBE | {"protocol_whitelist": "none"})
        except (av.error.FFmpegError, OSError, ValueError) as error:
            if isinstance(error, (EOFError, ConnectionError)):
                raise SourceEnd(FeedReason.CLOSED, "the source closed the connection before a picture came") from error
            why = next((text for kind, text in NOT_OPENED.items() if isinstance(error, kind)), "")
            text = f"the source cannot be opened{why}"
            is_network = isinstance(error, av.error.HTTPError | av.error.TimeoutError) or "rtsp" in self._request
            raise SourceEnd(FeedReason.REFUSED if is_network else FeedReason.UNDECODABLE, text) from error

    def _videos(self, container: av.container.InputContainer) -> list[av.VideoStream]:
        known = (*CODECS, "rawvideo") if "device" in self._request else CODECS
        videos = [each for each in container.streams.video if each.codec_context and each.codec_context.name in known]
        if not videos:
            accepted = ", ".join(CODECS)
            raise SourceEnd(FeedReason.NO_VIDEO, f"the source has no video with one of the codecs {accepted}")
        return videos[:MAX_STREAMS]

    def _demuxed(self, container: av.container.InputContainer) -> Iterator[Arrived]:
        numbers = {stream.index: number for number, stream in enumerate(self.streams)}
        errors, is_empty, started_at = 0, True, time.time()
        while True:
            try:
                for packet in container.demux(self.streams):
                    if not packet.size:
                        continue
                    errors, is_empty = 0, False
                    arrived_at = time.time() if self._bytes is None else self._bytes.arrived_at
                    number = numbers[packet.stream.index]
                    if packet.pts is None:
                        packet.pts = packet.dts
                    if packet.pts is None:
                        packet.pts = packet.dts = round((arrived_at - started_at) / packet.time_base)
                    yield Arrived(packet, number, arrived_at, self.streams[number].codec_context.name)
                return
            except av.error.InvalidDataError:
                errors += 1
                if is_empty and self._bytes is not None and any(stream.frames for stream in self.streams):
                    raise SourceEnd(FeedReason.UNDECODABLE, NOT_FRAGMENTED) from None
                if errors > MAX_ERRORS:
                    raise SourceEnd(FeedReason.UNDECODABLE, "the source sends no video") from None
            except (av.error.FFmpegError, OSError, HTTPException):
                return

    def _pictures(self) -> Iterator[Arrived]:
        assert self._bytes is not None
        started_at, last = time.time(), -1
        while len(header := self._bytes.exactly(PICTURE_HEADER.size)) == PICTURE_HEADER.size:
            time_s, size = PICTURE_HEADER.unpack(header)
            if size > MAX_PICTURE_BYTES:
                raise SourceEnd(FeedReason.PICTURE_LIMIT, f"a picture has {size} bytes")
            data = self._bytes.exactly(size)
            arrived_at = self._bytes.arrived_at
            codec = next((name for head, name in PICTURE_CODECS.items() if data.startswith(head)), None)
            if codec is None:
                raise SourceEnd(FeedReason.UNDECODABLE, "a picture is neither JPEG nor WebP")
            packet: av.Packet[Any] = av.Packet(data)
            stamp = round((arrived_at - started_at if math.isnan(time_s) else time_s) / PICTURE_TICK)
            last = last + 1 if 0 <= last - stamp < PICTURE_JITTER else stamp
            packet.pts = packet.dts = last
            packet.time_base, packet.is_keyframe = PICTURE_TICK, True
            yield Arrived(packet, 0, arrived_at, codec)


def _format(head: bytes) -> str:
    """FFmpeg's demuxer of a stream that begins so."""
    if not head:
        raise SourceEnd(FeedReason.CLOSED, "the source closed the connection before a picture came")
    form = stream_format(head)
    if form is None:
        text = "the source sends neither an MPEG transport stream, nor mp4 nor Matroska"
        raise SourceEnd(FeedReason.UNDECODABLE, text)
    return form


def _answer(connected: int, http: dict[str, Any]) -> HTTPResponse:
    """The answer to a GET over an open connection. Raises SourceEnd unless it is 200."""
    link = socket.socket(fileno=connected)
    try:
        lines = (f"GET {http['path']} HTTP/1.1", f"Host: {http['host']}", "Accept: video/*", "Connection: close")
        link.sendall("\r\n".join((*lines, "", "")).encode())
        response = HTTPResponse(link, method="GET")
        response.begin()
    except (OSError, HTTPException, ValueError) as error:
        raise SourceEnd(FeedReason.REFUSED, "the server does not speak HTTP") from error
    if 300 <= response.status < 400:
        raise SourceEnd(FeedReason.REDIRECTED, "the server redirects to another place, which is not followed")
    if response.status != 200:
        raise SourceEnd(FeedReason.REFUSED, f"the server answers {response.status}")
    return response
