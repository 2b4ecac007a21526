"""The results page's sections on GPUs: what was estimated without one, and what was measured where one was at hand."""

from __future__ import annotations

import csv
from pathlib import Path

from evaluation_page import table

Row = dict[str, str]
ORIGIN = ("machine", "gpu", "driver", "torch", "triton", "commit")

_ESTIMATE = """
## Steps and pictures on a GPU, estimated

`python benchmarks/gpu_estimate.py --scene s600 --csv docs/results/gpu-estimate.csv`
([gpu-estimate.csv](gpu-estimate.csv)), made on a machine without a GPU: **nothing in this section was measured on
one**. What a frame has the rasteriser do is counted on the CPU: of the standard grid, and of the model that `intrasplat
reconstruct CLIP --iterations 600 --out s600` ends with on `d4d-a`. Bytes and instructions are those of the kernels as
Triton compiles them for an H200 (sm_90), over its data sheet: 4.3 TB/s, 67 TFLOP/s, and 1.5 to 2.5 us a launch within a
graph. The floor issues every instruction without waiting, and takes every byte from memory, though what fits into the
cache may come sooner; the forecast, twice the floor and 2.5 us a launch, is a judgement. Launches of torch's sorts are
counted in its source. A row is of a training step, or of pictures where it says so, and of all its frames together.
"""
_KERNELS = """
Where the floor of `{scene}` lies, kernel by kernel; registers are those of Triton {triton}, `at once` the warps that
fit on a multiprocessor of 64:
"""
_SHAPES = """
Of the tiles compiled, by this forecast: {order}. In use are {usual}. What a program
waits for is in no forecast, so shapes that lie close together are among the first things to measure
([gpu.md](../gpu.md)).
"""
_MEASURED = """
## On a GPU

`make gpu-check` ([gpu.md](../gpu.md)): rows are in `gpu-*.csv` beside this page.
"""
_TITLES = {
    "correct": "Whether the kernels are right: worst errors over the largest values (gpu-correct.csv).",
    "speed": "Durations, medians; the standard grid of 40,096 Gaussians at 640x512 (gpu-speed.csv).",
    "train": "How soon it is how good (gpu-train.csv; curves in gpu-curves.csv).",
    "variants": "Tiles of other shapes (gpu-variants.csv).",
    "rival": "Beside gsplat, rasterisation alone (gpu-rival.csv).",
}


def gpu_sections(results: Path) -> list[str]:
    """Those whose CSV files are there."""
    sections = []
    if rows := _read(results / "gpu-estimate.csv"):
        sections += _estimate(rows)
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


def _estimate(rows: list[Row]) -> list[str]:
    whole = [row for row in rows if row["kernel"] == "all"]
    header = ["scene", "tile", "chunk", "warps", "Gaussians", "instances", "evaluated, M", "blended, M", "MB",
              "launches", "floor, us", "with launches, us", "forecast, us"]  # fmt: skip
    cells = [
        [row["scene"], row["tile"], row["chunk"], row["warps"], row["gaussians"], row["instances"],
         f"{int(row['evaluated']) / 1e6:.1f}", f"{int(row['blended']) / 1e6:.1f}", row["megabytes"], row["launches"],
         row["floor_us"], row["least_us"], row["forecast_us"]]
        for row in whole
    ]  # fmt: skip
    sections = [_ESTIMATE, table(header, cells)]
    usual = whole[0]
    for scene in dict.fromkeys(row["scene"] for row in whole if row["frames"] == "1"):
        sections += [_KERNELS.format(scene=scene, triton=usual["triton"]), _kernels(rows, scene, usual)]
    compared = [row for row in whole if row["scene"] == usual["scene"]]
    if len(compared) > 1:
        ordered = sorted(compared, key=lambda row: float(row["forecast_us"]))[:3]
        order = ", ".join(f"{_shape(row)} {row['forecast_us']} us" for row in ordered)
        sections.append(_SHAPES.format(order=order, usual=_shape(usual)))
    return [*sections, f"\nCompiled by Triton {usual['triton']} on {usual['machine']}, commit {usual['commit']}.\n"]


def _shape(row: Row) -> str:
    """Tile, chunk and warps in words."""
    return f"{row['tile']} in chunks of {row['chunk']} by {row['warps']} warp{'s' * (row['warps'] != '1')}"


def _kernels(rows: list[Row], scene: str, usual: Row) -> str:
    header = ["kernel", "launches", "MB", "floor, us", "by", "registers", "spilled, bytes", "at once"]
    names = ("kernel", "launches", "megabytes", "floor_us", "limit", "registers", "spilled_bytes", "warps_at_once")
    cells = [
        [row[name] or "–" for name in names]
        for row in rows
        if row["scene"] == scene
        and row["kernel"] != "all"
        and (row["tile"], row["chunk"]) == (usual["tile"], usual["chunk"])
    ]
    seen = {cell[0]: cell for cell in reversed(cells)}  # the usual shape is the first of those of its tile
    return table(header, [seen[name] for name in dict.fromkeys(cell[0] for cell in cells)])


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
