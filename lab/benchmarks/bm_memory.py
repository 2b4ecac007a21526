"""The peak memory of each stage of a reconstruction.

    python -m lab.benchmarks.bm_memory [--motion pull] [--frames 150] [--width 640] [--height 512] [--preset fast]
        [--iterations 60 | --budget-s S] [--cache FOLDER] [--csv lab/rows/memory.csv]

Draws a synthetic clip in StereoMIS layout, raw frames of two eyes, and reconstructs it in this process as the command
line does. Prints the peak of the process's resident memory in each stage, which the kernel keeps, and that of the
process that decodes. "import" is before the clip, with all libraries loaded. FOLDER keeps the clip for the next run.
Linux only.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from intrasplat.machine.hooks import Progress
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from lab.evaluate.rows import adding_alone, commit, machine, read_rows, write_rows
from lab.phantom.settings import MOTIONS

KEY = ("clip", "preset", "limit", "stage")
FIELDS = (*KEY, "peak_mib", "end_mib", "decoder_mib", "gaussians", "bases", "machine", "commit")
"""peak_mib and end_mib are of this process, in the stage and at its end; decoder_mib is the decoding process's peak."""
STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
RESET_PEAK = "5"  # written to /proc, it makes the kernel measure the peak anew


class StageMemory:
    """The peak of this process's resident memory in each stage, in MiB. A stage starts with its first report."""

    def __init__(self) -> None:
        self.peaks_mib: dict[str, float] = {}
        self.ends_mib: dict[str, float] = {}
        self._stage = "import"

    def on_progress(self, now: Progress) -> None:
        """Handle a stage's report."""
        if now.stage != self._stage:
            self.end_stage()
            self._stage = now.stage

    def end_stage(self) -> None:
        """Store the stage's peak, and reset it for the next stage."""
        status = dict(line.split(":\t", 1) for line in STATUS.read_text().splitlines() if ":\t" in line)
        peak_mib, end_mib = (int(status[name].split()[0]) / 1024 for name in ("VmHWM", "VmRSS"))
        self.peaks_mib[self._stage] = max(peak_mib, self.peaks_mib.get(self._stage, 0.0))
        self.ends_mib[self._stage] = end_mib
        RESET.write_text(RESET_PEAK)


def main(arguments: Sequence[str] | None = None) -> None:
    options = _parser().parse_args(arguments)
    limit = f"{options.budget_s:g} s" if options.budget_s else f"{options.iterations} iterations"
    name = f"phantom-{options.motion}-{options.width}x{options.height}-{options.frames}frames-stereo"
    with tempfile.TemporaryDirectory(prefix="intrasplat-memory-") as folder:
        clip = _clip(options, (options.cache or Path(folder)) / name)
        length = {"budget_s": options.budget_s} if options.budget_s else {"iterations": options.iterations}
        request = ReconstructionRequest(clip, ReconstructionOptions(preset=options.preset, **length), device="cpu")
        measured = StageMemory()
        report = reconstruct(request, Path(folder) / "scene", TrainingHooks(on_progress=measured.on_progress))
        measured.end_stage()
    decoder_mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    rows = [
        {
            "clip": name, "preset": options.preset, "limit": limit, "stage": stage, "peak_mib": f"{peak_mib:.0f}",
            "end_mib": f"{measured.ends_mib[stage]:.0f}", "decoder_mib": f"{decoder_mib:.0f}" * (stage == "decode"),
            "gaussians": report.gaussians, "bases": report.bases, "machine": machine(), "commit": commit(),
        }
        for stage, peak_mib in measured.peaks_mib.items()
    ]  # fmt: skip
    print(f"{name}, {options.preset}, {limit}: {report.gaussians} Gaussians, {report.bases} bases")
    for row in rows:
        beside = f", {row['decoder_mib']} in the decoding process" if row["decoder_mib"] else ""
        print(f"{row['stage']:10} {row['peak_mib']:>6} MiB, {row['end_mib']:>6} at its end{beside}")
    if options.csv:
        with adding_alone(options.csv.parent):
            kept = [row for row in read_rows(options.csv) if not _is_of(row, rows)]
            write_rows(options.csv, FIELDS, [*kept, *rows])


def _is_of(row: dict[str, str], rows: Sequence[dict[str, object]]) -> bool:
    """Whether the rows repeat the run of this row."""
    return all(row[name] == rows[0][name] for name in KEY if name != "stage")


def _clip(options: argparse.Namespace, folder: Path) -> Path:
    """The folder with the clip; drawn by another process if it is not there yet."""
    if not folder.exists():
        drawn = ["--motion", options.motion, "--frames", options.frames, "--width", options.width]
        drawn += ["--height", options.height, "--format", "stereomis", "--out", folder]
        subprocess.run([sys.executable, "-m", "lab", "phantom", *map(str, drawn)], check=True)
    return folder


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", choices=MOTIONS, default="pull")
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=512)
    parser.add_argument("--preset", default="fast")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--iterations", type=int, default=60)
    length.add_argument("--budget-s", type=float)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--csv", type=Path)
    return parser


if __name__ == "__main__":
    main()
