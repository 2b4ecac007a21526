"""Decodes a video file with PyAV: local files, two demuxers and three decoders, whatever else FFmpeg has.

Symbols: H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import av.container
import av.error
import numpy as np
from av.video.reformatter import VideoReformatter

from intrasplat.clip.damage import PacketLog, Sample
from intrasplat.clip.types import RgbFrame
from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.video_header import CODECS, is_matroska

COLOUR_REMEDY = "Export it again with the colours of BT.709 or BT.601."
_CODED_MARGIN = 2
"""A decoder's picture may be this many times as large as the shown one: it is coded in blocks and cropped."""


@contextmanager
def open_stream(path: Path, limits: ClipLimits, *, with_hidden: bool = False) -> Iterator[av.VideoStream | None]:
    """The first video stream with one of CODECS in a file; None if there is none. It is valid inside the context.

    with_hidden: also the frames outside of an mp4's edit list.
    """
    options = {
        "protocol_whitelist": "file",
        "codec_whitelist": ",".join(CODECS),
        "max_pixels": str(_CODED_MARGIN * limits.pixels_per_frame),
    }
    if with_hidden:
        options["advanced_editlist"] = "0"
    try:
        container = av.open(str(path), format="matroska" if is_matroska(path) else "mov", options=options)
    except MemoryError:
        raise
    except (av.error.FFmpegError, ValueError):  # damaged beyond use
        yield None
        return
    with container:
        for stream in container.streams.video:
            if stream.codec_context is not None and stream.codec_context.codec.name in CODECS:
                stream.codec_context.options = {"max_pixels": options["max_pixels"]}
                stream.codec_context.thread_type = "AUTO"
                yield stream
                return
        yield None


def decoded(stream: av.VideoStream, log: PacketLog) -> Iterator[av.VideoFrame]:
    """The frames in the order of display. Damaged packets are skipped and counted in `log`.

    A decoder with several threads reports a damaged packet late, so only frames that are missing tell which it was.
    """
    packets = _packets(stream, log)
    for packet in packets:
        try:
            frames = packet.decode()
        except MemoryError:
            raise
        except (av.error.FFmpegError, ValueError):
            log.failures += 1
            continue
        for frame in frames:
            assert isinstance(frame, av.VideoFrame)
            yield frame


def count_packets(stream: av.VideoStream) -> int:
    """The number of the stream's packets, none of which is decoded."""
    log = PacketLog()
    for _ in _packets(stream, log):
        pass
    return len(log.samples)


def _packets(stream: av.VideoStream, log: PacketLog) -> Iterator[av.Packet[av.VideoStream]]:
    container = stream.container
    assert isinstance(container, av.container.InputContainer)
    try:
        for packet in container.demux(stream):
            if packet.size:  # the last is empty and makes the decoder hand out what it holds
                log.samples.append(Sample(packet.pts, packet.is_keyframe, packet.is_discard))
            yield packet
    except MemoryError:
        raise
    except (av.error.FFmpegError, ValueError):  # the container is damaged from here on
        log.failures += 1


class RgbConverter:
    """Converts frames to RGB by their own matrix and range; BT.601 if they name none."""

    def __init__(self, field: str, label: str) -> None:
        self._field, self._label = field, label
        self._reformatter = VideoReformatter()

    def __call__(self, frame: av.VideoFrame) -> RgbFrame:
        """The frame as RGB uint8 [H, W, 3]. InputError if its colours cannot be converted."""
        try:
            return np.ascontiguousarray(self._reformatter.reformat(frame, format="rgb24").to_ndarray(), np.uint8)
        except MemoryError:
            raise
        except (OSError, ValueError):
            problem = f"the colours of {self._label} are coded in a way that cannot be converted to RGB"
            raise InputError(self._field, f"{problem} (matrix {frame.colorspace}).", COLOUR_REMEDY) from None
