"""What the supervisor and its device child say to each other: one JSON document a line.

    supervisor -> child   on the child's stdin    Run, Stop; its end means: end at once
    child -> supervisor   on the child's stdout   Ready once; Holding at any time;
                                                  of a job any number of Advanced, then Finished, Stopped or Failed

A job begins with Run and ends with one of its three reports, or with the child's death; only then may another begin.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from contract.wire.job import JobError, JobProgress, JobRecord
from worker.machine.hooks import Progress


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Run(_Message):
    """Reconstruct record's clip, which lies in `spool`, into `out`: empty, or with the state to go on from."""

    kind: Literal["run"] = "run"
    record: JobRecord
    spool: Path
    out: Path


class Stop(_Message):
    """Stop the job soon, its state kept in `out`; without a job it means nothing."""

    kind: Literal["stop"] = "stop"


class Ready(_Message):
    """Kernels are compiled, renders are answered at `endpoint`."""

    kind: Literal["ready"] = "ready"
    endpoint: str
    device: str


class Holding(_Message):
    """Scenes that are in the child's memory."""

    kind: Literal["holding"] = "holding"
    scenes: tuple[str, ...]


class Advanced(_Message):
    """The job has come further."""

    kind: Literal["advanced"] = "advanced"
    progress: JobProgress


class Finished(_Message):
    """The scene is complete in `out`."""

    kind: Literal["finished"] = "finished"


class Stopped(_Message):
    """The job stopped as it was told to. checkpointed: training had begun, and its state lies in `out`."""

    kind: Literal["stopped"] = "stopped"
    checkpointed: bool


class Failed(_Message):
    """The job cannot be done."""

    kind: Literal["failed"] = "failed"
    error: JobError
    fault: str
    """The error's kind, for the log: its text may hold the names of a caller's files."""


DeviceOrder: TypeAlias = Run | Stop
DeviceReport: TypeAlias = Ready | Holding | Advanced | Finished | Stopped | Failed

_ORDERS: TypeAdapter[DeviceOrder] = TypeAdapter(Annotated[DeviceOrder, Field(discriminator="kind")])
_REPORTS: TypeAdapter[DeviceReport] = TypeAdapter(Annotated[DeviceReport, Field(discriminator="kind")])


def line_of(message: DeviceOrder | DeviceReport) -> bytes:
    """The message as it goes over the wire."""
    return message.model_dump_json().encode() + b"\n"


def read_order(line: bytes) -> DeviceOrder:
    """The order in a line.

    Raises:
        ValidationError: there is none.
    """
    return _ORDERS.validate_json(line)


def read_report(line: bytes) -> DeviceReport | None:
    """The report in a line; None if something else has been printed."""
    try:
        return _REPORTS.validate_json(line)
    except ValidationError:
        return None


def job_progress(progress: Progress) -> JobProgress:
    """The report as the contract has it: fraction in [0, 1], no numbers that JSON cannot hold."""
    return JobProgress(
        stage=progress.stage,
        fraction=min(1.0, max(0.0, progress.fraction)) if math.isfinite(progress.fraction) else 0.0,
        iteration=progress.iteration,
        iterations=progress.iterations,
        psnr_db=_finite(progress.psnr_db),
        seconds_left=_finite(progress.seconds_left),
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
