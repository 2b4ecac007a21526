"""The stability atlas: a cell is a clip degraded by one condition, trained, scored by truth, and judged by verdict.py.

Symbols: T frames of the clean clip, S frames of the given one, H W pixels.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import split_frames
from intrasplat.errors import InputError
from intrasplat.machine.timing import Timings
from intrasplat.pipeline import open_with_poses, reconstruct
from intrasplat.poses.trajectory import trajectory_error
from intrasplat.report import Report
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.model import model_of
from intrasplat.splat.backend import choose_device
from intrasplat.train.hooks import RenderedFrame, TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.targets import solid_depth_mm
from intrasplat.view.camera import view_camera
from lab.conditions import (
    CLEAN,
    CLEAN_STEREO,
    CONDITIONS,
    CleanClip,
    Given,
    Recording,
    clean_clip,
    clean_given,
    write_recording,
)
from lab.evaluate.cells import eyes_of, is_rival_system, preset_of
from lab.evaluate.fitted import fitted_db, plain_db
from lab.evaluate.rows import NO_RESULT, Row, commit, machine, read_rows, texts_of, write_rows
from lab.evaluate.thinned import lattice, thinned_camera
from lab.evaluate.verdict import PATH, SEPARATOR, VERDICT, failure, verdict
from lab.phantom import PhantomSettings
from lab.rivals import RIVAL_SYSTEMS, scored_step_px
from lab.rivals.run import Length, every_core, run_rival

STABILITY = "stability.csv"
KEY = ("condition", "severity", "series", "seed", "iterations", "width", "height", "frames")
FIELDS = (
    *KEY, "level", *VERDICT, "psnr_db", "fitted_db", "depth_error_mm", "reported_db", "seconds", "new_warnings",
    "warnings", "codes", "error", "machine", "commit", *PATH,
)  # fmt: skip
"""psnr_db and depth_error_mm (mean) are against the truth; fitted_db is psnr_db after one fit of gain and offset by
channel over all that is judged, empty in rows from before it was measured. reported_db is what the report says of
itself; codes has SEVERITY:CODE of each of the warnings."""


@dataclass(frozen=True)
class Grid:
    """What the cells of a run share: the clean clip's size and how long they train."""

    width: int = 160
    height: int = 128
    frames: int = 32
    iterations: int = 150

    def settings(self, seed: int) -> PhantomSettings:
        """The settings of a seed's clean clip: each seed has its own tissue."""
        return PhantomSettings(width=self.width, height=self.height, frames=self.frames, seed=seed)

    @classmethod
    def of(cls, rows: Sequence[Row]) -> Grid:
        """The grid of these rows. Raises InputError if they have different ones, or there are none."""
        found = {tuple(int(row[each.name]) for each in dataclasses.fields(cls)) for row in rows}
        if not found:
            raise InputError("--out", "the folder holds no rows.", "Leave --redraw out.")
        if len(found) > 1:
            problem = f"the folder holds rows of {len(found)} sizes, lengths or numbers of iterations."
            raise InputError("--out", problem, f"Keep one of them in {STABILITY}: they cannot be summed up together.")
        return cls(*found.pop())

    def __str__(self) -> str:
        return f"{self.width}x{self.height}, {self.frames} frames, {self.iterations} iterations"


@dataclass(frozen=True)
class StabilityCell:
    """One clip, one method."""

    condition: str
    severity: int
    series: str
    seed: int

    def key(self, grid: Grid) -> tuple[str, ...]:
        """What its row is found by; the values of KEY."""
        return tuple(str(value) for value in (*dataclasses.astuple(self), *_shared(grid)))

    @property
    def clean(self) -> StabilityCell:
        """The cell that it is compared with."""
        return StabilityCell(_clean_name(self.condition), 0, self.series, self.seed)


def plan(
    conditions: Sequence[str], severities: Sequence[int], series: Sequence[str], seeds: Sequence[int]
) -> list[StabilityCell]:
    """Every combination, the clean cells they are compared with first. InputError for a name that is not known."""
    unknown = [name for name in conditions if name not in CONDITIONS]
    if unknown:
        raise InputError("--conditions", f"there is no {unknown[0]!r}.", f"Use some of: {', '.join(CONDITIONS)}.")
    for name in series:
        if not is_rival_system(name):
            preset_of(name)
    cells: dict[StabilityCell, None] = {}
    for seed in seeds:
        for method in series:
            spoilt = [StabilityCell(name, severity, method, seed) for name in conditions for severity in severities]
            cells |= dict.fromkeys([each.clean for each in spoilt]) | dict.fromkeys(spoilt)
    return list(cells)


@dataclass
class StabilityBench:
    """The rows of a folder, each kept as soon as its cell is measured."""

    folder: Path
    grid: Grid
    rows: list[Row] = field(default_factory=list)
    _clean: dict[int, CleanClip] = field(default_factory=dict)
    _commit: str = field(default_factory=commit)  # of the code as it was loaded; the tree may go on while this runs

    def __post_init__(self) -> None:
        self.rows = stability_rows(self.folder)

    def missing(self, cells: Sequence[StabilityCell]) -> list[StabilityCell]:
        """The cells without a row."""
        there = {tuple(row[name] for name in KEY) for row in self.rows}
        return [cell for cell in cells if cell.key(self.grid) not in there]

    def measure(self, cell: StabilityCell, hooks: TrainingHooks) -> Row:
        """Train and judge a cell, and keep its row.

        Raises:
            Cancelled: hooks.should_stop said so.
            UnavailableError: this machine lacks something, such as room on the disk.
        """
        if cell.seed not in self._clean:
            self._clean.clear()  # one at a time: cells come seed by seed
            self._clean[cell.seed] = clean_clip(self.grid.settings(cell.seed))
        row = measured(cell, self._clean[cell.seed], self.grid, hooks)
        row |= {"machine": row["machine"] or machine(), "commit": self._commit}
        key = cell.clean.key(self.grid)
        clean = next((each for each in self.rows if tuple(each[name] for name in KEY) == key), None)
        row |= verdict(row, row if cell == cell.clean else clean)
        self.rows.append(row)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_rows(self.folder / STABILITY, FIELDS, self.rows)
        return row


def stability_rows(folder: Path) -> list[Row]:
    """The rows in a folder; columns that an older file lacks are empty."""
    return [texts_of(row, FIELDS) for row in read_rows(folder / STABILITY)]


def measured(cell: StabilityCell, clean: CleanClip, grid: Grid, hooks: TrainingHooks) -> Row:
    """The row of a cell, without its verdict and origin; a failure's row says why in `error`.

    Raises:
        Cancelled, UnavailableError: as StabilityBench.measure.
    """
    condition = CONDITIONS.get(cell.condition)
    row = dict(zip(KEY, cell.key(grid), strict=True)) | {name: "" for name in FIELDS if name not in KEY}
    row["level"] = "" if condition is None else f"{condition.level(cell.severity):g}"
    start = time.perf_counter()
    try:
        given = (
            clean_given(clean, stereo=cell.condition == CLEAN_STEREO)
            if condition is None
            else condition.apply(clean, cell.severity, cell.seed)
        )
        start = time.perf_counter()  # drawing the clip is not the method's work
        row |= _reconstructed(given, cell, grid, hooks)
    except NO_RESULT:
        raise
    except Exception as error:
        row |= {"error": f"{type(error).__name__}: {' '.join(str(error).split())}", "outcome": failure(error)}
    return row | {"seconds": f"{time.perf_counter() - start:.2f}"}


@dataclass(frozen=True, eq=False)
class Moment:
    """A time that is judged: model time t, the given frame whose pose is taken, the clean frame that is the truth."""

    t: float
    frame: int
    truth: int


def moments_of(given: Given, held_out: Sequence[int], frame_count: int) -> list[Moment]:
    """The held-out frames; where none are held out, half-way between given frames; of a single frame, itself."""
    if held_out:
        return [Moment(frame / frame_count, frame, given.source[frame]) for frame in held_out]
    found = []
    for frame, (here, after) in enumerate(itertools.pairwise(given.source)):
        between = (here + after) // 2
        found.append(Moment((frame + (between - here) / max(after - here, 1)) / frame_count, frame, between))
    return found or [Moment(0.0, 0, given.source[0])]


@dataclass(frozen=True, eq=False)
class _Made:
    """A finished model of either kind: its report, the poses [S, 4, 4] it took, and its picture at a moment, on a
    lattice of pixels."""

    report: Report
    world_from_camera: NDArray[np.float64]
    show: Callable[[Moment], RenderedFrame]
    step_px: int = 1


def _made(request: ReconstructionRequest, cell: StabilityCell, out: Path, hooks: TrainingHooks) -> _Made:
    if is_rival_system(cell.series):
        with every_core():
            return _made_by_rival(request, cell, hooks)
    report = reconstruct(dataclasses.replace(request, own_preset=preset_of(cell.series)), out, hooks)
    scene = load_scene(out)
    model = model_of(scene)

    def show(moment: Moment) -> RenderedFrame:
        camera = view_camera(scene, moment.t, scene.world_from_camera[moment.frame], scene.intrinsics)
        image = model.render(camera, moment.t).copy()  # the model renders into the same array again
        depth_mm = solid_depth_mm(image[3], image[4], scene.units_per_mm)
        return RenderedFrame(image[:3].transpose(1, 2, 0), depth_mm, image[4])

    return _Made(report, scene.world_from_camera, show)


def _made_by_rival(request: ReconstructionRequest, cell: StabilityCell, hooks: TrainingHooks) -> _Made:
    options, device = request.options, choose_device(request.device)
    clip = open_with_poses(request, hooks, Timings(), device)
    step_px = scored_step_px(cell.series, device, clip.intrinsics.width)
    drawn_by = thinned_camera(clip.intrinsics, step_px)
    fitted = run_rival(
        cell.series,
        RIVAL_SYSTEMS[cell.series],
        clip,
        split_frames(clip, options.holdout),
        Length(options.iterations, None),
        seed=cell.seed,
        device=device,
        waited_s=0.0,
        hooks=hooks,
        step_px=step_px,
    )

    def show(moment: Moment) -> RenderedFrame:
        return fitted.renders(moment.t, clip.world_from_camera[moment.frame], drawn_by)

    return _Made(fitted.report, clip.world_from_camera, show, step_px)


def _reconstructed(given: Given, cell: StabilityCell, grid: Grid, hooks: TrainingHooks) -> Row:
    """What `reconstruct` makes of the clip, judged by the truth and as it judges itself."""
    with tempfile.TemporaryDirectory() as folder:
        asked = (
            write_recording(given.clip, Path(folder, "clip"))
            if isinstance(given.clip, Recording)
            else ReconstructionRequest(given.clip)
        )
        chosen = {"iterations": grid.iterations, "seed": cell.seed, "eyes": eyes_of(cell.series)}
        options = asked.options.model_copy(update=chosen)
        made = _made(dataclasses.replace(asked, options=options), cell, Path(folder, "scene"), hooks)
    report = made.report
    psnr_db, after_fit_db, depth_error_mm = _judged(given, made, moments_of(given, report.held_out, report.frame_count))
    off = None if given.path is None else trajectory_error(made.world_from_camera, given.path)
    return {
        "path_error_mm": _text(None if off is None else off.mm),
        "path_error_deg": _text(None if off is None else off.deg),
        "psnr_db": _text(psnr_db),
        "fitted_db": _text(after_fit_db),
        "depth_error_mm": _text(depth_error_mm),
        "reported_db": _text(report.psnr_tissue_db),
        "machine": machine(report.device),
        "warnings": SEPARATOR.join(_one_line(report)),
        "codes": " ".join(f"{each.severity}:{each.code}" for each in report.warnings),
    }


def _judged(given: Given, made: _Made, moments: Sequence[Moment]) -> tuple[float, float, float]:
    """Mean psnr in dB, the same after a fit of gain and offset, and mean |z - truth| in mm over the moments' scored
    pixels; NaN where there is none."""
    views, errors_mm, drawn = [], [], lattice(made.step_px)
    for moment in moments:
        shown = made.show(moment)
        depth_mm = shown.depth_mm
        rgb, truth, scored = (each[moment.truth][drawn] for each in (given.rgb, given.depth_mm, given.scored))
        views.append((shown.rgb, rgb, scored))
        both = scored & (truth > 0) & (depth_mm > 0)
        errors_mm.append(np.abs(depth_mm[both] - truth[both]))
    return plain_db(views), fitted_db(views), _mean(np.concatenate(errors_mm))


def _clean_name(condition: str) -> str:
    return condition if condition in (CLEAN, CLEAN_STEREO) else CONDITIONS[condition].clean_name


def _shared(grid: Grid) -> tuple[int, ...]:
    return grid.iterations, grid.width, grid.height, grid.frames


def _one_line(report: Report) -> Iterator[str]:
    return (" ".join(each.text.replace(SEPARATOR, " ").split()) for each in report.warnings)


def _mean(values: NDArray[np.floating]) -> float:
    return float(values.mean()) if values.size else math.nan


def _text(value: float | None) -> str:
    """Empty for what is not known."""
    return "" if value is None or math.isnan(value) else f"{value:.3f}"
