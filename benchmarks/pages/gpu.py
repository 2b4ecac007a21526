"""The section of docs/results/index.md on what `make gpu-check` measured."""

from __future__ import annotations

import csv
from pathlib import Path

from benchmarks.pages.markdown import table

Row = dict[str, str]
ORIGIN = ("machine", "gpu", "driver", "torch", "triton", "commit")

_MEASURED = """
## On a GPU

`make gpu-check` ([gpu.md](../gpu.md)): rows are in `gpu-*.csv` beside this page.
"""
_TITLES = {
    "correct": "Whether the kernels are right: worst errors over the largest values (gpu-correct.csv).",
    "speed": "Durations, medians; the standard grid of 40,096 Gaussians at 640x512 (gpu-speed.csv).",
    "train": "How soon it is how good (gpu-train.csv; curves in gpu-curves.csv).",
}


def gpu_sections(results: Path) -> list[str]:
    """Those whose CSV files are there."""
    sections = []
    measured = {name: _read(results / f"gpu-{name}.csv") for name in _TITLES}
    if any(measured.values()):
        sections.append(_MEASURED)
    for name, rows in measured.items():
        if rows:
            sections += [f"\n{_TITLES[name]}\n\n", _plain(rows), _origin(rows)]
    return sections


def _read(path: Path) -> list[Row]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _plain(rows: list[Row]) -> str:
    hidden = (*ORIGIN, "believed", "detail")
    columns = [name for name in rows[0] if name not in hidden and any(row[name] for row in rows)]
    return table(columns, [[row[name] or "–" for name in columns] for row in rows])


def _origin(rows: list[Row]) -> str:
    first = rows[0]
    where = ", ".join(first[name] if name in ("machine", "gpu") else f"{name} {first[name]}" for name in ORIGIN)
    doubts = {row["believed"] for row in rows} - {"yes"}
    doubt = f" **Not to be believed: {'; '.join(sorted(doubts))}.**" if doubts else ""
    return f"\nMeasured on {where}.{doubt}\n"
