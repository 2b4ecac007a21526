"""Draws the stereo clips in this folder and encodes them with ffmpeg (libx264, libx265, libvpx-vp9).

    python tests/data/make_stereo_clips.py

OpenCV's wheel can decode H.264 and HEVC but not write them, nor cut and remux, so the tests keep these few kilobytes.
Each clip shows 12 frames of a reddish, blotchy texture that drifts downwards, seen by two eyes of 96x80 pixels,
4 pixels of disparity, at 25 frames a second.
"""

import subprocess
from pathlib import Path

import cv2
import numpy as np

FRAMES, HEIGHT, WIDTH, DISPARITY_PX, RATE_HZ = 12, 80, 96, 4, 25
HERE = Path(__file__).parent
FFMPEG = ["ffmpeg", "-y", "-loglevel", "error"]
H264 = ["-c:v", "libx264", "-crf", "30"]
HEVC = ["-c:v", "libx265", "-crf", "30", "-tag:v", "hvc1", "-x265-params", "info=0:log-level=none"]
VP9 = ["-c:v", "libvpx-vp9", "-crf", "40", "-b:v", "0"]


def eyes(frame: int) -> tuple[np.ndarray, np.ndarray]:
    """(left, right) BGR frames [80, 96, 3] of the drifting texture."""
    noise = np.random.default_rng(7).integers(40, 216, (HEIGHT // 4 + 4, WIDTH // 4 + 4), dtype=np.uint8)
    grey = cv2.resize(noise, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    texture = np.dstack([grey // 2, grey // 2, grey])
    rows = slice(12 - frame, 12 - frame + HEIGHT)
    return texture[rows, :WIDTH], texture[rows, DISPARITY_PX : DISPARITY_PX + WIDTH]


def encode(name: str, stack: str, options: list[str]) -> None:
    """Pipes all frames, packed side by side ("h") or top-bottom ("v"), through ffmpeg."""
    join = np.hstack if stack == "h" else np.vstack
    frames = [join(eyes(frame)) for frame in range(FRAMES)]
    height, width = frames[0].shape[:2]
    source = ["-f", "rawvideo", "-pix_fmt", "bgr24", "-s", f"{width}x{height}", "-r", str(RATE_HZ), "-i", "-"]
    command = [*FFMPEG, *source, *options, "-pix_fmt", "yuv420p", "-bitexact", str(HERE / name)]
    subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), check=True)


def cut(source: str, name: str, start_s: float) -> None:
    """Cuts a clip without encoding it again, as phones do: an edit list hides what the codec still needs."""
    path = [str(HERE / name)]
    subprocess.run(
        [*FFMPEG, "-ss", str(start_s), "-i", str(HERE / source), "-c", "copy", "-bitexact", *path], check=True
    )


if __name__ == "__main__":
    encode("stereo_sbs_h264.mp4", "h", H264)
    encode("stereo_tb_hevc.mov", "v", HEVC)
    cut("stereo_sbs_h264.mp4", "stereo_sbs_trimmed.mp4", start_s=0.2)
    # Matroska stores a duration, no count: with every third frame left out the nominal rate promises too many
    encode("stereo_sbs_varying.mkv", "h", ["-vf", r"select=mod(n\,3)", "-vsync", "vfr", *H264])
    # a live stream says neither how long it is nor how many frames it has
    encode("stereo_sbs_live.webm", "h", [*VP9, "-live", "1"])
