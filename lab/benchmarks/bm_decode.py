"""What the decoding process costs: seconds and memory, compared with decoding in this process, for the same clips.

Seconds of the processor, parent and child together, are given too: on a machine that does other things they tell more.


    python -m lab.benchmarks.bm_decode [--data FOLDER] [--repeats 5]

FOLDER (INTRASPLAT_DATA, else ../shared/data) holds `d4d_stereo` (a side by side video) and `d4d_endonerf` (PNG).
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from intrasplat.clip import StereoClip, open_clip
from intrasplat.decode import StereoRecording, decode_clip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("INTRASPLAT_DATA", "../shared/data")))
    parser.add_argument("--repeats", type=int, default=5, help="runs a clip, in turn; the fastest of each is printed")
    arguments = parser.parse_args()
    print(f"machine {platform.processor() or platform.machine()}, {os.cpu_count()} cores")
    for clip, calibration in (
        (arguments.data / "d4d_stereo/stereo_sbs.mp4", arguments.data / "d4d_stereo/calibration.json"),
        (arguments.data / "d4d_endonerf", None),
    ):
        if not clip.exists():
            print(f"nothing measured: {clip} is not there")
            continue
        here, contained = partial(_read_here, clip), partial(_read_contained, clip, calibration)
        runs = [(_seconds(here), _seconds(contained)) for _ in range(arguments.repeats)]
        for kind, name in enumerate(("wall", "processor")):
            here_s, contained_s = (min(run[side][kind] for run in runs) for side in (0, 1))
            print(f"{clip.name}: {name} {here_s:.2f} s here, {contained_s:.2f} s contained")
    peak_mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"the largest decoding process held {peak_mib:.0f} MiB")


def _read_here(clip: Path) -> None:
    opened = open_clip(clip)
    if isinstance(opened, StereoClip):
        for _ in opened.pairs():
            pass


def _read_contained(clip: Path, calibration: Path | None) -> None:
    decoded = decode_clip(clip, calibration=calibration)
    if isinstance(decoded, StereoRecording):
        for _ in decoded.clip.pairs():
            pass


def _seconds(work: Callable[[], object]) -> tuple[float, float]:
    """(of the clock, of the processor)."""
    start, busy = time.perf_counter(), _busy_s()
    work()
    return time.perf_counter() - start, _busy_s() - busy


def _busy_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


if __name__ == "__main__":
    main()
