"""docs/results/index.md from the CSV files beside it, so that no figure there is typed by hand; README's chart, too.

    python -m benchmarks.pages

Reads docs/results/{runs,curves}.csv, capacity/ and table1/ (of `intrasplat evaluate`), stability.csv (of `intrasplat
stability`), {post,two-eyes,stereo_truth,confidence,raster,service,memory,long,poses,keyframes,masks}.csv,
off-axis.jpg, stereo.txt (the output of bm_stereo.py) and soak.txt (of bm_soak.py); what is missing is left out.
"""

from __future__ import annotations

import csv
from pathlib import Path

from benchmarks.pages.evaluation import sections, write_readme
from benchmarks.pages.gpu import gpu_sections
from benchmarks.pages.markdown import origin, table
from benchmarks.pages.moving import moving_sections
from benchmarks.pages.post import post_sections
from benchmarks.pages.right_eye import two_eyes_sections
from benchmarks.pages.stability import stability_sections
from benchmarks.pages.table1 import table1_sections
from benchmarks.pages.truth import confidence_sections, measure_sections, off_axis_sections, stereo_truth_sections
from worker.evaluate.stability import STABILITY

RESULTS = Path(__file__).resolve().parent.parent.parent / "docs" / "results"
Row = dict[str, str]

_INTRODUCTION = """# Results

Every figure here was printed by a command in this repository and stands in the CSV file named beside it; this page is
written by `python -m benchmarks.pages`. `d4d-a` is a real da Vinci recording (96 frames, 640x512, camera at
rest), `surgt_raw` another of 10 raw frames, neither part of the project; the rest is synthetic. `psnr_tissue` is the
honest score, `psnr_paper` what papers print ([conventions](../conventions.md)). The machines are shared and noisy: rows
of runs have their load. A section holds for the commits it names; later ones may train or splat differently.
"""
_RASTER = """
## Splatting on the CPU

`python benchmarks/bm_raster.py --csv docs/results/raster.csv` ([raster.csv](raster.csv)): 640x512, 40,096 Gaussians on
a grid of 2.86 pixels, medians in ms.
"""
_SCENE = """
The model that `intrasplat reconstruct CLIP --iterations 600 --out s600` ends with on `d4d-a`:
`python benchmarks/bm_raster.py --scene s600 --quick | tee docs/results/raster-scene.txt`
"""
_STEREO = """
## Depth from stereo

`python benchmarks/bm_stereo.py | tee docs/results/stereo.txt`:
"""
_SERVICE = """
## The service under load

`python benchmarks/bm_service.py --csv docs/results/service.csv` ([service.csv](service.csv)): a whole installation,
idle and while a clip trains, in one run; viewers, service, queue and worker share the cores. Renders are JPEGs of
640x512 at random times and poses, and a viewer asks again when it is answered. Beside training, the scene is a finished
one; `the job` is a scene that trains. Fewest a second: what the viewer had who got fewest.
"""
_SERVICE_FIGURES = ("p50_ms", "p99_ms", "max_ms", "per_s", "least_per_s")
_UPLOADS = """
Uploads, the service's resident memory before and at its peak:
"""
_MEMORY = """
## Memory of a reconstruction

`python benchmarks/bm_memory.py --csv docs/results/memory.csv` ([memory.csv](memory.csv)): the peak of the process's
resident memory in each stage, for a clip of both eyes as recorded. `import` is with all libraries loaded, before the
clip; another process decodes ([decision 033](../decisions/033-memory.md)).
"""
_LONG = """
## A long clip

`python -m benchmarks.bm_long --cache FOLDER --csv docs/results/long.csv` ([long.csv](long.csv)): a synthetic clip of
both eyes, and parts of it alone with as many steps a frame. Scores of every8, in dB, left and right eye: of the clip or
part trained alone, and of the whole clip's scene on the part's frames. The peak of the process's resident memory before
training, in training, in finishing and in scoring, in MiB; seconds that storing and scoring take
([decision 042](../decisions/042-long-clips.md)).
"""
_CHAOS = """
## What survives what

[chaos.md](chaos.md), written by `make chaos`: kill -9 of every process at every point of a clip's way, workers stopped
past their lease, and a wire that misbehaves.
"""
_SOAK = """
## An hour of everything

`python benchmarks/bm_soak.py --csv docs/results/soak.csv | tee docs/results/soak.txt` ([soak.csv](soak.csv)). GREW
marks memory that rose by more than 2 % between the eleventh to thirteenth minute and the last three, and files or
threads of which there were at least three more. The service grew by 2.9 %, of which 1 MiB came at once in minute 21;
from minute 40 to the end it grew by 0.3 %. So it settles, but not within ten minutes. An hour with gc.freeze() after
the service's start grew by 3.3 %, and 26 minutes with MALLOC_ARENA_MAX=1 by 1.9 %: neither is used. The device
child held files of a clip whose job had ended; it lets them go since, and had 14 and then 15 files in that other hour
([decision 042](../decisions/042-long-clips.md)). The counted errors
are the refusals that viewers are meant to get, who ask without pause: ServiceUnavailable while a clip has nothing to
show yet, NotFound and Conflict once it is purged or cancelled.
"""


def main() -> None:
    parts = [
        _INTRODUCTION,
        *sections(RESULTS),
        *table1_sections(RESULTS),
        *post_sections(RESULTS),
        *two_eyes_sections(RESULTS),
        *off_axis_sections(RESULTS),
    ]
    parts += [*confidence_sections(RESULTS), *measure_sections(RESULTS), *stability_sections(RESULTS)]
    if rows := _read(STABILITY):
        parts.append(origin(rows))
    if rows := _read("raster.csv"):
        parts += [_RASTER, _raster_table(rows)]
    if (RESULTS / "raster-scene.txt").exists():
        parts += [_SCENE, f"\n```\n{(RESULTS / 'raster-scene.txt').read_text().strip()}\n```\n"]
    parts += gpu_sections(RESULTS)
    parts += moving_sections(RESULTS)
    if (RESULTS / "stereo.txt").exists():
        parts += [_STEREO, f"\n```\n{(RESULTS / 'stereo.txt').read_text().strip()}\n```\n"]
    parts += stereo_truth_sections(RESULTS)
    if rows := _read("service.csv"):
        parts += [_SERVICE, *_service_tables(rows)]
    if rows := _read("memory.csv"):
        parts += [_MEMORY, _memory_table(rows), origin(rows)]
    if rows := _read("long.csv"):
        parts += [_LONG, _long_table(rows), origin(rows)]
    if (RESULTS / "chaos.md").exists():
        parts.append(_CHAOS)
    if (RESULTS / "soak.txt").exists():
        parts += [_SOAK, f"\n```\n{(RESULTS / 'soak.txt').read_text().strip()}\n```\n"]
    (RESULTS / "index.md").write_text("".join(parts))
    write_readme(RESULTS.parent.parent / "README.md", RESULTS)


def _read(name: str) -> list[Row]:
    path = RESULTS / name
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _raster_table(rows: list[Row]) -> str:
    peaks = "; ".join(
        f"{row['work']} {row['gfma_per_s']} G multiply-adds/s, {row['gb_per_s']} GB/s"
        for row in rows
        if row["gfma_per_s"]
    )
    parts = [name for name in rows[0] if name.endswith("_ms") and name != "least_ms"]
    header = ["scene", "work", "Gaussians", "size", "ms", "least", *(name.removesuffix("_ms") for name in parts)]
    cells = [
        [row["name"], row["work"], row["gaussians"], f"{row['width']}x{row['height']}", row["ms"], row["least_ms"],
         *(row[name] or "–" for name in parts)]
        for row in rows if row["ms"]
    ]  # fmt: skip
    first = rows[0]
    machine = f"{first['cpu']}, {first['threads']} threads, commit {first['commit']}, load {first['load_1min']}"
    return table(header, cells) + f"\n{machine}. Peak: {peaks}.\n"


def _service_tables(rows: list[Row]) -> list[str]:
    cells = [
        [row["work"], row["worker"], *(row.get(name) or "–" for name in _SERVICE_FIGURES), _percent(row.get("slower"))]
        for row in rows
        if row["p50_ms"]
    ]
    header = ["", "worker", "p50 ms", "p99 ms", "at most ms", "a second", "fewest a second", "training slower by"]
    tables = [table(header, cells)]
    uploads = [[row[name] for name in ("work", "seconds", "before_mib", "peak_mib")] for row in rows if row["peak_mib"]]
    if uploads:
        tables += [_UPLOADS, table(["", "seconds", "before, MiB", "peak, MiB"], uploads)]
    first = rows[0]
    return [*tables, f"\n{first['machine']}, commit {first['commit']}.\n"]


def _percent(share: str | None) -> str:
    return f"{float(share):.0%}" if share else "–"


def _memory_table(rows: list[Row]) -> str:
    header = ["clip", "preset", "limit", "Gaussians", "bases", "stage", "peak, MiB", "at its end", "decoding process"]
    names = ("clip", "preset", "limit", "gaussians", "bases", "stage", "peak_mib", "end_mib", "decoder_mib")
    return table(header, [[row[name] or "–" for name in names] for row in rows])


def _long_table(rows: list[Row]) -> str:
    header = ["clip", "preset", "iterations", "Gaussians", "bases", "ms a step", "alone", "right eye"]
    header += ["whole", "right eye"]
    header += ["before", "train", "finish", "score", "store, s", "score, s"]
    names = ("clip", "preset", "iterations", "gaussians", "bases", "step_ms", "psnr_tissue_db", "psnr_right_db",
             "whole_psnr_db", "whole_right_db")  # fmt: skip
    before = ("decode_mib", "stereo_mib", "motion_mib", "fusion_mib", "start_mib")
    return table(
        header,
        [
            [
                *(row[name] or "–" for name in names),
                str(max(int(row[name]) for name in before)),
                *(row[name] for name in ("train_mib", "finish_mib", "score_mib")),
                f"{float(row['finish_s']) + float(row['shrink_s']):.1f}",
                row["score_s"],
            ]
            for row in rows
        ],
    )


if __name__ == "__main__":
    main()
