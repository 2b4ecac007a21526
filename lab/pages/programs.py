"""The parts of docs/results/index.md that single programs of lab/benchmarks/ and tests/ print."""

from __future__ import annotations

from pathlib import Path

from lab.evaluate.rows import Row, read_rows
from lab.pages.markdown import origin, source, table

_RASTER = """
## Splatting on the CPU

Medians in ms, 640x512 and 40,096 Gaussians where a row names no others. `standard` is a picture of tissue, `step` a
render with its gradient and the optimiser's update.
"""
_SERVICE = """
## The service under load

A whole installation on two cores, idle and while a clip trains; renders are JPEGs of 640x512 at random times and poses,
and a viewer asks again when it is answered. `the job` is a scene that trains; beside `training` the scene is a finished
one.
"""
_UPLOADS = """
Uploads, and the service's resident memory:
"""
_MEMORY = """
## Memory of a reconstruction

Peak resident memory of the process in each stage; `import` is before the clip
([why](../decisions/input.md#memory-is-released-stage-by-stage)).
"""
_LONG = """
## A long clip

A synthetic clip of 1,000 frames, and parts of it trained alone with as many steps a frame; `whole` is the whole clip's
scene on the part's frames, held-out dB
([why](../decisions/motion.md#long-clips-get-more-bases-trained-without-first-moments)).
"""
_CHAOS = """
## What survives what

`make chaos` kills every process at every point of a clip's way; `make attacks` lets one tenant attack while another
looks at its scene.

"""
_SOAK = """
## An hour of everything

GREW marks memory that rose by more than 2 %, and files or threads of which there were at least three more at the end.
The counted errors are refusals that viewers are meant to get.
"""
_RASTER_COLUMNS = (("render", "ms"), ("render", "blend_ms"), ("step", "ms"), ("step", "blend_ms"))
_LONG_COLUMNS = {
    "clip": "clip", "iterations": "iterations", "bases": "bases", "step_ms": "ms a step", "psnr_tissue_db": "alone",
    "whole_psnr_db": "whole", "train_mib": "MiB in training", "finish_mib": "in finishing",
}  # fmt: skip
_SERVICE_FIGURES = {"p50_ms": "p50 ms", "p99_ms": "p99 ms", "per_s": "a second", "slower": "training slower by"}


def raster_sections(folder: Path) -> list[str]:
    """The table of bm_raster.py, and what it printed of a trained scene; nothing without rows."""
    rows = [row for row in read_rows(folder / "raster.csv") if row["ms"]]
    if not rows:
        return []
    by_scene: dict[str, dict[str, Row]] = {}
    for row in rows:
        by_scene.setdefault(row["name"], {})[row["work"]] = row
    cells = [
        [name, *(works[work][column] if work in works else "–" for work, column in _RASTER_COLUMNS)]
        for name, works in by_scene.items()
    ]
    header = ["scene", "render", "of it blending", "step", "of it blending"]
    first = rows[0]
    where = f"\n{first['cpu']}, {first['threads']} threads, commit {first['commit']}, load {first['load_1min']}.\n"
    command = "python -m lab.benchmarks.bm_raster --csv lab/rows/raster.csv"
    return [_RASTER, source(command, "raster.csv", "raster-scene.txt"), table(header, cells), where]


def service_sections(folder: Path) -> list[str]:
    """The tables of bm_service.py; nothing without rows."""
    rows = read_rows(folder / "service.csv")
    if not rows:
        return []
    cells = [
        [row["work"], row["worker"], *(_figure(row, name) for name in _SERVICE_FIGURES)]
        for row in rows
        if row["p50_ms"]
    ]
    command = "python -m lab.benchmarks.bm_service --csv lab/rows/service.csv"
    parts = [_SERVICE, source(command, "service.csv"), table(["", "worker", *_SERVICE_FIGURES.values()], cells)]
    uploads = [[row[name] for name in ("work", "seconds", "before_mib", "peak_mib")] for row in rows if row["peak_mib"]]
    if uploads:
        parts += [_UPLOADS, table(["", "seconds", "before, MiB", "peak, MiB"], uploads)]
    return [*parts, origin(rows)]


def _figure(row: Row, name: str) -> str:
    value = row.get(name) or ""
    return f"{float(value):.0%}" if value and name == "slower" else value or "–"


def memory_sections(folder: Path) -> list[str]:
    """The table of bm_memory.py, a row a clip and a column a stage; nothing without rows."""
    rows = read_rows(folder / "memory.csv")
    if not rows:
        return []
    stages = list(dict.fromkeys(row["stage"] for row in rows))
    runs: dict[tuple[str, ...], dict[str, str]] = {}
    for row in rows:
        key = tuple(row[name] for name in ("clip", "preset", "limit"))
        runs.setdefault(key, {})[row["stage"]] = row["peak_mib"]
    cells = [[", ".join(key), *(peaks.get(stage, "–") for stage in stages)] for key, peaks in runs.items()]
    command = "python -m lab.benchmarks.bm_memory --csv lab/rows/memory.csv"
    header = ["peak, MiB", *stages]
    return [_MEMORY, source(command, "memory.csv"), table(header, cells), origin(rows)]


def long_sections(folder: Path) -> list[str]:
    """The table of bm_long.py; nothing without rows."""
    rows = read_rows(folder / "long.csv")
    if not rows:
        return []
    cells = [[row[name] or "–" for name in _LONG_COLUMNS] for row in rows]
    command = "python -m lab.benchmarks.bm_long --cache FOLDER --csv lab/rows/long.csv"
    return [_LONG, source(command, "long.csv"), table(list(_LONG_COLUMNS.values()), cells), origin(rows)]


def survival_sections(folder: Path) -> list[str]:
    """What `make chaos` and `make attacks` found, in their own sentences, and an hour of bm_soak.py."""
    parts = []
    found = [(name, _findings(folder / name)) for name in ("chaos.md", "attacks.md")]
    if any(lines for _, lines in found):
        parts.append(_CHAOS)
        parts += [f"- [{name}](../../lab/rows/{name}): {' '.join(lines)}\n" for name, lines in found if lines]
    if (folder / "soak.txt").exists():
        command = "python -m lab.benchmarks.bm_soak --csv lab/rows/soak.csv | tee lab/rows/soak.txt"
        parts += [_SOAK, source(command, "soak.csv", "soak.txt"), _grown(folder / "soak.txt")]
    return parts


def _grown(path: Path) -> str:
    """The head of what bm_soak.py printed, and the lines of what grew."""
    lines = path.read_text(encoding="utf-8").strip().splitlines()
    judged = [line for line in lines if line.endswith(("  ok", "  GREW"))]
    grew = [line for line in judged if line.endswith("GREW")]
    head = [line for line in lines if line not in judged]
    count = f"{len(judged) - len(grew)} of {len(judged)} figures are ok; the others:"
    return "\n```\n" + "\n".join([*head, count, *grew]) + "\n```\n"


def _findings(path: Path) -> list[str]:
    """The sentences of a report that sum it up: its counts of broken laws, or how many attacks hold."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    counts = [f"{line.removeprefix('- ')}." for line in lines if line.startswith(("- kills", "- broken laws"))]
    return counts or [line.partition(". ")[0] + "." for line in lines if " hold: " in line]
