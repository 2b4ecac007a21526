"""Whole reconstructions on real and synthetic clips: held-out quality, seconds, Gaussians, bytes and peak memory.

    python benchmarks/bm_train.py [--data FOLDER] [--only NAME ...] [--csv docs/results/train.csv]

Each run is a process of its own (`python -m worker reconstruct`), so memory is that run's and nothing is shared. A row
is appended to the CSV as soon as its run ends. FOLDER (INTRASPLAT_DATA, else ../shared/data) holds the real clips; runs
whose clip is not there are left out, and said so. Rows name the real recording `d4d-a`.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from worker.evaluate.rows import commit, machine

FIELDS = (
    "run", "clip", "preset", "holdout", "limit", "psnr_tissue_db", "psnr_paper_db", "ssim", "train_psnr_tissue_db",
    "copy_blend_db", "copy_flow_db", "depth_agreement_mm", "coverage", "iterations", "gaussians", "bases",
    "scene_bytes", "t_train_s", "t_post_s", "peak_rss_mib", "load_1min", "machine", "commit",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One run: a name, the clip under the data folder or phantom options, and the command line's options."""

    name: str
    clip: str
    options: tuple[str, ...]
    files: tuple[tuple[str, str], ...] = field(default=())  # option, path under the data folder
    phantom: tuple[str, ...] = ()


_STEREO = (("--calibration", "d4d_stereo/calibration.json"), ("--masks", "d4d_stereo/tool_masks.zip"))
_YAML = (("--calibration", "surgt_raw/calibration.yaml"),)
_D4D, _VIDEO = "d4d_endonerf", "d4d_stereo/stereo_sbs.mp4"
_LONG = ("--frames", "150", "--width", "640", "--height", "512", "--motion", "breathing")
CASES = (
    Case("every8-60s", _D4D, ("--budget-s", "60")),
    Case("every8-15s", _D4D, ("--budget-s", "15")),
    Case("blocks8-60s", _D4D, ("--budget-s", "60", "--holdout", "blocks8")),
    Case("stereo-every8-60s", _VIDEO, ("--budget-s", "60"), _STEREO),
    Case("raw-stereo-20s", "surgt_raw/video.mp4", ("--budget-s", "20"), _YAML),
    Case("paper-3000", _D4D, ("--preset", "paper")),
    Case("phantom-150-frames", "", ("--budget-s", "30"), phantom=_LONG),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("INTRASPLAT_DATA", "../shared/data")))
    parser.add_argument("--only", nargs="*", choices=[case.name for case in CASES], help="these runs alone")
    parser.add_argument("--csv", type=Path, help="append the rows here")
    parser.add_argument("--repeats", type=int, default=1, help="times each run is made")
    arguments = parser.parse_args()
    for _ in range(arguments.repeats):
        for case in CASES:
            if arguments.only and case.name not in arguments.only:
                continue
            if case.clip and not (arguments.data / case.clip).exists():
                print(f"{case.name}: left out, {arguments.data / case.clip} is not there")
                continue
            row = measure(case, arguments.data)
            print("  ".join(f"{name} {row[name]}" for name in FIELDS[:-2] if row[name] != ""), flush=True)
            if arguments.csv:
                append(arguments.csv, row)


def measure(case: Case, data: Path) -> dict[str, object]:
    """Run the case in a process of its own; its row."""
    with tempfile.TemporaryDirectory() as folder:
        if case.phantom:
            command = [sys.executable, "-m", "worker", "phantom", *case.phantom, "--format", "endonerf"]
            subprocess.run([*command, "--out", f"{folder}/clip"], check=True, stdout=subprocess.DEVNULL)
        clip = f"{folder}/clip" if case.phantom else str(data / case.clip)
        files = [part for option, path in case.files for part in (option, str(data / path))]
        out = Path(folder, "scene")
        command = [sys.executable, "-m", "worker", "reconstruct", clip, *files, *case.options, "--out", str(out)]
        load = os.getloadavg()[0]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        if status != 0:
            raise SystemExit(f"{case.name} ended with status {os.waitstatus_to_exitcode(status)}: {' '.join(command)}")
        report = json.loads((out / "report.json").read_text())
    return _row(case, report, usage, load)


def _row(case: Case, report: dict[str, object], usage: resource.struct_rusage, load: float) -> dict[str, object]:
    options = dict(zip(case.options[::2], case.options[1::2], strict=True))
    seconds = report["seconds"]
    assert isinstance(seconds, dict)
    limit = f"{options['--budget-s']} s" if "--budget-s" in options else f"{report['iterations']} iterations"
    row: dict[str, object] = {
        "run": case.name,
        "clip": ("d4d-a" if case.clip.startswith("d4d") else case.clip.split("/")[0]) or "phantom",
        "holdout": options.get("--holdout", "every8"),
        "limit": limit,
        "copy_blend_db": report["baseline_blend_db"],
        "copy_flow_db": report["baseline_flow_db"],
        "t_train_s": seconds["t_train_s"],
        "t_post_s": seconds["t_post_s"],
        "peak_rss_mib": round(usage.ru_maxrss / 1024),
        "load_1min": load,
        "machine": machine(),
        "commit": commit(),
    }
    row |= {name: report[name] for name in FIELDS if name in report}
    return {name: round(value, 3) if isinstance(value, float) else value for name, value in row.items()}


def append(path: Path, row: dict[str, object], fields: tuple[str, ...] = FIELDS) -> None:
    """Add the row to the CSV, with a header if the file is new; a file of other columns is refused."""
    fresh = not path.exists()
    if not fresh and path.read_text().splitlines()[:1] != [",".join(fields)]:
        raise SystemExit(f"{path} has other columns than {', '.join(fields)}: move it away first.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, fields)
        if fresh:
            writer.writeheader()
        writer.writerow(row)


if __name__ == "__main__":
    main()
