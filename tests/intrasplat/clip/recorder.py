"""Records, edits and damages videos as recorders do: other clocks, fields, rotation, pixels that are not square."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.uint8]
Edit = Callable[[Path], Path]
TICK_HZ = 1000


def record(
    path: Path,
    frames: Frames,
    *,
    codec: str = "libx264",
    pixel_format: str = "yuv420p",
    times_ms: Sequence[int] | None = None,
    options: dict[str, str] | None = None,
    pixel_aspect: Fraction | None = None,
    rotation_deg: int = 0,
    keyframes: int = 250,
) -> Path:
    """A video of RGB frames [T, H, W, 3], 25 a second or at these times; the suffix of path chooses the container."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options={"crf": "10", "g": str(keyframes)} | (options or {}))
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width, stream.pix_fmt = frames.shape[1], frames.shape[2], pixel_format
        stream.time_base = stream.codec_context.time_base = Fraction(1, TICK_HZ)
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
        if rotation_deg:
            stream.set_display_rotation(rotation_deg)
        for index, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            frame.pts = index * 40 if times_ms is None else times_ms[index]
            frame.time_base = Fraction(1, TICK_HZ)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def damaged(path: Path, packet: int) -> Path:
    """The video with zeros where packet `packet` was, in order of decoding."""
    with av.open(str(path)) as container:
        places = [(each.pos, each.size) for each in container.demux(video=0) if each.size]
    start, size = places[packet]
    data = bytearray(path.read_bytes())
    data[start + 4 : start + size] = bytes(size - 4)
    target = path.with_stem(f"{path.stem}-damaged-{packet}")
    target.write_bytes(data)
    return target


def woven(frames: Frames, order: str = "tff") -> Frames:
    """Interlaced video of half as many frames: each has the rows of two moments."""
    first, second = frames[0::2], frames[1::2]
    result = first.copy()
    parity = 1 if order == "tff" else 0  # of the rows of the later field
    result[:, parity::2] = second[:, parity::2]
    return result


def telecined(film: Frames) -> Frames:
    """3:2 pulldown: five frames of video from each four of film, of which the third and fourth are woven."""
    shots = []
    for a, b, c, d in film[: len(film) // 4 * 4].reshape(-1, 4, *film.shape[1:]):
        shots += [a, b, woven(np.stack([b, c]))[0], woven(np.stack([c, d]))[0], d]
    return np.stack(shots)


def record_bt709(path: Path, frames: Frames) -> Path:
    """The frames in the matrix of HDTV and in full range, both named in the stream."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "10"})
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
        stream.codec_context.colorspace, stream.codec_context.color_range = 1, 2
        for pixels in frames:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=1, dst_color_range=2)))
        container.mux(stream.encode(None))
    return path


def copied(*, sound_s: float = 0.0, first: int = 0, early_ms: int = 0, options: dict[str, str] | None = None) -> Edit:
    """A new container with the packets from `first` on, early_ms earlier, and with sound_s of silence from 0 on."""

    def edit(path: Path) -> Path:
        target = path.with_stem("copied")
        with av.open(str(path)) as source, av.open(str(target), "w", options=options or {}) as container:
            stream = container.add_stream_from_template(source.streams.video[0])
            if sound_s:
                sound = container.add_stream("aac", rate=48000, layout="mono")
                for index in range(int(sound_s * 48000 / 1024)):
                    frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
                    frame.sample_rate, frame.pts = 48000, 1024 * index
                    container.mux(sound.encode(frame))
                container.mux(sound.encode(None))
            for packet in [each for each in source.demux(video=0) if each.size][first:]:
                assert packet.pts is not None
                assert packet.dts is not None
                assert packet.time_base is not None
                ticks = int(Fraction(early_ms, 1000) / packet.time_base)
                packet.pts, packet.dts, packet.stream = packet.pts - ticks, packet.dts - ticks, stream
                container.mux(packet)
        return target

    return edit


def cut(share: float) -> Edit:
    """The first part of the file."""

    def edit(path: Path) -> Path:
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        return path

    return edit


def long_header(path: Path) -> Path:
    """Matroska that names the length of its longer sound."""
    data = path.read_bytes()
    at = data.index(b"\x44\x89\x88") + 3
    path.write_bytes(data[:at] + struct.pack(">d", 9000.0) + data[at + 8 :])
    return path
