"""Measure what each departure of `fast` from `paper` is worth: train `fast` without one of them at a time.

    python -m lab.benchmarks.bm_departures [--clips CLIP ...] [--iterations 800] [--seeds 1] [--only NAME ...]

A row per run goes to lab/rows/departures.csv as soon as it is measured; runs that have a row are not repeated, so
an interrupted command goes on, and a file that is moved away is measured anew. Then the table and the picture of
docs/method.md and the lines "Gain" of intrasplat/methods/fast.py are written from the rows; --redraw does only that.

The number of iterations is fixed, so decibels do not depend on how busy the machine is. Seconds are processor seconds
of preparing and training, all cores together, without scoring. `fast` itself is trained BASELINE_RUNS times, spread
over the others; differences no greater than between its own runs are written as 0. Early stopping alone is measured in
runs of STOPPING_ITERATIONS planned iterations. What concerns two eyes is measured on clips of two eyes, everything
else on clips of one. A missing clip is skipped.
"""

from __future__ import annotations

import argparse
import csv
import os
import re
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch

from intrasplat.clip import DepthClip, split_frames
from intrasplat.errors import InputError
from intrasplat.fusion import FusionSettings
from intrasplat.machine.hooks import Hooks
from intrasplat.methods.fast import DEPARTURES, FAST
from intrasplat.methods.method import DensifySettings, Departure, Preset, departing
from intrasplat.methods.paper import PAPER
from intrasplat.options import ReconstructionOptions
from intrasplat.splat.cpu import compile_kernels
from intrasplat.splat.optimize import Rate
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.loop import train
from intrasplat.train.prepare import prepare
from intrasplat.train.schedule import Schedule
from intrasplat.train.scoring import HeldOutScore, held_out_score
from intrasplat.train.setup import Setup
from lab.evaluate.rows import commit, machine
from lab.evaluate.sources import open_source, source_of
from lab.evaluate.style import FAINT, GREY, PNG_DPI, SETTINGS
from lab.pages.markdown import number, origin, table

REPOSITORY = Path(__file__).resolve().parents[2]
CSV = REPOSITORY / "lab" / "rows" / "departures.csv"
PAGE = REPOSITORY / "docs" / "method.md"
PICTURE = REPOSITORY / "docs" / "images" / "departures.png"
METHOD = REPOSITORY / "intrasplat" / "methods" / "fast.py"
BEGIN, END = "<!-- departures: written by lab/benchmarks/bm_departures.py -->", "<!-- end of departures -->"
HOLDOUT = "every8"
STOPPING, STOPPED = "early stopping", "fast, stopping early"
STOPPING_ITERATIONS = 4000
"""Four cycles on a clip of 96 frames: three scores of validation frames, and a cycle that may be spared."""
OF_TWO_EYES = ("both eyes", "gloss")
"""Departures that change nothing on a clip of one eye, and the only ones that are measured on a clip of two."""
UNMEASURED = ("budget in seconds",)
"""It says when training ends and changes no step."""
BASELINE_RUNS = 3
"""Runs of `fast` per clip and seed, equal in decibels: their seconds show which differences mean something."""
KEY = ("run", "clip", "iterations", "seed")
FIELDS = (
    *KEY, "psnr_tissue_db", "psnr_right_db", "cpu_s", "seconds", "gaussians", "bases", "load_1min", "machine", "commit",
)  # fmt: skip

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#56B4E9", "#CC79A7", "#D55E00")
BAR = 0.36  # the height of a bar; bars come in pairs

Row = Mapping[str, str]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", default=["phantom:pull", "d4d_endonerf", "d4d_stereo"])
    parser.add_argument("--iterations", type=int, default=800)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", nargs="*", choices=[each.name for each in DEPARTURES], help="these departures alone")
    parser.add_argument("--csv", type=Path, default=CSV, help="other files change neither the page nor fast.py")
    parser.add_argument("--redraw", action="store_true", help="measure nothing; write the page from the rows")
    options = parser.parse_args()
    os.environ.setdefault("INTRASPLAT_DATA", str(REPOSITORY.parent / "shared" / "data"))
    torch.set_num_threads(1)  # as in a reconstruction: the kernels have threads of their own
    names = options.only or [each.name for each in DEPARTURES]
    for argument in [] if options.redraw else options.clips:
        try:
            source = source_of(argument)
        except InputError as error:
            print(f"{argument} is left out: {error}")
            continue
        clip = open_source(source, HOLDOUT, Hooks()).clip
        compile_kernels()
        known = Counter(tuple(row[name] for name in KEY) for row in read(options.csv))
        of_clip = [name for name in names if (name in OF_TWO_EYES) == (clip.right is not None)]
        for run in planned(of_clip, options.iterations, options.seeds):
            if known[key_of(run, source.name)] > 0:
                known[key_of(run, source.name)] -= 1
                continue
            row = dict(zip(KEY, key_of(run, source.name), strict=True)) | measure(run, clip)
            append(options.csv, row)
            print("  ".join(f"{name} {row[name]}" for name in FIELDS[:-2]), flush=True)
    if options.csv == CSV:
        write_all(read(CSV))


@dataclass(frozen=True)
class PlannedRun:
    """One training: its name in rows, the preset, its length, and whether it may stop early."""

    name: str
    preset: Preset
    iterations: int
    seed: int
    stops_early: bool = False


def fast_without(name: str) -> Preset:
    """`fast` without the departure of this name and without those that need it. Raises KeyError if there is none."""
    return departing(PAPER, leaving_out(DEPARTURES, name), f"fast without {name}")


def leaving_out(departures: Iterable[Departure], name: str) -> tuple[Departure, ...]:
    """The departures without the one of this name and without those that need it, in their order.

    Raises:
        KeyError: none has this name.
    """
    listed = tuple(departures)
    gone = {each.name for each in listed if each.name == name}
    if not gone:
        raise KeyError(name)
    while more := {each.name for each in listed if gone & {*each.needs}} - gone:
        gone |= more
    return tuple(each for each in listed if each.name not in gone)


def planned(names: Iterable[str], iterations: int, seeds: int) -> list[PlannedRun]:
    """The runs from which the gains of these departures are computed."""
    runs = []
    for seed in range(seeds):
        baseline = PlannedRun("fast", FAST, iterations, seed)
        without = [name for name in names if name not in (STOPPING, *UNMEASURED)]
        others = [PlannedRun(name, fast_without(name), iterations, seed) for name in without]
        others.insert(0, PlannedRun("paper", PAPER, iterations, seed))
        for part in range(BASELINE_RUNS):
            runs += [baseline, *others[part::BASELINE_RUNS]]
        if STOPPING in names:  # last, because it takes longest
            runs.append(PlannedRun(STOPPED, FAST, STOPPING_ITERATIONS, seed, stops_early=True))
            runs.append(PlannedRun(STOPPING, fast_without(STOPPING), STOPPING_ITERATIONS, seed))
    return runs


def key_of(run: PlannedRun, clip_name: str) -> tuple[str, ...]:
    """The values of KEY of the run's row."""
    return run.name, clip_name, str(run.iterations), str(run.seed)


def measure(run: PlannedRun, clip: DepthClip) -> dict[str, object]:
    """Train and score; the values of the row."""
    load, started_s, scoring_s = os.getloadavg()[0], time.process_time(), 0.0
    options = ReconstructionOptions(iterations=run.iterations, seed=run.seed)
    training = prepare(Setup(clip, split_frames(clip, HOLDOUT), run.preset, options))
    if run.stops_early:
        training.schedule = Schedule(
            run.iterations, run.preset.warm_restarts, run.preset.min_gain_db, training.steps_an_epoch
        )

    def score() -> HeldOutScore:
        nonlocal scoring_s
        before_s = time.process_time()
        found = held_out_score(training)
        scoring_s += time.process_time() - before_s
        return found

    train(training, training.setup.clock, score, TrainingHooks())
    cpu_s, seconds = time.process_time() - started_s - scoring_s, training.setup.clock.elapsed_s
    reached = training.curve[-1]
    right_db = "" if reached.psnr_right_db is None else round(reached.psnr_right_db, 3)
    return {
        "psnr_tissue_db": round(reached.psnr_tissue_db, 3),
        "psnr_right_db": right_db,
        "cpu_s": round(cpu_s, 1),
        "seconds": round(seconds, 1),
        "gaussians": training.model.count,
        "bases": training.model.export()[1].bases,
        "load_1min": round(load, 1),
        "machine": machine(),
        "commit": commit(),
    }


def read(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV; none if there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def append(path: Path, row: Mapping[str, object]) -> None:
    """Add the row to the CSV, with a header if the file is new; a file of other columns is refused."""
    fresh = not path.exists()
    if not fresh and path.read_text().splitlines()[:1] != [",".join(FIELDS)]:
        raise SystemExit(f"{path} has other columns than {', '.join(FIELDS)}: move it away first.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if fresh:
            writer.writeheader()
        writer.writerow(row)


@dataclass(frozen=True)
class Gain:
    """What a departure is worth on a clip: medians over the seeds of `fast` less `fast` without it.

    cpu_s  0.0 where the difference is no greater than that between runs of `fast` itself
    """

    left_db: float
    right_db: float | None
    cpu_s: float

    @property
    def by_figure(self) -> Mapping[str, float | None]:
        """The gains by the names of the rows' columns."""
        return {"psnr_tissue_db": self.left_db, "psnr_right_db": self.right_db, "cpu_s": self.cpu_s}

    def __str__(self) -> str:
        right = "" if self.right_db is None else f" (right eye {signed(self.right_db, 2)})"
        return f"{signed(self.left_db, 2)} dB{right}, {signed(self.cpu_s, 0)} s"


def signed(value: float, digits: int) -> str:
    """The value with its sign and `digits` decimals; "0" for exactly 0."""
    return f"{round(value, digits) + 0.0:+.{digits}f}" if value else "0"  # adding 0.0 turns -0.0 into 0.0


def gains_of(rows: Sequence[Row], clip: str) -> dict[str, Gain]:
    """The gains on a clip by departure; departures without rows are skipped."""
    found = {}
    for departure in DEPARTURES:
        without = [row for row in rows if (row["run"], row["clip"]) == (departure.name, clip)]
        baseline = STOPPED if departure.name == STOPPING else "fast"
        gains: dict[str, list[float]] = {"psnr_tissue_db": [], "psnr_right_db": [], "cpu_s": []}
        for row in without:
            same = [each for each in rows if each["run"] == baseline and all(each[key] == row[key] for key in KEY[1:])]
            for figure, values in gains.items():
                known = [float(each[figure]) for each in same if each[figure]]
                if known and row[figure]:
                    values.append(median(known) - float(row[figure]))
        if gains["psnr_tissue_db"]:
            right, cpu_s = gains["psnr_right_db"], median(gains["cpu_s"])
            found[departure.name] = Gain(
                median(gains["psnr_tissue_db"]),
                median(right) if right else None,
                cpu_s if abs(cpu_s) > noise_s(rows, clip) else 0.0,
            )
    return found


def noise_s(rows: Sequence[Row], clip: str) -> float:
    """The greatest difference in processor seconds between runs of `fast` with one seed and length on the clip."""
    by_key: dict[tuple[str, ...], list[float]] = {}
    for row in rows:
        if (row["run"], row["clip"]) == ("fast", clip):
            by_key.setdefault(tuple(row[key] for key in KEY), []).append(float(row["cpu_s"]))
    return max((max(times) - min(times) for times in by_key.values()), default=0.0)


def changes(departure: Departure) -> str:
    """The values that the departure changes, as in paper.py and as in fast.py: "opacity 0.1 → 0.9; spread 1 → 0.5"."""
    parts = ((departure.fields, PAPER), (departure.rates, PAPER.rates), (departure.loss, PAPER.loss))
    pairs = ((name, getattr(base, name), value) for values, base in parts for name, value in values.items())
    return "; ".join(f"{name} {shown(old)} → {shown(new)}" for name, old, new in pairs)


def shown(value: Any) -> str:
    """A preset's value in a few characters: rates as start..end, settings by their mode."""
    match value:
        case bool():
            return "yes" if value else "no"
        case Rate():
            return f"{value.start:.3g}" if value.end is None else f"{value.start:.3g}..{value.end:.3g}"
        case FusionSettings():
            return value.mode
        case DensifySettings():
            return f"every {value.every}"
        case float():
            return f"{value:g}"
    return "none" if value is None else str(value)


def clips_of(rows: Sequence[Row]) -> list[str]:
    """The clips of the rows, in their order."""
    return list(dict.fromkeys(row["clip"] for row in rows))


def table_of(rows: Sequence[Row]) -> str:
    """The table of docs/method.md: a row per departure, and `paper` and `fast` themselves below."""
    columns = [
        (clip, figure, unit, digits)
        for clip in clips_of(rows)
        for figure, unit, digits in (
            ("psnr_tissue_db", "dB", 2),
            ("psnr_right_db", "right eye, dB", 2),
            ("cpu_s", "s", 0),
        )
        if any(row[figure] for row in rows if row["clip"] == clip)
    ]
    gains = {clip: gains_of(rows, clip) for clip in clips_of(rows)}
    cells = []
    for departure in DEPARTURES:
        if departure.name in UNMEASURED:
            continue
        line = [departure.name, changes(departure)]
        for clip, figure, _, digits in columns:
            value = gains[clip][departure.name].by_figure[figure] if departure.name in gains[clip] else None
            line.append("–" if value is None else signed(value, digits))
        cells.append(line)
    length = next(row["iterations"] for row in rows if row["run"] == "fast")
    for name in ("fast", "paper"):
        line = [f"`{name}` after {length} iterations", ""]
        for clip, figure, _, digits in columns:
            own = [float(row[figure]) for row in rows if (row["run"], row["clip"]) == (name, clip) and row[figure]]
            line.append(number(median(own) if own else None, digits))
        cells.append(line)
    header = ["departure", "`paper` → `fast`", *(f"{clip}: {unit}" for clip, _, unit, _ in columns)]
    spread = ", ".join(f"{noise_s(rows, clip):.1f} s on {clip}" for clip in clips_of(rows))
    noise = f"\nRuns of `fast` itself differed by up to {spread}; smaller differences in seconds are written as 0.\n"
    return table(header, cells) + noise + origin([dict(row) for row in rows])


def with_gains(source: str, rows: Sequence[Row]) -> str:
    """The text of fast.py with a line "Gain" above every departure that has rows, and none above the others."""
    gains = {clip: gains_of(rows, clip) for clip in clips_of(rows)}
    text = re.sub(r"    # Gain: .*\n", "", source)

    def line(found: re.Match[str]) -> str:
        measured = [f"{clip} {gains[clip][found[1]]}" for clip in gains if found[1] in gains[clip]]
        return f"    # Gain: {'; '.join(measured)}.\n{found[0]}" if measured else found[0]

    return re.sub(r'    Departure\(\s*"([^"]+)"', line, text)


def with_table(page: str, rows: Sequence[Row]) -> str:
    """The text of docs/method.md with the table of the rows between its markers."""
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}\n{table_of(rows)}\n{END}{rest.partition(END)[2]}"


def write_all(rows: Sequence[Row]) -> None:
    """The table of docs/method.md, its picture, and the lines of fast.py; prints those that changed."""
    METHOD.write_text(with_gains(METHOD.read_text(), rows))
    PAGE.write_text(with_table(PAGE.read_text(), rows))
    draw(rows, PICTURE)
    for clip in clips_of(rows):
        for name, gain in gains_of(rows, clip).items():
            print(f"{clip}: {name}: {gain}")


def draw(rows: Sequence[Row], path: Path) -> None:
    """Bars of every departure's gain in dB on each clip and eye, in the order of fast.py."""
    import matplotlib
    from matplotlib.figure import Figure

    bars: dict[str, dict[str, float]] = {}  # the gains in dB by departure, of each clip and eye
    for clip in clips_of(rows):
        for name, gain in gains_of(rows, clip).items():
            bars.setdefault(clip, {})[name] = gain.left_db
            if gain.right_db is not None:
                bars.setdefault(f"{clip}, right eye", {})[name] = gain.right_db
    names = [each.name for each in DEPARTURES if any(each.name in gains for gains in bars.values())]
    with matplotlib.rc_context(SETTINGS | {"axes.grid.axis": "x"}):
        figure = Figure(figsize=(7.0, 0.3 * len(names) + 0.9), layout="constrained")
        axes = figure.subplots()
        for (label, gains), colour in zip(bars.items(), COLOURS, strict=False):
            for line, name in enumerate(names):
                beside = [other for other in bars if name in bars[other]]
                if label in beside:
                    at = line + (beside.index(label) - (len(beside) - 1) / 2) * BAR
                    axes.barh(at, gains[name], BAR, color=colour, label=label if name == next(iter(gains)) else None)
        axes.axvline(0, color=GREY, linewidth=0.8)
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlabel("gain of the departure on held-out frames, dB")
        axes.legend(loc="lower right", frameon=True, edgecolor=FAINT)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=PNG_DPI, metadata={"Software": None})


if __name__ == "__main__":
    main()
