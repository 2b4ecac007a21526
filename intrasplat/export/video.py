"""Export the clip as a video without instruments: from the endoscope, from a moving camera, or for both eyes.

Symbols: F frames of the video, H W pixels.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from numpy.typing import NDArray

from intrasplat.errors import InputError
from intrasplat.export.target import ExportTarget
from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.scene.recorded_video import has_encoder
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.render import render_frame
from intrasplat.view.unseen import hatched

ENCODERS = {
    "webm": {"libvpx": {"deadline": "realtime", "cpu-used": "8", "crf": "10", "b": "8M"}},
    "mp4": {
        "libx264": {"preset": "veryfast", "crf": "18"},
        "libopenh264": {"b": "8M"},
        "libvpx-vp9": {"deadline": "realtime", "cpu-used": "6", "crf": "24", "b": "0"},
    },
}
"""Encoders of each container, and their options; the first that this FFmpeg has is used. H.264 plays everywhere."""
CONTAINER_OPTIONS = {"webm": {}, "mp4": {"movflags": "+faststart"}}
PIXELS = "yuv420p"
TIME_BASE = Fraction(1, 90_000)
ENCODER_THREADS = 2
MIN_RATE_HZ, MAX_RATE_HZ = 1.0, 120.0
STILL_RATE_HZ = 25.0
"""Frame rate of a video of one moment."""
CIRCLE_S, ROCK_S = 6.0, 4.0
"""How long one turn takes."""
ROCK_DEG = 8.0
"""Half angle of rocking, to the sides."""
CIRCLE_DEG = (10.0, 6.0)
"""Half angles of the circle, to the sides and up and down, about the middle of what the endoscope sees."""
PIECE_BYTES = 1 << 20

Picture = NDArray[np.uint8]


def video_parts(container: str) -> Callable[[ExportTarget], Iterator[bytes]]:
    """The writer of a video in a container of ENCODERS."""

    def parts(target: ExportTarget) -> Iterator[bytes]:
        pictures, rate_hz = _pictures(target)
        with tempfile.TemporaryDirectory(prefix="intrasplat-") as folder:
            path = Path(folder) / f"video.{container}"
            yield from _encoded(pictures, rate_hz, path, container)
            with path.open("rb") as file:
                while piece := file.read(PIECE_BYTES):
                    yield piece

    return parts


def _encoded(pictures: Iterator[Picture], rate_hz: float, path: Path, container: str) -> Iterator[bytes]:
    """Write pictures [H, W, 3] RGB into a file; yield b"" after each. An odd last row or column is cut off."""
    encoder = next((name for name in ENCODERS[container] if has_encoder(name)), None)
    if encoder is None:
        raise InputError(
            "format", f"This FFmpeg cannot write {path.suffix}.", "Install the av that pyproject.toml names."
        )
    with av.open(str(path), "w", format=container, options=CONTAINER_OPTIONS[container]) as out:
        stream: VideoStream | None = None
        for index, picture in enumerate(pictures):
            height, width = (length - length % 2 for length in picture.shape[:2])
            stream = stream or _stream(out, encoder, ENCODERS[container][encoder], rate_hz, (width, height))
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture[:height, :width]), format="rgb24")
            frame = frame.reformat(format=PIXELS, dst_colorspace=Colorspace.ITU601, dst_color_range=ColorRange.MPEG)
            frame.pts, frame.time_base = round(index / (rate_hz * TIME_BASE)), TIME_BASE
            out.mux(stream.encode(frame))
            yield b""
        if stream is not None:
            out.mux(stream.encode())


def _stream(out: Any, encoder: str, options: dict[str, str], rate_hz: float, size: tuple[int, int]) -> VideoStream:
    stream: VideoStream = out.add_stream(encoder, rate=Fraction(rate_hz).limit_denominator(1001), options=options)
    stream.width, stream.height, stream.pix_fmt = *size, PIXELS
    stream.codec_context.color_range, stream.codec_context.colorspace = ColorRange.MPEG, Colorspace.ITU601
    stream.codec_context.thread_count, stream.codec_context.time_base = ENCODER_THREADS, TIME_BASE
    return stream


def _pictures(target: ExportTarget) -> tuple[Iterator[Picture], float]:
    """The video's pictures, and the frame rate in Hz."""
    options, scene = target.options, target.scene
    seconds = float(scene.frame_times_s[-1] - scene.frame_times_s[0])
    rate_hz = STILL_RATE_HZ
    if options.t is None and seconds > 0:
        clip_hz = (scene.frame_count - 1) / seconds
        rate_hz = min(max(clip_hz / (options.every or 1), MIN_RATE_HZ), MAX_RATE_HZ)
    if options.view == "stereo":
        return _both_eyes(target, _baseline_mm(target)), rate_hz
    if options.view == "orbit":
        return _turning(target, rate_hz, CIRCLE_S, CIRCLE_DEG), rate_hz
    if options.view == "rock":
        return _turning(target, rate_hz, ROCK_S, (ROCK_DEG, 0.0)), rate_hz
    return (_shown(target, target.time_of(frame)) for frame in target.frames), rate_hz


def _shown(target: ExportTarget, t: float, pose: NDArray[np.float64] | None = None, shift_px: float = 0.0) -> Picture:
    """A picture from a pose (None: the endoscope's own), shifted right by shift_px; unseen pixels are hatched."""
    camera = target.scene.intrinsics
    camera = dataclasses.replace(camera, cx=camera.cx + shift_px)
    frame = render_frame(target.scene, t, pose, camera, target.device)
    return hatched(frame.rgb, frame.unseen)


def _turning(target: ExportTarget, rate_hz: float, turn_s: float, half_deg: tuple[float, float]) -> Iterator[Picture]:
    """Pictures of a camera that goes round an ellipse of these half angles, to the sides and up and down: while the
    clip plays, or once at the chosen moment.
    """
    scene, fixed_t = target.scene, target.options.t
    pivot_mm = MEDIAN_DEPTH_UNITS / scene.units_per_mm
    turn = round(turn_s * rate_hz)
    times = [target.t] * turn if fixed_t is not None else [target.time_of(frame) for frame in target.frames]
    for index, t in enumerate(times):
        angle = 2 * math.pi * index / turn
        yaw_deg, pitch_deg = half_deg[0] * math.sin(angle), half_deg[1] * math.cos(angle)
        around = OrbitPose(yaw_deg=yaw_deg, pitch_deg=pitch_deg, zoom=1)
        yield _shown(target, t, endoscope_pose(scene, t) @ np.array(world_from_camera(around, pivot_mm)))


def _baseline_mm(target: ExportTarget) -> NDArray[np.float64]:
    """[3] position of the right eye in the left one's axes.

    Raises:
        InputError: neither the scene nor the caller gives it.
    """
    if target.options.baseline_mm is not None:
        return np.array([target.options.baseline_mm, 0.0, 0.0])
    if target.scene.right_eye_mm is None:
        problem = "This scene was taught by one eye and does not know where the other is."
        raise InputError("baseline_mm", problem, "Give the distance of the eyes, such as baseline_mm=4.3.")
    return np.array(target.scene.right_eye_mm)


def _both_eyes(target: ExportTarget, baseline_mm: NDArray[np.float64]) -> Iterator[Picture]:
    """Left and right side by side, each of full width. Both eyes look in the same direction. The right picture is
    shifted so that tissue at the median depth appears in the plane of the screen.
    """
    scene = target.scene
    shift_px = scene.intrinsics.fx * float(baseline_mm[0]) * scene.units_per_mm / MEDIAN_DEPTH_UNITS
    right_from_left = np.eye(4)
    right_from_left[:3, 3] = baseline_mm
    for frame in target.frames:
        t = target.time_of(frame)
        own = endoscope_pose(scene, t)
        left, right = _shown(target, t, own), _shown(target, t, own @ right_from_left, shift_px)
        yield np.concatenate([left, right], axis=1)
