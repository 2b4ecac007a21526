"""The messages between the supervisor and its device process, one JSON document per line.

    supervisor -> child   on the child's stdin    RunJob, ScoreScene, StopJob; when stdin closes, the child ends at once
    child -> supervisor   on the child's stdout   Ready once; CachedScenes at any time; for each order any number of
                                                  Advanced, then its end

RunJob ends with Stopped or Failed, or with Finished followed by Scored or Stopped. ScoreScene ends with Scored or
Stopped. The child's death ends either. The next order may follow only then.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from contract.wire.job import JobError, JobProgress, JobRecord
from intrasplat.machine.hooks import Progress
from intrasplat.report import Report

FETCHING = "fetch"
"""The first stage that a caller sees: the job's files are fetched, and an imported scene is read."""


class Message(BaseModel):
    """An order or a report."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class RunJob(Message):
    """Reconstruct the record's clip in the folder `spool` into the empty `out`; resume the state in `resume_dir`."""

    kind: Literal["run"] = "run"
    record: JobRecord
    spool: Path
    out: Path
    resume_dir: Path


class ScoreScene(Message):
    """Score the finished scene in the folder `scene`, whose clip is in `spool`: its worker ended before scoring it."""

    kind: Literal["score"] = "score"
    record: JobRecord
    spool: Path
    scene: Path


class StopJob(Message):
    """Stop what runs; an unfinished job stores its state in `resume_dir`. Ignored while nothing runs."""

    kind: Literal["stop"] = "stop"


class Ready(Message):
    """The kernels are compiled, and `endpoint` accepts render requests."""

    kind: Literal["ready"] = "ready"
    endpoint: str
    device: str


class CachedScenes(Message):
    """The scenes in the child's memory."""

    kind: Literal["cached_scenes"] = "cached_scenes"
    scenes: tuple[str, ...]


class Advanced(Message):
    """The progress of the job."""

    kind: Literal["advanced"] = "advanced"
    progress: JobProgress


class Finished(Message):
    """The scene in `out` is complete except for its scores."""

    kind: Literal["finished"] = "finished"


class Scored(Message):
    """The report of the finished scene, with its scores or with the reason why there are none."""

    kind: Literal["scored"] = "scored"
    report: Report


class Stopped(Message):
    """The work stopped as ordered. checkpointed: training had started, and its state is in `resume_dir`."""

    kind: Literal["stopped"] = "stopped"
    checkpointed: bool


class Failed(Message):
    """The job failed."""

    kind: Literal["failed"] = "failed"
    error: JobError
    fault: str
    """The error's type, for the log. The error's text may contain names of a caller's files."""


DeviceOrder: TypeAlias = RunJob | ScoreScene | StopJob
DeviceReport: TypeAlias = Ready | CachedScenes | Advanced | Finished | Scored | Stopped | Failed

_ORDERS: TypeAdapter[DeviceOrder] = TypeAdapter(Annotated[DeviceOrder, Field(discriminator="kind")])
_REPORTS: TypeAdapter[DeviceReport] = TypeAdapter(Annotated[DeviceReport, Field(discriminator="kind")])


def line_of(message: Message) -> bytes:
    """The message as a line of JSON."""
    return message.model_dump_json().encode() + b"\n"


def read_order(line: bytes) -> DeviceOrder:
    """The order in a line.

    Raises:
        ValidationError: the line is not an order.
    """
    return _ORDERS.validate_json(line)


def read_report(line: bytes) -> DeviceReport | None:
    """The report in a line; None if the line is something else."""
    try:
        return _REPORTS.validate_json(line)
    except ValidationError:
        return None


def job_progress(progress: Progress) -> JobProgress:
    """Progress as the contract defines it: fraction in [0, 1], and None for numbers that are not finite."""
    return JobProgress(
        stage=progress.stage,
        fraction=min(1.0, max(0.0, progress.fraction)) if math.isfinite(progress.fraction) else 0.0,
        iteration=progress.iteration,
        iterations=progress.iterations,
        psnr_db=_finite(progress.psnr_db),
        psnr_right_db=_finite(progress.psnr_right_db),
        seconds_left=_finite(progress.seconds_left),
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
