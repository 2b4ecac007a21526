"""`intrasplat evaluate`: measures the cells that have no row yet, then draws and sums up what there is."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args

from contract.runtime.arguments import add_options, given_options
from contract.runtime.exits import ExitCode
from contract.runtime.processes import heeding_signals
from contract.runtime.progress_bar import ProgressBar
from contract.wire.errors import InputError
from contract.wire.job import JobProgress
from contract.wire.names import DeviceName, Eyes
from contract.wire.options import ClipOptions, ReconstructionOptions
from worker.evaluate.cells import BOTH_EYES, DEFAULT_HOLDOUTS, DEFAULT_SERIES, Cell, capacity_grid, plan
from worker.evaluate.charts import draw_all
from worker.evaluate.measure import Bench
from worker.evaluate.rivals import RIVAL_SYSTEMS
from worker.evaluate.rows import Results, adding_alone, write_rows
from worker.evaluate.sources import PHANTOM_SPELLING, source_of
from worker.evaluate.summary import SUMMARY_FIELDS, Sooner, capacities, groups_of, orderings, sooner
from worker.evaluate.variants import register_variants
from worker.machine.hooks import Progress
from worker.raster.backend import choose_device
from worker.train.hooks import TrainingHooks

SUMMARY = "summary.csv"
FILES = ("calibration", "masks")
"""Beside a clip that is a path."""


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `evaluate`; run_cli reads them."""
    parser.add_argument(
        "clips",
        nargs="*",
        metavar="CLIP",
        help=f"a path, {PHANTOM_SPELLING}, or d4d_endonerf[:WxH] or d4d_stereo of INTRASPLAT_DATA",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="rows, summary and charts; goes on there"
    )
    parser.add_argument(
        "--series",
        nargs="+",
        default=list(DEFAULT_SERIES),
        help="presets, also ours or ablation, presets with changes such as fast:bases=9,tracks=false, systems of "
        f"others ({', '.join(RIVAL_SYSTEMS)}), or table1 (default: all presets)",
    )
    parser.add_argument("--holdout", nargs="+", default=list(DEFAULT_HOLDOUTS), help="(default: %(default)s)")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="N", help="(default: 0)")
    add_options(parser, ReconstructionOptions, "budget_s", "iterations", nargs="+", default=[])
    parser.add_argument(
        "--eyes",
        nargs="+",
        choices=get_args(Eyes),
        default=[BOTH_EYES],
        help="of stereo clips, to train on: left makes rows of series such as fast:eyes=left (default: both)",
    )
    parser.add_argument(
        "--grid", action="store_true", help="of each series, the grid of fixed capacities in addition to its own choice"
    )
    parser.add_argument(
        "--device",
        choices=get_args(DeviceName),
        default="auto",
        help="rows of another device belong in a folder of their own (default: auto)",
    )
    parser.add_argument("--again", action="store_true", help="repeat runs that failed (default: keep their error rows)")
    parser.add_argument("--redraw", action="store_true", help="measure nothing; sum up and draw the rows in DIR")
    for name in FILES:
        parser.add_argument(f"--{name}", type=Path, metavar="F", help="of the clips that are paths")
    add_options(parser, ClipOptions)


def run_cli(options: argparse.Namespace) -> int:
    """Measures what is asked for and has no row; returns the exit code: FAILED if every cell asked for has failed.

    Raises:
        InputError: a clip, a series or an option is not known, or another process adds rows to the folder.
        UnavailableError: the device is not there, which is seen before anything is measured, or something else that
            this machine lacks; what was measured until then is kept.
        Cancelled: a signal came; what was measured until then is kept.
    """
    register_variants()
    out: Path = options.out
    if options.redraw == bool(options.clips):
        remedy = "Name one or more clips, or say --redraw alone."
        raise InputError("CLIP", "either clips are measured or rows redrawn.", remedy)
    cells: list[Cell] = []
    if options.clips:
        bench, cells = _asked(options)
        choose_device(options.device)
        with adding_alone(out):
            measure_missing(bench, cells, Results(out), again=options.again)
    results = Results(out)
    if not results.runs:
        raise InputError("--out", f"{out} holds no rows.", "Name clips to measure.")
    conclude(results, out)
    failed = results.failed(cell.key for cell in cells)
    if failed:
        print(f"{len(failed)} of {len(cells)} cells failed, the first because of {failed[0]['error']}")
        print("The same command with --again repeats them.")
    return ExitCode.FAILED if failed and len(failed) == len(cells) else ExitCode.OK


def measure_missing(bench: Bench, cells: Sequence[Cell], results: Results, *, again: bool = False) -> None:
    """Measure the cells that have no row, or whose row says that they failed if `again`. Raises as measure_all."""
    if again:
        results.forget_failed()
    waiting = [cell for cell in cells if not results.has(cell.key)]
    print(f"{len(cells)} cells, {len(cells) - len(waiting)} of them have their rows already")
    measure_all(bench, waiting, results)


def measure_all(bench: Bench, cells: Sequence[Cell], results: Results) -> None:
    """Measure each cell and keep its row at once. Raises Cancelled after SIGINT or SIGTERM, and as Bench.measure."""
    with heeding_signals() as end:
        for place, cell in enumerate(cells):
            with ProgressBar(sys.stderr) as bar:
                show = _reporter(bar, place, len(cells))
                row, curve = bench.measure(cell, TrainingHooks(on_progress=show, should_stop=end.is_set))
            results.add(row, curve)
            print(f"{' '.join(cell.key)}: {_outcome(row)}", flush=True)


def conclude(results: Results, out: Path) -> None:
    """summary.csv and the charts, and the claims in words."""
    groups = groups_of(results.runs)
    write_rows(out / SUMMARY, SUMMARY_FIELDS, [group.summary() for group in groups])
    charts = draw_all(results, out)
    for found in sooner(results.curves):
        print(in_words(found))
    for ordering in orderings(groups):
        print(
            f"{', '.join(ordering.place)}: the paper's ablation, {' > '.join(ordering.scores_db)}: {ordering.verdict}"
        )
    for choice in capacities(groups):
        chosen, best = choice.chosen, choice.best
        print(
            f"{', '.join(chosen.place)}: what {chosen.series} chooses lies {choice.difference_db:+.2f} dB (deviation "
            f"{choice.deviation_db:.2f}, {choice.seeds} seeds) from the best of the grid, {best.series}, with "
            f"{chosen.median('scene_bytes') / 1e6:.2f} MB beside {best.median('scene_bytes') / 1e6:.2f} MB"
        )
    print(f"{out / SUMMARY}; charts: {', '.join(charts) or 'none'}")


def in_words(found: Sooner) -> str:
    """The headline of one place."""
    theirs = f"paper's final {found.target_db:.2f} dB ({found.their_s:.0f} s)"
    where = f"{found.clip}, {found.holdout}: fast ({found.our_limit})"
    if found.our_s is None:
        return f"{where} does not reach {theirs}"
    return (
        f"{where} first reaches {theirs} after {found.our_s:.1f} s, {found.times_in_seconds:.1f} times sooner, and in "
        f"{found.times_in_iterations:.1f} times fewer iterations; paper itself first after "
        f"{found.their_first_s:.1f} s"
    )


def _asked(options: argparse.Namespace) -> tuple[Bench, list[Cell]]:
    """Where the clips come from, and every cell of the grid."""
    files = {name: getattr(options, name) for name in FILES if getattr(options, name) is not None}
    reading = given_options(options, ClipOptions)
    sources = [source_of(argument, files, reading) for argument in options.clips]
    series = options.series
    if options.grid:
        series = [variant for name in series for variant in capacity_grid(name)]
    clips = [source.name for source in sources]
    for twice in {name for name in clips if clips.count(name) > 1}:
        raise InputError("CLIP", f"rows would call two clips {twice!r}.", "Give the files names of their own.")
    limits = options.budget_s, options.iterations
    cells = plan(clips, series, options.holdout, options.seeds, *limits, options.eyes)
    return Bench({source.name: source for source in sources}, options.device), cells


def _reporter(bar: ProgressBar, place: int, total: int) -> Callable[[Progress], None]:
    """Shows how much of all cells is done; of a cell, training counts."""
    trained = 0.0

    def show(now: Progress) -> None:
        nonlocal trained
        trained = max(trained, now.fraction if now.stage == "train" else 0.0)
        share = min(1.0, (place + trained) / total)
        bar.show(JobProgress(stage=f"{place + 1}/{total}", fraction=share, psnr_db=now.psnr_db))

    return show


def _outcome(row: dict[str, object]) -> str:
    if row.get("error"):
        return str(row["error"])
    score = row["psnr_tissue_db"]
    shown = "no frames held out" if score is None else f"{score:.2f} dB"
    if row["psnr_right_db"] is not None:
        shown += f", right eye {row['psnr_right_db']:.2f} dB"
    return (
        f"{shown}, {row['t_train_s']:.1f} s, {row['iterations']} iterations, {row['gaussians'] or 'no'} Gaussians, "
        f"{int(str(row['scene_bytes'])) / 1e6:.1f} MB"
    )
