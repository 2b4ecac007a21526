"""Draws client/dashboard/example: the synthetic clip that an empty page offers.

python -m tests.client.draw_example
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import av

from client.page import DASHBOARD

OUT = DASHBOARD / "example"
PHANTOM = ("--motion", "breathing", "--frames", "40", "--width", "320", "--height", "256", "--seed", "3", "--no-noise")
VP9 = {"crf": "36", "b": "0", "deadline": "good", "cpu-used": "2", "threads": "1"}


def main() -> None:
    """Draw the clip, and encode its video smaller."""
    with tempfile.TemporaryDirectory(prefix="intrasplat-example-") as name:
        clip = Path(name) / "clip"
        subprocess.run([sys.executable, "-m", "lab", "phantom", *PHANTOM, "--out", str(clip)], check=True)
        OUT.mkdir(exist_ok=True)
        for kept in ("calibration.json", "masks.zip"):
            shutil.copyfile(clip / kept, OUT / kept)
        encode(clip / "stereo.webm", OUT / "stereo.webm")


def encode(source: Path, target: Path) -> None:
    """The same frames in fewer bytes."""
    with av.open(str(source)) as read, av.open(str(target), "w") as written:
        video = read.streams.video[0]
        stream = written.add_stream("libvpx-vp9", rate=video.average_rate, options=VP9)
        stream.width, stream.height, stream.pix_fmt = video.width, video.height, "yuv420p"
        for frame in read.decode(video):
            written.mux(stream.encode(frame.reformat(format="yuv420p")))
        written.mux(stream.encode())


if __name__ == "__main__":
    main()
