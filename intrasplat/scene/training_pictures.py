"""The recorded pictures of a scene's training frames, from which views take what the model misses (view/detail.py).

detail.mkv    a video of each eye that trained the model, with the training frames alone, so that no view can show
              anything of a held-out frame

Symbols: h w pixels of a picture.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

import av
import av.error
import cv2
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.errors import InputError, SceneError
from intrasplat.names import DETAIL, RECORDED
from intrasplat.names import Eye as EyeName
from intrasplat.scene.recorded_file import MASK, read_frame

EYES: tuple[EyeName, EyeName] = ("left", "right")
CODECS = {
    "libx264": {
        "preset": "veryfast",
        "tune": "psnr",
        "crf": "15",
        "x264-params": "aq-mode=0:scenecut=0:cpu-independent=1",
    },
    "libvpx-vp9": {"deadline": "realtime", "cpu-used": "8", "crf": "10", "b": "40M"},
}
"""Encoders and their options; the first that this FFmpeg has is used. Without cpu-independent, x264 codes the same
pictures differently from time to time."""
DECODERS = ("h264", "vp9")
FORMAT = "yuv444p"
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

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class RecordedEye:
    """An eye's lens, in pixels of its pictures, and its pose left_from_eye [4, 4] in the left eye's camera, mm."""

    lens: Intrinsics
    left_from_eye: NDArray[np.float64]


class TrainingPictures(Protocol):
    """Recorded pictures of training frames.

    frames  the clip's frames that there are, rising
    eyes    the left eye, and the right one if it trained the model, too
    """

    @property
    def frames(self) -> Sequence[int]: ...

    @property
    def eyes(self) -> Sequence[RecordedEye]: ...

    def picture(self, eye: int, frame: int) -> tuple[Picture, Mask]:
        """R G B [h, w, 3] of a frame, and [h, w] where it shows tissue.

        Raises:
            SceneError: the files are missing or damaged.
        """
        ...


def encoded(frames: Sequence[int], eyes: Sequence[RecordedEye], picture: Callable[[int, int], Picture]) -> bytes | None:
    """The video of these frames, each given by picture(eye, frame); None: this FFmpeg has none of CODECS."""
    found = next((name for name in CODECS if _has_encoder(name)), None)
    if found is None:
        return None
    content = io.BytesIO()
    listed = [asdict(eye.lens) | {"left_from_eye": eye.left_from_eye.ravel().tolist()} for eye in eyes]
    with av.open(content, "w", format="matroska", options={"fflags": "+bitexact"}) as container:
        container.metadata[ENTRY] = json.dumps({"frames": list(frames), "eyes": listed})
        streams = [_stream(container, found, eye.lens) for eye in eyes]
        for frame in frames:
            for eye, stream in enumerate(streams):
                coded = _frame(picture(eye, frame))
                coded.pts, coded.time_base = frame, Fraction(1, RATE_HZ)
                container.mux(stream.encode(coded))
        for stream in streams:
            container.mux(stream.encode())
    return content.getvalue()


def _has_encoder(name: str) -> bool:
    try:
        av.codec.Codec(name, "w")
    except av.codec.codec.UnknownCodecError:
        return False
    return True


def _stream(container: Any, encoder: str, lens: Intrinsics) -> VideoStream:
    stream: VideoStream = container.add_stream(encoder, rate=RATE_HZ, options=CODECS[encoder])
    stream.width, stream.height, stream.pix_fmt = lens.width, lens.height, FORMAT
    stream.codec_context.color_range = ColorRange.JPEG
    stream.codec_context.colorspace = Colorspace.ITU601
    stream.codec_context.gop_size, stream.codec_context.thread_count = KEY_EVERY, ENCODER_THREADS
    stream.codec_context.time_base = Fraction(1, RATE_HZ)
    return stream


def _frame(rgb: Picture) -> av.VideoFrame:
    """The picture in full-range YCbCr, which loses less than the usual range."""
    y_cr_cb = cv2.cvtColor(rgb, cv2.COLOR_RGB2YCrCb)
    return av.VideoFrame.from_ndarray(np.ascontiguousarray(y_cr_cb[..., [0, 2, 1]].transpose(2, 0, 1)), format=FORMAT)


def _picture(frame: av.VideoFrame) -> Picture:
    y_cr_cb = np.asarray(frame.to_ndarray(format=FORMAT), np.uint8)[[0, 2, 1]]
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(y_cr_cb.transpose(1, 2, 0)), cv2.COLOR_YCrCb2RGB), np.uint8)


class StoredPictures:
    """The TrainingPictures of a video of encoded()."""

    def __init__(self, video: Path | bytes, tissue: Callable[[int, int], Mask | None]) -> None:
        """tissue: where (eye, frame) shows tissue; None: everywhere."""
        self._video, self._tissue = video, tissue
        self._readers: dict[int, _Reader] = {}
        self._lock = Lock()

    @property
    def frames(self) -> Sequence[int]:
        """See TrainingPictures. Raises as picture() does."""
        return self._listed[0]

    @property
    def eyes(self) -> Sequence[RecordedEye]:
        """See TrainingPictures. Raises as picture() does."""
        return self._listed[1]

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

    def picture(self, eye: int, frame: int) -> tuple[Picture, Mask]:
        """See TrainingPictures."""
        with self._lock:
            if eye not in self._readers:
                self._readers[eye] = _Reader(self._opened(), eye)
            rgb = self._readers[eye].picture(frame)
        tissue = self._tissue(eye, frame)
        if tissue is not None and tissue.shape != rgb.shape[:2]:
            raise SceneError(f"The masks of this scene do not fit {DETAIL}.")
        return rgb, np.ones(rgb.shape[:2], np.bool_) if tissue is None else tissue

    def _opened(self) -> Any:
        options = {"protocol_whitelist": "file", "codec_whitelist": ",".join(DECODERS), "max_pixels": str(MAX_PIXELS)}
        try:
            video = io.BytesIO(self._video) if isinstance(self._video, bytes) else str(self._video)
            return av.open(video, format="matroska", options=options)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise SceneError(f"{DETAIL} of this scene cannot be read ({type(error).__name__}).") from error


def pictures_of(folder: Path) -> StoredPictures:
    """The TrainingPictures of a scene's folder, with the masks in recorded.zip."""

    def tissue(eye: int, frame: int) -> Mask | None:
        count = frame + 1
        try:
            index, png = read_frame(folder / RECORDED, count, frame / count, EYES[eye], MASK)
        except InputError:  # nothing is masked
            return None
        tool = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
        if index != frame or tool is None:
            raise SceneError(f"A mask of this scene is damaged, or does not fit {DETAIL}.")
        return np.asarray(tool == 0)

    return StoredPictures(folder / DETAIL, tissue)


def _eye(entry: dict[str, Any]) -> RecordedEye:
    pose = np.array(entry.pop("left_from_eye"), np.float64).reshape(4, 4)
    if not np.isfinite(pose).all():
        raise ValueError("a pose is not finite")
    return RecordedEye(Intrinsics(**entry), pose)


class _Reader:
    """Decodes the pictures of an eye. The frames after the last one are decoded without a seek."""

    def __init__(self, container: Any, eye: int) -> None:
        self._container, self._stream = container, container.streams.video[eye]
        self._coming: Iterator[Any] = iter(())
        self._last: int | None = None

    def picture(self, frame: int) -> Picture:
        """Raises SceneError if the frame is missing or damaged."""
        try:
            if self._last is None or not self._last < frame <= self._last + KEY_EVERY:
                self._container.seek(round(frame / RATE_HZ / self._stream.time_base), stream=self._stream)
                self._coming = self._container.decode(self._stream)
            for each in self._coming:
                self._last = round(each.pts * each.time_base * RATE_HZ)
                if self._last >= frame:
                    break
            if self._last == frame:
                return _picture(each)
        except (av.error.FFmpegError, ValueError) as error:
            self._last = None
            raise SceneError(f"{DETAIL} of this scene is damaged ({type(error).__name__}).") from error
        self._last = None
        raise SceneError(f"{DETAIL} of this scene has no frame {frame}.")
