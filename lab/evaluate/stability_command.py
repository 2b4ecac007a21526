"""`python -m lab stability`: spoils synthetic clips, measures the cells that have no row yet, and draws the atlas."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from contract.wire.job import JobProgress
from intrasplat.commands.arguments import count
from intrasplat.commands.exits import ExitCode
from intrasplat.commands.progress_bar import ProgressBar
from intrasplat.errors import InputError
from intrasplat.machine.processes import heeding_signals
from intrasplat.train.hooks import TrainingHooks
from lab.conditions import CONDITIONS, SEVERITIES
from lab.evaluate.atlas import count_outcomes, draw_map, places_of, series_in, told_table
from lab.evaluate.rows import Row, adding_alone
from lab.evaluate.stability import Grid, StabilityBench, StabilityCell, plan, stability_rows
from lab.evaluate.variants import register_variants
from lab.rivals import RIVAL_SYSTEMS

DEFAULT_SERIES = ("fast", "paper", "pfs", "hexplane", "without_mapf")
TABLE = "stability.md"
TABLE_TITLE = """# What the user is told

Decibels lost against the clean clip (over several seeds their mean, and the spread); behind a stroke those that are
lost after one fit of gain and offset by channel to all that is judged, where they differ by half a decibel or more;
millimetres of depth where those are the harm. In bold what is a defect; what was not measured is empty. Where the
tissue or the picture is another (texture, size) that is in the loss, too: below zero it is easier to reproduce than the
clean clip. Each method is compared with itself, so that one that has learnt little loses little.

All clips: {grid}, but for where size or length is what is spoilt.
"""


def add_cli_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `stability`; run_cli reads them."""
    grid = Grid()
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="rows, table and maps; goes on there")
    parser.add_argument(
        "--conditions", nargs="+", default=list(CONDITIONS), metavar="NAME", help=f"of {', '.join(CONDITIONS)} (all)"
    )
    known = f"presets, or systems of table 1 ({', '.join(RIVAL_SYSTEMS)}); default: %(default)s"
    parser.add_argument("--series", nargs="+", default=list(DEFAULT_SERIES), help=known)
    parser.add_argument(
        "--severities", nargs="+", type=int, choices=SEVERITIES, default=list(SEVERITIES), help="(default: all)"
    )
    parser.add_argument("--seeds", type=count, default=1, metavar="N", help="seeds 0 to N - 1 (default: 1)")
    parser.add_argument("--iterations", type=count, default=grid.iterations, metavar="N", help="(default: %(default)s)")
    parser.add_argument("--frames", type=count, default=grid.frames, metavar="N", help="(default: %(default)s)")
    size = f"{grid.width}x{grid.height}"
    parser.add_argument("--size", type=_size, default=size, metavar="WxH", help="pixels (default: %(default)s)")
    parser.add_argument("--redraw", action="store_true", help="measure nothing; draw the rows in DIR")


def run_cli(options: argparse.Namespace) -> int:
    """Measures what is asked for and has no row; returns the exit code.

    Raises:
        InputError: a condition or series is not known, another process adds rows to the folder, or there is nothing
            to draw.
        UnavailableError: this machine lacks something; what was measured until then is kept.
        Cancelled: a signal came; what was measured until then is kept.
    """
    register_variants()
    out: Path = options.out
    if not options.redraw:
        width, height = options.size
        cells = plan(options.conditions, options.severities, options.series, range(options.seeds))
        grid = Grid(width, height, options.frames, options.iterations)
        with adding_alone(out):
            atlas = StabilityBench(out, grid)
            if atlas.rows and (there := Grid.of(atlas.rows)) != grid:
                problem = f"{out} holds rows of {there}, and these would be of {grid}."
                raise InputError("--out", problem, "Name another folder for them.")
            waiting = atlas.missing(cells)
            print(f"{len(cells)} cells, {len(cells) - len(waiting)} of them have their rows already")
            measure_all(atlas, waiting)
    draw_all(stability_rows(out), out)
    return ExitCode.OK


def measure_all(atlas: StabilityBench, cells: Sequence[StabilityCell]) -> None:
    """Measure each cell and keep its row at once. Raises Cancelled after a signal, and as measure."""
    with heeding_signals() as end:
        for place, cell in enumerate(cells):
            with ProgressBar(sys.stderr) as bar:
                bar.show(JobProgress(stage=f"{place + 1}/{len(cells)}", fraction=place / len(cells)))
                row = atlas.measure(cell, TrainingHooks(should_stop=end.is_set))
            print(_line(row), flush=True)


def draw_all(rows: Sequence[Row], folder: Path) -> None:
    """The maps and the table of all methods that have rows. Raises InputError as Grid.of."""
    tables, grid = [], Grid.of(rows)
    for series in series_in(rows):
        places = places_of(rows, series)
        name = draw_map(places, series, folder)
        tables.append(told_table(places, series))
        counted = ", ".join(f"{number} {outcome}" for outcome, number in count_outcomes(places).items())
        print(f"{series}: {counted or 'clean clips only'}; {folder / name}.png")
    (folder / TABLE).write_text("\n".join([TABLE_TITLE.format(grid=grid), *tables]), encoding="utf-8")


def _line(row: Row) -> str:
    name = f"{row['condition']} {row['severity']} ({row['level'] or 'clean'}), {row['series']}, seed {row['seed']}"
    if row["error"]:
        return f"{name}: {row['outcome']}: {row['error']}"
    lost = f"{row['loss_db'] or '?'} lost, {row['fitted_loss_db'] or '?'} after a fit"
    return f"{name}: {row['outcome']}, {row['psnr_db']} dB, {lost}, {row['seconds']} s"


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 160x128")
    return int(width), int(height)
