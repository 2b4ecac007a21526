"""The section of docs/results/index.md on what `make gpu-check` measured."""

from __future__ import annotations

from pathlib import Path

from lab.evaluate.rows import Row, read_rows
from lab.pages.markdown import table

_OF_STEPS = ("step, as trained", "peak memory")
_LEFT_OUT = ("kernel: ", "part: ", "instances", "step, ")
ORIGIN = ("machine", "gpu", "driver", "torch", "triton", "commit")

_MEASURED = """
## On a GPU

`make gpu-check` ([gpu.md](../gpu.md)), rows in `lab/rows/gpu-*.csv`.
"""
_TITLES = {
    "speed": "Medians of durations with 40,096 Gaussians at 640x512, by form of motion and frames per step.",
    "train": "Training on synthetic tissue; the last two columns are seconds until `paper`'s final score, and in all.",
}
_COLUMNS = {
    "speed": {"what": "what", "scene": "scene", "frames": "frames", "value": "value", "unit": "unit"},
    "train": {
        "preset": "preset", "frames_a_step": "frames per step", "seed": "seed", "iterations": "iterations",
        "final_db": "dB", "s_to_paper_db": "s to paper", "t_train_s": "t_train_s",
    },
}  # fmt: skip
"""By part and column of its rows: what the table calls it."""


def gpu_sections(folder: Path) -> list[str]:
    """What `make gpu-check` found, of the parts whose CSV files are there."""
    checks = read_rows(folder / "gpu-correct.csv")
    measured = {name: read_rows(folder / f"gpu-{name}.csv") for name in _TITLES}
    parts = [_MEASURED] if checks or any(measured.values()) else []
    if checks:
        parts.append(_checked(checks))
    for name, rows in measured.items():
        if rows:
            shown = _speed(rows) if name == "speed" else [_plain(rows, _COLUMNS[name])]
            parts += [f"\n{_TITLES[name]}\n", *shown]
    return [*parts, *dict.fromkeys(_origin(rows) for rows in (checks, *measured.values()) if rows)]


def _checked(rows: list[Row]) -> str:
    """How many checks of the kernels hold, and the error that comes nearest to its limit."""
    failed = [row["check"] for row in rows if row["ok"] != "True"]
    bounded = [row for row in rows if float(row["limit"] or 0)]
    worst = max(bounded, key=lambda row: float(row["worst"]) / float(row["limit"]), default=None)
    said = f"\n{len(rows) - len(failed)} of {len(rows)} checks of the kernels hold"
    said += f"; failed: {', '.join(failed)}" if failed else ""
    if worst:
        error, limit = _shown(worst["worst"]), _shown(worst["limit"])
        said += f'. The error nearest to its limit is that of "{worst["check"]}": {error}, limit {limit}'
    return f"{said}.\n"


def _plain(rows: list[Row], columns: dict[str, str]) -> str:
    return table(list(columns.values()), [[_shown(row[name]) for name in columns] for row in rows])


def _speed(rows: list[Row]) -> list[str]:
    """A column for each form of motion and number of frames a step; then pictures and compilation."""
    of_steps = [row for row in rows if row["what"].startswith(_OF_STEPS)]
    others = [row for row in rows if row not in of_steps and not row["what"].startswith(_LEFT_OUT)]
    places = sorted({(row["scene"], row["frames"]) for row in of_steps}, key=lambda place: (place[0], int(place[1])))
    found: dict[str, dict[tuple[str, str], str]] = {}
    for row in of_steps:
        found.setdefault(f"{row['what']}, {row['unit']}", {})[row["scene"], row["frames"]] = row["value"]
    header = ["", *(f"{scene}, {frames}" for scene, frames in places)]
    cells = [[name, *(_shown(values.get(place, "")) for place in places)] for name, values in found.items()]
    return [table(header, cells), *([_plain(others, _COLUMNS["speed"])] if others else [])]


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
    unsure = {row["believed"] for row in rows} - {"yes"}
    doubt = f" **Not to be believed: {'; '.join(sorted(unsure))}.**" if unsure else ""
    return f"\nMeasured on {where}.{doubt}\n"
