"""Records videos as recorders do: other clocks, fields, rotation, pixels that are not square; and damages them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.uint8]
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
