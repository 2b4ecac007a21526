"""The section of docs/results/index.md on what `make gpu-check` measured."""

from __future__ import annotations

import csv
from pathlib import Path

from lab.pages.markdown import table

Row = dict[str, str]
_OF_STEPS = ("step", "part: ", "peak memory", "instances")
ORIGIN = ("machine", "gpu", "driver", "torch", "triton", "commit")

_MEASURED = """
## On a GPU

`make gpu-check` ([gpu.md](../gpu.md)): rows are in `gpu-*.csv` beside this page.
"""
_TITLES = {
    "correct": "Whether the kernels are right: worst errors over the largest values (gpu-correct.csv).",
    "speed": "Medians of durations; the standard grid of 40,096 Gaussians at 640x512, by form of motion and frames a "
    "step (gpu-speed.csv, which has single kernels, too).",
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
            shown = _speed(rows) if name == "speed" else [_plain(rows)]
            sections += [f"\n{_TITLES[name]}\n", *shown, _origin(rows)]
    return sections


def _read(path: Path) -> list[Row]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _plain(rows: list[Row]) -> str:
    hidden = (*ORIGIN, "believed", "detail")
    columns = [name for name in rows[0] if name not in hidden and any(row[name] for row in rows)]
    return table(columns, [[_shown(row[name]) for name in columns] for row in rows])


def _speed(rows: list[Row]) -> list[str]:
    """A column for each form of motion and number of frames a step; then the rest. Kernels stay in the file."""
    of_steps = [row for row in rows if row["what"].startswith(_OF_STEPS)]
    others = [row for row in rows if row not in of_steps and not row["what"].startswith("kernel: ")]
    places = sorted({(row["scene"], row["frames"]) for row in of_steps}, key=lambda place: (place[0], int(place[1])))
    found: dict[str, dict[tuple[str, str], str]] = {}
    for row in of_steps:
        found.setdefault(f"{row['what']}, {row['unit']}", {})[row["scene"], row["frames"]] = row["value"]
    header = ["", *(f"{scene}, {frames}" for scene, frames in places)]
    cells = [[name, *(_shown(values.get(place, "")) for place in places)] for name, values in found.items()]
    return [table(header, cells), *([_plain(others)] if others else [])]


def _shown(value: str) -> str:
    """A number with three digits, or in full where it has more before the point; a dash where there is none."""
    try:
        number = float(value)
    except ValueError:
        return value or "–"
    return value if value.isdecimal() else f"{number:.0f}" if abs(number) >= 999.5 else f"{number:#.3g}".rstrip(".")


def _origin(rows: list[Row]) -> str:
    first = rows[0]
    where = ", ".join(first[name] if name in ("machine", "gpu") else f"{name} {first[name]}" for name in ORIGIN)
    doubts = {row["believed"] for row in rows} - {"yes"}
    doubt = f" **Not to be believed: {'; '.join(sorted(doubts))}.**" if doubts else ""
    return f"\nMeasured on {where}.{doubt}\n"
