"""How long a caller waits after POST /reconstruct for the first view, the finished scene and its scores.

    python -m lab.benchmarks.bm_post [--clip d4d_stereo] [--poses auto] [--presets instant fast] [--budget-s S]
        [--repeats 5] [--shell] [--drawn FOLDER] [--csv lab/rows/post.csv]

Starts `intrasplat up` on a data directory of its own, trains once untimed, so that the worker is warm, and then sends
the clip again and again. Seconds from the POST, medians: first_view_s, the first answer to GET /render; good_view_s, a
snapshot whose held-out score of the left eye is GOOD_DB or more, as the job's progress tells; done_s, the job is done;
scored_s, its report has scores. eta_off is how far the job's eta_s was off at most, as a share of done_s, after the
first tenth of it. psnr_db and device are the report's, stages the report's seconds. --shell measures `intrasplat
reconstruct` from the shell, too: done_s is the whole command.

--clip is a name of lab/evaluate/sources.py: a recording, which is found through INTRASPLAT_DATA, or a phantom such as
phantom:breathing+pan:640x512:60frames:nomasks, which is drawn as a video of both eyes. --drawn keeps drawn clips for
the next run.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from intrasplat_client import Client, Conflict, JobState, ServiceUnavailable
from lab.demo import started_service
from lab.evaluate.rows import adding_alone, commit, machine, read_rows, write_rows
from lab.evaluate.sources import DATA_VARIABLE, source_of
from lab.phantom import make_phantom
from lab.phantom.writers import write_stereo_video

PHANTOM = "phantom:breathing:640x512:89frames:nomasks"
GOOD_DB = 33.0
LOOK_PERIOD_S = 0.05
CLOCKS = ("first_view_s", "good_view_s", "done_s", "scored_s")
EARLY = 0.1
"""Share of a job at its start in which its duration cannot be estimated."""
FIELDS = ("clip", "poses", "preset", "budget_s", "way", "repeat", *CLOCKS, "eta_off", "psnr_db", "psnr_right_db",
          "stages", "load_1min", "device", "machine", "commit")  # fmt: skip

Row = dict[str, Any]


def main() -> None:
    options = _parser().parse_args()
    with tempfile.TemporaryDirectory(prefix="intrasplat-post-") as name:
        folder = Path(name)
        clip, files = _clip_of(options.clip, options.drawn or folder)
        rows: list[Row] = []

        def keep(row: Row) -> None:
            rows.append(row | {"clip": options.clip, "poses": options.poses, "machine": machine(), "commit": commit()})
            print(_line(rows[-1]), flush=True)
            if options.csv:
                with adding_alone(options.csv.parent):
                    write_rows(options.csv, FIELDS, [*read_rows(options.csv), rows[-1]])

        with started_service(folder / "data", folder / "service.log") as client:
            warm = client.wait(client.reconstruct(clip, **files, iterations=3).id)
            client.report(warm.id)  # waits until scoring has ended
            for repeat in range(options.repeats):
                for preset in options.presets:
                    keep(_sent(client, clip, files, preset, options) | {"repeat": repeat})
        for repeat in range(options.repeats if options.shell else 0):
            for preset in options.presets:
                out = folder / f"{preset}-{repeat}"
                keep(_run(clip, files, preset, options, out) | {"repeat": repeat})
    for preset, way in dict.fromkeys((row["preset"], row["way"]) for row in rows):
        print(_line(_medians([row for row in rows if (row["preset"], row["way"]) == (preset, way)])))


def _clip_of(name: str, folder: Path) -> tuple[Path, dict[str, Any]]:
    """A clip of both eyes, its calibration, and its masks if it has any. A phantom is drawn into the folder, once."""
    source = source_of(name)
    if source.phantom is None:
        return source.clip, dict(source.files)
    drawn = folder / source.name
    if not drawn.exists():
        write_stereo_video(make_phantom(source.phantom), drawn, masks=source.masks)
    files = {"calibration": drawn / "calibration.json", "masks": drawn / "masks.zip"}
    return drawn / "stereo.webm", {key: path for key, path in files.items() if path.exists()}


def _sent(client: Client, clip: Path, files: Mapping[str, Any], preset: str, options: argparse.Namespace) -> Row:
    """Send the clip over HTTP to the warm worker."""
    budget_s: float | None = options.budget_s
    row: Row = {"preset": preset, "budget_s": budget_s or "", "way": "http", "load_1min": round(os.getloadavg()[0], 2)}
    chosen: dict[str, Any] = {"preset": preset, "poses": options.poses, **({"budget_s": budget_s} if budget_s else {})}
    start_s = time.perf_counter()
    job = client.reconstruct(clip, **files, **chosen)
    viewer = threading.Thread(target=_look, args=(client.url, job.id, start_s, row))
    viewer.start()
    told: list[tuple[float, float]] = []
    for now in client.watch(job.id):
        if now.state is JobState.RUNNING and now.eta_s is not None:
            told.append((time.perf_counter() - start_s, now.eta_s))
        if "good_view_s" not in row and (now.psnr_db or 0.0) >= GOOD_DB:
            row["good_view_s"] = round(time.perf_counter() - start_s, 2)
        if now.state is JobState.DONE:
            done_s = time.perf_counter() - start_s
            late = [abs(at_s + eta_s - done_s) / done_s for at_s, eta_s in told if at_s > EARLY * done_s]
            row |= {"done_s": round(done_s, 2), "eta_off": round(max(late, default=math.nan), 3)}
    viewer.join()
    client.wait(job.id)
    report = client.report(job.id)
    row |= {"scored_s": round(time.perf_counter() - start_s, 2), "psnr_db": report.psnr_tissue_db}
    client.delete(job.id)
    return row | {
        "psnr_right_db": report.psnr_right_db, "device": report.device, "stages": json.dumps(report.seconds),
    }  # fmt: skip


def _look(url: str, job_id: str, start_s: float, row: Row) -> None:
    """Request a view until there is one."""
    with Client(url, patience_s=0.0) as viewer:
        while "first_view_s" not in row:
            try:
                viewer.render(0.0, scene=job_id, pose="orbit:8,0,1", format="jpeg")
            except (Conflict, ServiceUnavailable):  # the job waits, or has no snapshot yet
                time.sleep(LOOK_PERIOD_S)
            else:
                row["first_view_s"] = round(time.perf_counter() - start_s, 2)


def _run(clip: Path, files: Mapping[str, Any], preset: str, options: argparse.Namespace, out: Path) -> Row:
    """Reconstruct the clip by the command line."""
    budget_s: float | None = options.budget_s
    given = [part for name, path in files.items() for part in (f"--{name}", str(path))]
    given += ["--preset", preset, "--poses", options.poses, *(["--budget-s", str(budget_s)] if budget_s else [])]
    command = [sys.executable, "-m", "intrasplat", "reconstruct", str(clip), *given, "--out", str(out)]
    start_s, load = time.perf_counter(), os.getloadavg()[0]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    done_s = round(time.perf_counter() - start_s, 2)
    report = json.loads((out / "report.json").read_bytes())
    return {"preset": preset, "budget_s": budget_s or "", "way": "shell", "load_1min": round(load, 2), "done_s": done_s,
            "psnr_db": report["psnr_tissue_db"], "psnr_right_db": report["psnr_right_db"], "device": report["device"],
            "stages": json.dumps(report["seconds"])}  # fmt: skip


def _medians(rows: list[Row]) -> Row:
    numbers = {}
    for name in (*CLOCKS, "eta_off", "psnr_db", "psnr_right_db"):
        known = [row[name] for row in rows if row.get(name) is not None]
        numbers[name] = median(known) if known else math.nan
    return {**rows[0], **numbers, "repeat": f"median of {len(rows)}", "stages": "{}"}


def _line(row: Row) -> str:
    clocks = ", ".join(f"{name} {row[name]:.1f}" for name in CLOCKS if row.get(name) is not None)
    stages = ", ".join(f"{name.removesuffix('_s')} {value:.1f}" for name, value in json.loads(row["stages"]).items())
    scores = f"eta off {row.get('eta_off', math.nan):.2f}; {row['psnr_db']:.1f} dB"
    return f"{row['way']} {row['preset']} {row['repeat']}: {clocks}; {scores}; {stages}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clip", default="d4d_stereo" if os.environ.get(DATA_VARIABLE) else PHANTOM)
    parser.add_argument("--poses", choices=("auto", "fixed", "estimate"), default="auto")
    parser.add_argument("--presets", nargs="+", default=["instant"])
    parser.add_argument("--budget-s", type=float)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--shell", action="store_true")
    parser.add_argument("--drawn", type=Path, metavar="FOLDER")
    parser.add_argument("--csv", type=Path)
    return parser


if __name__ == "__main__":
    main()
