"""What it costs to be able to go on after a kill: the pauses of training, and the bytes and seconds of the disk.

    python -m lab.benchmarks.bm_keep [CLIP --calibration F --masks F] [--preset fast] [--iterations 400] [--period-s 3]

Reconstructs the clip, else a synthetic stereo clip of 640x512, with its state kept every --period-s of training and
with nothing kept, in turn, --rounds times. Prints for each the median seconds of training and of the whole, and for
each state its bytes, how long training stood still for it, and how long the disk took beside training.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.scene.resume_file import RESUME_FILE
from intrasplat.train import keep
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.run import Run
from lab.phantom import PhantomSettings, make_phantom, write_stereo_video

DRAWN = PhantomSettings(width=640, height=512, frames=48)


class Watched:
    """Measures every state that is kept; `begin` takes the place of begin_save."""

    def __init__(self) -> None:
        self.pause_ms: list[float] = []
        self.disk_ms: list[float] = []
        self.mib: list[float] = []
        self._begin = keep.begin_save

    def begin(self, directory: Path, run: Run, t_train_s: float) -> Callable[[], None]:
        started_s = time.perf_counter()
        complete = self._begin(directory, run, t_train_s)
        self.pause_ms.append(1e3 * (time.perf_counter() - started_s))

        def completed() -> None:
            started_s = time.perf_counter()
            complete()
            self.disk_ms.append(1e3 * (time.perf_counter() - started_s))
            self.mib.append((directory / RESUME_FILE).stat().st_size / 2**20)

        return completed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path, nargs="?")
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--masks", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--period-s", type=float, default=3.0)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    keep.PERIOD_S = options.period_s
    watched, spare_bytes = Watched(), keep.SPARE_BYTES
    keep.begin_save = watched.begin
    seconds: dict[str, list[tuple[float, float]]] = {"kept": [], "nothing kept": []}
    with tempfile.TemporaryDirectory(prefix="intrasplat-keep-") as name:
        request = _request(options, Path(name))
        for number in range(options.rounds):
            for kind, runs in seconds.items():
                keep.SPARE_BYTES = spare_bytes if kind == "kept" else 1 << 62
                started_s = time.perf_counter()
                report = reconstruct(request, Path(name) / f"{kind}-{number}", TrainingHooks())
                runs.append((report.seconds["optimise_s"], time.perf_counter() - started_s))
    print(f"{options.preset}, {report.iterations} iterations, {report.gaussians} Gaussians, {report.bases} bases")
    for kind, runs in seconds.items():
        train_s, whole_s = (median(each) for each in zip(*runs, strict=True))
        print(f"{kind:13} training {train_s:.2f} s, the whole {whole_s:.2f} s")
    print("state      MiB  pause ms  disk ms")
    for mib, pause_ms, disk_ms in zip(watched.mib, watched.pause_ms, watched.disk_ms, strict=True):
        print(f"      {mib:8.0f}  {pause_ms:8.0f}  {disk_ms:7.0f}")


def _request(options: argparse.Namespace, folder: Path) -> ReconstructionRequest:
    clip, calibration, masks = options.clip, options.calibration, options.masks
    if clip is None:
        write_stereo_video(make_phantom(DRAWN), folder)
        clip, calibration, masks = folder / "stereo.webm", folder / "calibration.json", folder / "masks.zip"
    asked = ReconstructionOptions(preset=options.preset, iterations=options.iterations)
    return ReconstructionRequest(clip, asked, calibration=calibration, masks=masks)


if __name__ == "__main__":
    main()
