"""Measure what both eyes of a stereo clip teach, judged by the left eye, by the right, and by a synthetic clip's truth.

    python -m lab.benchmarks.bm_two_eyes [--clips d4d_stereo ...] [--holdout every8 blocks8] [--eyes left both]
        [--budget-s 15 60 | --iterations N ...] [--seeds 0 1 2] [--csv lab/rows/two-eyes.csv]
        [--at-most N] [--again]

Each run is one of `python -m lab evaluate`, and its row is kept as it ends; the same command goes on where it was
stopped. --at-most ends after so many runs; --again measures anew what has a row. A run that failed has no row, and the
next command repeats it. At the end the medians over seeds of every row in the file are printed. The recording is found
through INTRASPLAT_DATA; without it a synthetic clip is measured.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from intrasplat.names import Eyes
from intrasplat.train.hooks import TrainingHooks
from lab.evaluate.cells import DEFAULT_HOLDOUTS, plan
from lab.evaluate.measure import Bench
from lab.evaluate.rows import KEY, ORIGIN, RUN_FIELDS, TRUTH, adding_alone, key_of, read_rows, texts_of, write_rows
from lab.evaluate.sources import DATA_VARIABLE, source_of
from lab.evaluate.summary import Group, groups_of

FIELDS = (
    *KEY, "psnr_tissue_db", "psnr_right_db", "warp_db", "psnr_clear_db", "psnr_right_clear_db", "warp_clear_db",
    "train_psnr_tissue_db", *TRUTH, "iterations", "gaussians", "step_ms", "t_train_s", "t_post_s", "scene_bytes",
    "load_1min", *ORIGIN,
)  # fmt: skip
"""Names and meaning are those of runs.csv."""
COLUMNS = {
    "psnr_tissue_db": ("left", 2), "psnr_right_db": ("right", 2), "warp_db": ("warp", 2),
    "psnr_clear_db": ("l.clear", 2), "psnr_right_clear_db": ("r.clear", 2), "warp_clear_db": ("w.clear", 2),
    "psnr_view10_db": ("10 deg", 2), "psnr_view15_db": ("15 deg", 2),
    "iterations": ("steps", 0), "step_ms": ("ms/step", 1), "t_train_s": ("train s", 1), "t_post_s": ("post s", 1),
    "scene_bytes": ("bytes", 0),
}  # fmt: skip
"""Heading and digits of the columns of the printed table."""
BUDGETS_S, SEEDS = (15.0, 60.0), (0, 1, 2)


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    sources = {source.name: source for source in map(source_of, options.clips)}
    budgets_s, iterations = ((), options.iterations) if options.iterations else (options.budget_s, ())
    places = list(sources), [options.series], options.holdout, options.seeds
    cells = plan(*places, budgets_s, iterations, options.eyes)
    bench, failed, measured = Bench(sources, options.device), 0, 0
    with adding_alone(options.csv.parent):
        rows = [texts_of(row, FIELDS) for row in read_rows(options.csv)]
        if options.again:
            asked = {cell.key for cell in cells}
            rows = [row for row in rows if key_of(row) not in asked]
        for cell in cells:
            if cell.key in map(key_of, rows) or measured == options.at_most:
                continue
            row, _ = bench.measure(cell, TrainingHooks())
            measured += 1
            if row.get("error"):
                failed += 1
            else:
                rows.append(texts_of(row, RUN_FIELDS))
                write_rows(options.csv, FIELDS, rows)
            scores = " / ".join(texts_of(row, ("psnr_tissue_db", "psnr_right_db")).values())
            print(f"{' '.join(cell.key)}: {row.get('error') or scores}", flush=True)
    print(medians(groups_of(rows)))
    return int(failed > 0)


def medians(groups: Sequence[Group]) -> str:
    """A line a clip, way of holding out, series and limit: medians over seeds; clear is without highlights."""
    lines = [["clip", "held out", "series", "limit", "seeds", *(name for name, _ in COLUMNS.values())]]
    for group in groups:
        known = ((group.median(name), digits) for name, (_, digits) in COLUMNS.items())
        figures = ["-" if math.isnan(value) else f"{value:.{digits}f}" for value, digits in known]
        lines.append([*group.place, group.series, group.limit, str(len(group.rows)), *figures])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(text.rjust(width) for text, width in zip(line, widths, strict=True)) for line in lines)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    recorded = ["d4d_stereo"] if os.environ.get(DATA_VARIABLE) else ["phantom:breathing:stereo"]
    parser.add_argument("--clips", nargs="+", default=recorded)
    parser.add_argument("--series", default="fast")
    parser.add_argument("--holdout", nargs="+", default=list(DEFAULT_HOLDOUTS))
    parser.add_argument("--eyes", nargs="+", choices=get_args(Eyes), default=list(get_args(Eyes)))
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--budget-s", nargs="+", type=float, default=list(BUDGETS_S))
    length.add_argument("--iterations", nargs="+", type=int)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--csv", type=Path, default=Path("lab/rows/two-eyes.csv"))
    parser.add_argument("--at-most", type=int)
    parser.add_argument("--again", action="store_true")
    return parser


if __name__ == "__main__":
    sys.exit(main())
