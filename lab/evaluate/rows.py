"""runs.csv and curves.csv: a row per run with commit and machine, written as soon as the run has ended.

A process that adds rows rewrites the folder's files, so only one process at a time may do so: adding_alone().

A run is found by KEY. Both files are written whole and renamed, the curve before the run, so that after any
interruption a run either has its row and its curve or is measured again.
"""

from __future__ import annotations

import csv
import io
import os
import platform
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from contract.runtime.locks import FolderLock
from intrasplat.errors import Cancelled, InputError, UnavailableError
from intrasplat.files.durable import FOR_ALL, replace_file
from lab.evaluate.cells import with_eyes

Row = dict[str, str]

RUNS, CURVES = "runs.csv", "curves.csv"
LOCK = ".lock"
KEY = ("clip", "holdout", "series", "seed", "limit")
SCORES = (
    "psnr_tissue_db", "psnr_clear_db", "psnr_right_db", "psnr_right_clear_db", "psnr_paper_db", "ssim",
    "depth_agreement_mm", "coverage", "train_psnr_tissue_db",
)  # fmt: skip
COPIES = ("copy_blend_db", "copy_flow_db", "warp_db", "warp_clear_db")
TRUTH = (
    "psnr_view10_db", "psnr_view15_db", "psnr_baked10_db", "psnr_baked15_db", "bound10_db", "bound15_db",
    "psnr_hidden_db", "depth_error_mm", "motion_error_mm", "moving_error_mm", "moving_mm", "empty_ok", "seen_ok",
    "rank_colour", "rank_depth", "rank_colour_8px", "rank_depth_8px",
    "rank_right_colour", "rank_right_depth", "rank_right_colour_8px", "rank_right_depth_8px",
)  # fmt: skip
SIZE = ("iterations", "gaussians", "bases", "floats_a_gaussian", "scene_bytes", "stored_loss_held_out_db")
SPEED = ("t_train_s", "t_post_s", "seconds", "step_ms", "render_ms", "render_fps", "width", "height", "load_1min")
ORIGIN = ("machine", "commit", "command", "error", "not_measured")
RUN_FIELDS = (*KEY, *SCORES, *COPIES, *TRUTH, *SIZE, *SPEED, *ORIGIN)
"""Empty means not measured. docs/conventions.md defines SCORES and the clocks, truth.py TRUTH, measure.py the rest:
SIZE in _size and _stored_loss_held_out_db, SPEED in seconds_of and _speed. seconds is JSON, load_1min before the run.
not_measured says which figures a method of others cannot have, and why.
"""
CURVE_FIELDS = (
    *KEY, "t_train_s", "t_post_s", "iteration", "psnr_tissue_db", "psnr_right_db", "ssim", "depth_agreement_mm",
)  # fmt: skip
NO_RESULT = (Cancelled, UnavailableError, ModuleNotFoundError)
"""Errors of the caller or of this machine, not of the method: they end measuring and get no row. Any other error is a
failure of the method: a result, with a row."""


def key_of(row: Mapping[str, str]) -> tuple[str, ...]:
    """The key of a run."""
    return tuple(row[name] for name in KEY)


class Results:
    """The runs and curves of a folder, as they are now; columns that an older file lacks are empty.

    Runs on stereo clips from before both eyes could teach are of the left eye: their series say so here.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.runs = [texts_of(row, RUN_FIELDS) for row in read_rows(folder / RUNS)]
        curves = [texts_of(row, CURVE_FIELDS) for row in read_rows(folder / CURVES)]
        before = {key_of(row) for row in self.runs if _is_of_left_eye(row)}
        for row in (*self.runs, *curves):
            if key_of(row) in before and not row["psnr_right_db"]:
                row["series"] = with_eyes(row["series"], "left")
        kept = {key_of(row) for row in self.runs}
        self.curves = [row for row in curves if key_of(row) in kept]

    def has(self, key: tuple[str, ...]) -> bool:
        """Whether the run has a row, of success or of failure."""
        return any(key_of(row) == key for row in self.runs)

    def failed(self, keys: Iterable[tuple[str, ...]]) -> list[Row]:
        """The rows of these runs that record a failure."""
        asked = set(keys)
        return [row for row in self.runs if row["error"] and key_of(row) in asked]

    def forget_failed(self) -> None:
        """Let failed runs be measured again; the files keep their rows until the next row is added."""
        self.runs = [row for row in self.runs if not row["error"]]

    def add(self, run: Mapping[str, object], curve: Sequence[Mapping[str, object]]) -> None:
        """Store a run and its curve."""
        key = {name: run[name] for name in KEY}
        self.curves += [texts_of({**key, **point}, CURVE_FIELDS) for point in curve]
        self.runs.append(texts_of(run, RUN_FIELDS))
        self._folder.mkdir(parents=True, exist_ok=True)
        write_rows(self._folder / CURVES, CURVE_FIELDS, self.curves)
        write_rows(self._folder / RUNS, RUN_FIELDS, self.runs)


@contextmanager
def adding_alone(folder: Path) -> Iterator[None]:
    """Lock the folder for adding rows, and create it if missing. The lock ends with the process.

    Raises:
        InputError: another process adds rows to it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FolderLock(folder / LOCK)
    if not lock.take():
        problem = f"another process is adding rows to {folder}, and would overwrite those of this one."
        raise InputError("--out", problem, "Wait until it has ended, or name another folder.")
    try:
        yield
    finally:
        lock.release()


def read_rows(path: Path) -> list[Row]:
    """The rows of a CSV file; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [{name: value or "" for name, value in row.items() if name} for row in csv.DictReader(file)]


def write_rows(path: Path, fields: Iterable[str], rows: Iterable[Mapping[str, object]]) -> None:
    """Write a CSV file whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, tuple(fields), restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace_file(path, text.getvalue().encode(), FOR_ALL)


def replace_row(path: Path, fields: Iterable[str], key: Sequence[str], row: Mapping[str, str]) -> None:
    """Add a row of texts to a CSV file, in place of one with the same values of `key`."""
    others = [each for each in read_rows(path) if any(each[name] != row[name] for name in key)]
    write_rows(path, fields, [*others, row])


def machine(device: str = "cpu") -> str:
    """Processor, cores, another device if there is one, and the date."""
    name = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        models = [line.split(":", 1)[1].strip() for line in lines if "model name" in line]
        name = models[0] if models else name
    parts = [name, f"{os.cpu_count()} cores", *([] if device == "cpu" else [device]), time.strftime("%Y-%m-%d")]
    return ", ".join(parts)


def commit() -> str:
    """The commit measured, with + where tracked files other than results differ from it; "unknown" outside a
    repository."""
    try:
        found = _git("describe", "--always")
        changed = _git(
            "diff", "--name-only", "HEAD", "--", ":/", ":(top,exclude)docs/results", ":(top,exclude)lab/rows"
        )
    except OSError:
        return "unknown"
    return f"{found}{'+' * bool(changed)}" if found else "unknown"


def _git(*arguments: str) -> str:
    """What git prints about this file's repository; nothing if it fails."""
    command, folder = ["git", *arguments], Path(__file__).parent
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False).stdout.strip()


def _is_of_left_eye(row: Row) -> bool:
    """Whether a stereo clip was scored, and its right eye was not: before version 0.3 it took no part."""
    return bool(row["psnr_tissue_db"]) and not row["psnr_right_db"] and '"stereo_s"' in row["seconds"]


def texts_of(row: Mapping[str, object], fields: Sequence[str]) -> Row:
    """These fields of a row as a file holds them; what the row lacks is empty."""
    return {name: _text(row.get(name)) for name in fields}


def _text(value: object) -> str:
    """Empty for None and NaN; floats with six significant digits."""
    if value is None or value != value:  # NaN alone differs from itself
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
