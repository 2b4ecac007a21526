"""Export the clip as a video without instruments: from the endoscope, from a circling camera, or for both eyes.

Symbols: F frames of the video, H W pixels.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.errors import InputError
from intrasplat.export.target import ExportTarget
from intrasplat.machine.opencv import silent_stderr
from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.render import render_frame
from intrasplat.view.unseen import hatched

CODECS = {"webm": "VP80", "mp4": "vp09"}
"""VP8 takes a third of the time and twice the bytes of VP9, but does not exist in MP4. OpenCV's build has no H.264."""
MIN_RATE_HZ, MAX_RATE_HZ = 1.0, 120.0
STILL_RATE_HZ = 25.0
"""Frame rate of a video of one moment."""
CIRCLE_S = 6.0
CIRCLE_DEG = (10.0, 6.0)
"""Half angles of the circle, to the sides and up and down, about the middle of what the endoscope sees."""
PIECE_BYTES = 1 << 20

Picture = NDArray[np.uint8]


def video_parts(container: str) -> Callable[[ExportTarget], Iterator[bytes]]:
    """The writer of a video in a container of CODECS."""

    def parts(target: ExportTarget) -> Iterator[bytes]:
        pictures, rate_hz = _pictures(target)
        with tempfile.TemporaryDirectory(prefix="intrasplat-") as folder:
            path = Path(folder) / f"video.{container}"
            yield from _encoded(pictures, rate_hz, path, CODECS[container])
            with path.open("rb") as file:
                while piece := file.read(PIECE_BYTES):
                    yield piece

    return parts


def _encoded(pictures: Iterator[Picture], rate_hz: float, path: Path, codec: str) -> Iterator[bytes]:
    """Write pictures [H, W, 3] RGB into a file; yield b"" after each. An odd last row or column is cut off."""
    writer = None
    try:
        for picture in pictures:
            height, width = (length - length % 2 for length in picture.shape[:2])
            if writer is None:
                with silent_stderr():
                    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate_hz, (width, height))
                if not writer.isOpened():
                    problem = f"OpenCV cannot write {path.suffix} here."
                    raise InputError("format", problem, "Install the OpenCV that constraints.txt names.")
            writer.write(cv2.cvtColor(picture[:height, :width], cv2.COLOR_RGB2BGR))
            yield b""
    finally:
        if writer is not None:
            writer.release()


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
        return _circle(target, rate_hz), rate_hz
    return (_shown(target, target.time_of(frame)) for frame in target.frames), rate_hz


def _shown(target: ExportTarget, t: float, pose: NDArray[np.float64] | None = None, shift_px: float = 0.0) -> Picture:
    """A picture from a pose (None: the endoscope's own), shifted right by shift_px; unseen pixels are hatched."""
    camera = target.scene.intrinsics
    camera = dataclasses.replace(camera, cx=camera.cx + shift_px)
    frame = render_frame(target.scene, t, pose, camera, target.device)
    return hatched(frame.rgb, frame.unseen)


def _circle(target: ExportTarget, rate_hz: float) -> Iterator[Picture]:
    """Pictures of a camera that circles while the clip plays, or once at the chosen moment."""
    scene, fixed_t = target.scene, target.options.t
    pivot_mm = MEDIAN_DEPTH_UNITS / scene.units_per_mm
    turn = round(CIRCLE_S * rate_hz)
    times = [target.t] * turn if fixed_t is not None else [target.time_of(frame) for frame in target.frames]
    for index, t in enumerate(times):
        angle = 2 * math.pi * index / turn
        around = OrbitPose(yaw_deg=CIRCLE_DEG[0] * math.sin(angle), pitch_deg=CIRCLE_DEG[1] * math.cos(angle), zoom=1)
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
