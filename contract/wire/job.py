"""A job: what was asked for, where it stands, and the one table of how its state may change."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated, Any

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    field_serializer,
)

from contract.wire.labels import Labels
from intrasplat.codes import known_code
from intrasplat.errors import ErrorCode
from intrasplat.names import JOB_ID_PATTERN, LABORATORY_PRESETS
from intrasplat.options import JobOptions
from intrasplat.report import Imported

LOCAL_TENANT = "local"
"""Whose jobs they are where no key is asked for."""

TENANT_PATTERN = r"^[a-z0-9-]{1,40}$"


LATER_OPTIONS = ("fov",)
"""Options that workers of the last version do not know: a record leaves them out where they have their default."""


class JobState(StrEnum):
    """Where a job stands."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


TRANSITIONS: Mapping[JobState, frozenset[JobState]] = MappingProxyType(
    {
        JobState.QUEUED: frozenset({JobState.RUNNING, JobState.CANCELLED}),
        # Back to queued: its worker died or handed it back, and another attempt may start.
        JobState.RUNNING: frozenset({JobState.QUEUED, JobState.DONE, JobState.FAILED, JobState.CANCELLED}),
        JobState.DONE: frozenset(),
        # Only because a caller asked to try again: by itself a failed job stays where it is.
        JobState.FAILED: frozenset({JobState.QUEUED}),
        JobState.CANCELLED: frozenset(),
    }
)
"""The only changes of state there are; the queue's scripts are given their rows of it, so no second copy exists."""

TERMINAL_STATES = frozenset({JobState.DONE, JobState.FAILED, JobState.CANCELLED})
"""States that a job does not leave by itself."""


def sources_of(target: JobState) -> frozenset[JobState]:
    """The states from which `target` may be reached."""
    return frozenset(state for state, following in TRANSITIONS.items() if target in following)


class JobFiles(BaseModel):
    """File names inside the job's spool folder, made by the service (`clip.mp4`), never the caller's.

    clip: of an imported scene, its archive.
    poses_file, fov_mask: left out of JSON if there is none, because workers of older versions do not know them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    clip: str
    right: str | None = None
    calibration: str | None = None
    masks: str | None = None
    poses_file: str | None = Field(default=None, exclude_if=lambda name: name is None)
    fov_mask: str | None = Field(default=None, exclude_if=lambda name: name is None)


class JobProgress(BaseModel):
    """The last report of progress. fraction is of the stage, in [0, 1].

    psnr_db and psnr_right_db are the last held-out psnr_tissue of the left and of the right eye.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage: str
    fraction: float = Field(ge=0, le=1)
    iteration: int = 0
    iterations: int = 0
    psnr_db: float | None = None
    psnr_right_db: float | None = None
    seconds_left: float | None = None


class JobError(BaseModel):
    """Why a job failed: its kind, one sentence, the field at fault if it was the input, and what to do about it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    code: Annotated[ErrorCode, known_code(ErrorCode)] = ErrorCode.UNCLASSIFIED
    problem: str
    field: str | None = None
    remedy: str | None = None


def _offered(options: object) -> object:
    """A stored record's options, with `paper` in place of a variant of it that this version does not offer.

    So the jobs and scenes of an older version can still be listed and deleted.
    """
    if isinstance(options, dict) and options.get("preset") in LABORATORY_PRESETS:
        return {**options, "preset": "paper"}
    return options


class JobRecord(BaseModel):
    """All that is known of a job; the queue holds it, and it alone is the truth about the state. Times are UNIX s."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    job_id: str = Field(pattern=JOB_ID_PATTERN)
    state: JobState = JobState.QUEUED
    options: Annotated[JobOptions, BeforeValidator(_offered)] = JobOptions()
    labels: Labels = Labels()
    files: JobFiles
    tenant: str = Field(default=LOCAL_TENANT, pattern=TENANT_PATTERN)
    """The owner; no other tenant can find out that the job exists."""
    input_bytes: int = Field(default=0, ge=0)
    input_sha256: str = ""
    """The digest of all files, sorted by part."""
    clip_of: str | None = Field(default=None, pattern=JOB_ID_PATTERN)
    """The job that the clip came with first, if it was not sent with this one."""
    imported: Imported | None = None
    """Where the scene came from that this job takes in; None: it reconstructs a clip."""
    idempotency_key: str | None = None
    """SHA-256 of the caller's Idempotency-Key: a second submission under it yields this job."""
    callback_url: str | None = None
    """Where the service sends a webhook whenever the job has ended."""
    created_at_s: float
    started_at_s: float | None = None
    finished_at_s: float | None = None
    attempt: int = 0
    """Counts claims; a worker's report is accepted only for the attempt it holds."""
    released: int = 0
    """How many attempts do not count as deaths: released to end or for another job, or made before a retry."""
    owner: str | None = None
    """Name of the worker that holds, or last held, the job."""
    cancel_requested: bool = False
    progress: JobProgress | None = None
    error: JobError | None = None
    trace: str | None = Field(default=None, exclude=True)
    """The W3C traceparent of the request that submitted it. It stands in no JSON, so that older versions read that."""

    @field_serializer("options", mode="wrap")
    def _known_to_older_workers(self, options: JobOptions, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        default = JobOptions()
        unset = {name for name in LATER_OPTIONS if getattr(options, name) == getattr(default, name)}
        return {name: value for name, value in handler(options).items() if name not in unset}


class Forecast(BaseModel):
    """How many jobs will be claimed before a queued one, and in how many seconds a live one may be done."""

    model_config = ConfigDict(frozen=True)

    position: int | None
    eta_s: float | None


class JobView(BaseModel):
    """A job as the API shows it."""

    id: str
    label: str | None = Field(default=None, description="what its caller calls it; PATCH /jobs/{id} changes it")
    metadata: dict[str, str] = Field(default={}, description="what its caller noted on it")
    state: JobState
    stage: str | None = None
    fraction: float | None = None
    iteration: int | None = None
    iterations: int | None = None
    psnr_db: float | None = Field(default=None, description="last score on held-out frames of the left eye")
    psnr_right_db: float | None = Field(default=None, description="the same of the right eye; None without one")
    seconds_left: float | None = Field(default=None, description="of training, as it reports them; only while it runs")
    position: int | None = Field(
        default=None, description="jobs that will be claimed before this one; while queued; null in the list of jobs"
    )
    eta_s: float | None = Field(
        default=None, description="estimated seconds until it is done; null if unknown, and in the list of jobs"
    )
    error: JobError | None = None
    cancel_requested: bool = False
    attempt: int = 0
    options: JobOptions
    input_bytes: int
    clip_of: str | None = Field(default=None, description="the job that the clip came with first, if not with this one")
    imported: bool = Field(default=False, description="it takes in a scene that another installation made")
    created_at_s: float
    started_at_s: float | None = None
    finished_at_s: float | None = None
    links: dict[str, str]

    @classmethod
    def of(cls, record: JobRecord, forecast: Forecast | None = None) -> JobView:
        """The view of one record; `links` names what may be asked for next."""
        links = {"self": f"/jobs/{record.job_id}", "events": f"/jobs/{record.job_id}/events"}
        if record.state is JobState.FAILED:
            links["retry"] = f"/jobs/{record.job_id}/retry"
        if record.state in (JobState.RUNNING, JobState.DONE):
            links["render"] = f"/render?scene={record.job_id}"
        if record.callback_url is not None:
            links["deliveries"] = f"/jobs/{record.job_id}/deliveries"
        if record.state is JobState.DONE:
            links["scene"] = f"/scenes/{record.job_id}"
        progress = record.progress.model_dump() if record.progress else {}
        if record.state is not JobState.RUNNING:
            progress |= {"seconds_left": None}
        shared = record.model_dump(
            include={"state", "error", "cancel_requested", "attempt", "options", "input_bytes", "clip_of"}
            | {"created_at_s", "started_at_s", "finished_at_s"}
        )
        progress |= {"position": forecast.position, "eta_s": forecast.eta_s} if forecast else {}
        shared["imported"] = record.imported is not None
        return cls(id=record.job_id, links=links, **record.labels.model_dump(), **shared, **progress)
