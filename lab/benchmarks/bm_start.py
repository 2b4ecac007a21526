"""How soon a clip's first frame has depth, and all have, and how soon the first training step can be made.

    python -m lab.benchmarks.bm_start [CLIP --calibration F --masks F] [--preset instant] [--repeats 5] [--cold]

CLIP is d4d_stereo of INTRASPLAT_DATA by default. Prints medians over the repeats, in one process whose libraries are
loaded and whose kernels are compiled, as a worker's are: seconds since the start, seconds of each stage, and seconds of
the processor, with those of the decoding process. --cold starts that process with the clip; a worker has it ready.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from intrasplat.decode import keep_decoder_ready
from intrasplat.machine.hooks import Progress
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import begin
from intrasplat.splat.cpu import compile_kernels
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.keep import keeping
from intrasplat.train.prepare import prepare
from intrasplat.train.request import ReconstructionRequest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("INTRASPLAT_DATA", "../shared/data")) / "d4d_stereo"
    parser.add_argument("clip", type=Path, nargs="?", default=data / "stereo_sbs.mp4")
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--masks", type=Path)
    parser.add_argument("--preset", default="instant")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cold", action="store_true")
    arguments = parser.parse_args()
    if arguments.clip.parent == data:
        arguments.calibration, arguments.masks = data / "calibration.json", data / "tool_masks.zip"
    compile_kernels(lambda _: None)
    runs = [_run(arguments) for _ in range(arguments.repeats)]
    print(f"{arguments.clip.name}, {arguments.preset}, {os.cpu_count()} cores, medians of {len(runs)}")
    for name in runs[0]:
        print(f"{name:24}{statistics.median(run[name] for run in runs):7.2f} s")


def _run(arguments: argparse.Namespace) -> dict[str, float]:
    """Seconds by event and by stage."""
    files = {"calibration": arguments.calibration, "masks": arguments.masks}
    request = ReconstructionRequest(
        arguments.clip, ReconstructionOptions(preset=arguments.preset, iterations=1), device="cpu", **files
    )
    if not arguments.cold:
        keep_decoder_ready()
        time.sleep(2.0)  # as long as it takes to load its libraries on a busy machine
    events: dict[str, float] = {}
    busy_s, start_s = _busy_s(), time.perf_counter()

    def note(event: str) -> None:
        events.setdefault(event, time.perf_counter() - start_s)

    def on_progress(now: Progress) -> None:
        note("first frame decoded" if now.stage == "stereo" else f"{now.stage} begins")

    hooks = TrainingHooks(on_progress=on_progress)
    with TemporaryDirectory() as folder, keeping(Path(folder), forgets=True) as keeper:
        setup = begin(request, Path(folder), hooks, keeper)
        note("clip has depth")
        run = prepare(setup)
        note("ready to train")
    stages = {f"  {name[:-2]}": seconds for name, seconds in run.setup.timings.seconds.items()}
    events["first frame has depth"] = stages.pop("  t_first_view")
    return events | stages | {"processor": _busy_s() - busy_s}


def _busy_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


if __name__ == "__main__":
    main()
