"""The video of a scene's training frames: its file, without pictures in RGB (intrasplat/scene/training_pictures.py).

detail.mkv    Matroska, a track for each eye that trained the model, of the training frames alone, so that no view can
              show anything of a held-out frame

A picture is a frame of FFmpeg in FORMAT, full range, ITU-R BT.601. Odd sizes are enlarged by one row or column.
"""

from __future__ import annotations

import io
import json
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import av
import av.error
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.errors import SceneError
from intrasplat.names import DETAIL

CODECS = {
    "libx264": {
        "preset": "veryfast",
        "tune": "psnr",
        "crf": "4",
        "x264-params": "aq-mode=0:scenecut=0:cpu-independent=1",
    },
    "libvpx-vp9": {"deadline": "realtime", "cpu-used": "8", "crf": "4", "b": "100M"},
}
"""Encoders and their options; the first that this FFmpeg has is used. Without cpu-independent, x264 codes the same
pictures differently from time to time."""
DECODERS = ("h264", "vp9")
FORMAT = "yuv420p"
"""Recordings hardly ever have colours in full resolution, and this is the only format that all browsers decode."""
KEY_EVERY = 24
"""Frames from one that is coded by itself to the next: a frame is found by decoding half as many on average, and the
frame after the last one by decoding one."""
ENCODER_THREADS = 2
"""Fixed, so that the same pictures give the same bytes on all machines."""
RATE_HZ = 25
"""Frame i of the clip lies at i / RATE_HZ."""
MAX_PIXELS = 1 << 20
ENTRY = "intrasplat"
"""The container's tag with frames and eyes as JSON."""
CACHED = 8
"""Decoded frames of an eye in memory."""
JPEG_QUALITY = 5
"""FFmpeg's scale, from 2 (best) to 31."""


@dataclass(frozen=True, eq=False)
class RecordedEye:
    """An eye's lens, in pixels of its pictures, and its pose left_from_eye [4, 4] in the left eye's camera, mm."""

    lens: Intrinsics
    left_from_eye: NDArray[np.float64]


def encoded(
    frames: Sequence[int], eyes: Sequence[RecordedEye], picture: Callable[[int, int], av.VideoFrame]
) -> bytes | None:
    """The video of these frames, each given by picture(eye, frame).

    None: there are no frames, or this FFmpeg has none of CODECS.
    """
    found = next((name for name in CODECS if has_encoder(name)), None)
    if found is None or not frames:
        return None
    content = io.BytesIO()
    listed = [asdict(eye.lens) | {"left_from_eye": eye.left_from_eye.ravel().tolist()} for eye in eyes]
    with av.open(content, "w", format="matroska", options={"fflags": "+bitexact"}) as container:
        container.metadata[ENTRY] = json.dumps({"frames": list(frames), "eyes": listed})
        streams = [_stream(container, found, eye.lens) for eye in eyes]
        for frame in frames:
            for eye, stream in enumerate(streams):
                coded = picture(eye, frame)
                coded.pts, coded.time_base = frame, Fraction(1, RATE_HZ)
                container.mux(stream.encode(coded))
        for stream in streams:
            container.mux(stream.encode())
    return content.getvalue()


def even(size: int) -> int:
    """The size in pixels of a picture's side in the video."""
    return size + size % 2


def has_encoder(name: str) -> bool:
    """Whether this FFmpeg has the encoder."""
    try:
        av.codec.Codec(name, "w")
    except av.codec.codec.UnknownCodecError:
        return False
    return True


def _stream(container: Any, encoder: str, lens: Intrinsics) -> VideoStream:
    stream: VideoStream = container.add_stream(encoder, rate=RATE_HZ, options=CODECS[encoder])
    stream.width, stream.height, stream.pix_fmt = even(lens.width), even(lens.height), FORMAT
    stream.codec_context.color_range = ColorRange.JPEG
    stream.codec_context.colorspace = Colorspace.ITU601
    stream.codec_context.gop_size, stream.codec_context.thread_count = KEY_EVERY, ENCODER_THREADS
    stream.codec_context.time_base = Fraction(1, RATE_HZ)
    return stream


class RecordedVideo:
    """A video of encoded(). Several threads may use it."""

    def __init__(self, video: Path | bytes) -> None:
        self._video = video
        self._readers: dict[int, _Reader] = {}
        self._lock = Lock()

    @property
    def frames(self) -> tuple[int, ...]:
        """Its frames of the clip, rising. Raises as picture() does."""
        return self._listed[0]

    @property
    def eyes(self) -> tuple[RecordedEye, ...]:
        """The left eye, and the right one if it trained the model, too. Raises as picture() does."""
        return self._listed[1]

    def picture(self, eye: int, frame: int) -> av.VideoFrame:
        """A frame of an eye.

        Raises:
            SceneError: the file is missing or damaged, or has no such frame.
        """
        with self._lock:
            if eye not in self._readers:
                self._readers[eye] = _Reader(self._opened(), eye)
            return self._readers[eye].picture(frame)

    def jpeg(self, eye: int, frame: int) -> bytes:
        """A frame of an eye as JPEG. Raises as picture() does."""
        return _jpeg(self.picture(eye, frame), self.eyes[eye].lens)

    @cached_property
    def _listed(self) -> tuple[tuple[int, ...], tuple[RecordedEye, ...]]:
        with self._opened() as container:
            try:
                entry = json.loads(container.metadata[ENTRY.upper()])
                frames = tuple(int(frame) for frame in entry["frames"])
                eyes = tuple(_eye(each) for each in entry["eyes"])
            except (KeyError, TypeError, ValueError) as error:
                raise SceneError(f"{DETAIL} of this scene is damaged ({type(error).__name__}).") from error
            if len(container.streams.video) != len(eyes) or not frames:
                raise SceneError(f"{DETAIL} of this scene is damaged: its eyes or frames are missing.")
            return frames, eyes

    def _opened(self) -> Any:
        options = {"protocol_whitelist": "file", "codec_whitelist": ",".join(DECODERS), "max_pixels": str(MAX_PIXELS)}
        try:
            video = io.BytesIO(self._video) if isinstance(self._video, bytes) else str(self._video)
            return av.open(video, format="matroska", options=options)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise SceneError(f"{DETAIL} of this scene cannot be read ({type(error).__name__}).") from error


def _eye(entry: dict[str, Any]) -> RecordedEye:
    pose = np.array(entry.pop("left_from_eye"), np.float64).reshape(4, 4)
    if not np.isfinite(pose).all():
        raise ValueError("a pose is not finite")
    return RecordedEye(Intrinsics(**entry), pose)


def _jpeg(picture: av.VideoFrame, lens: Intrinsics) -> bytes:
    if (picture.width, picture.height) != (lens.width, lens.height):
        rgb = np.asarray(picture.to_ndarray(format="rgb24"), np.uint8)[: lens.height, : lens.width]
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
    encoder: Any = av.CodecContext.create("mjpeg", "w")
    encoder.width, encoder.height, encoder.pix_fmt = picture.width, picture.height, "yuvj420p"
    encoder.time_base, encoder.color_range = Fraction(1, RATE_HZ), ColorRange.JPEG
    encoder.qmin = encoder.qmax = JPEG_QUALITY
    full = picture.reformat(format="yuvj420p", dst_color_range=ColorRange.JPEG)
    full.pts = 0
    return b"".join(bytes(packet) for packet in (*encoder.encode(full), *encoder.encode(None)))


class _Reader:
    """Decodes the pictures of an eye. The frames after the last one are decoded without a seek."""

    def __init__(self, container: Any, eye: int) -> None:
        self._container, self._stream = container, container.streams.video[eye]
        self._coming: Iterator[Any] = iter(())
        self._last: int | None = None
        self._decoded: OrderedDict[int, av.VideoFrame] = OrderedDict()

    def picture(self, frame: int) -> av.VideoFrame:
        """Raises SceneError if the frame is missing or damaged."""
        if frame not in self._decoded:
            try:
                self._decode(frame)
            except (av.error.FFmpegError, ValueError) as error:
                self._last = None
                raise SceneError(f"{DETAIL} of this scene is damaged ({type(error).__name__}).") from error
        if frame not in self._decoded:
            self._last = None
            raise SceneError(f"{DETAIL} of this scene has no frame {frame}.")
        return self._decoded[frame]

    def _decode(self, frame: int) -> None:
        if self._last is None or not self._last < frame <= self._last + KEY_EVERY:
            self._container.seek(round(frame / RATE_HZ / self._stream.time_base), stream=self._stream)
            self._coming = self._container.decode(self._stream)
        for each in self._coming:
            self._last = round(each.pts * each.time_base * RATE_HZ)
            if each.format.name not in (FORMAT, "yuvj420p"):
                raise ValueError(f"pictures in {each.format.name}")
            self._decoded[self._last] = each
            while len(self._decoded) > CACHED:
                self._decoded.popitem(last=False)
            if self._last >= frame:
                break
