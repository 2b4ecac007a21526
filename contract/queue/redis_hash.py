"""A JobRecord as a hash on Redis: the document as submitted, and one field for each value that changes."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from typing import TypeVar

from contract.wire.job import JobError, JobProgress, JobRecord, JobState
from contract.wire.labels import LABEL_FIELD, METADATA_FIELD, LabelChange, Labels

EVENT_FIELDS = ("state", "attempt", "released", "owner", "cancel", "progress", "error", "started", "finished")
"""The fields that change. Together with the document and the labels they make the record."""

LABEL_FIELDS = (LABEL_FIELD, METADATA_FIELD)
"""They change too. No event stores them, so a removed text is not left in an earlier event."""

CALLBACK_FIELD = "callback"
"""Never changes. It has a field of its own for the scripts, and for readers of an earlier version."""

BESIDE_EVENTS = ("document", CALLBACK_FIELD, *LABEL_FIELDS)
"""The fields that complete the record of an event, besides those of the event itself."""

Model = TypeVar("Model", JobProgress, JobError)

logger = logging.getLogger("intrasplat.queue")


def new_record(record: JobRecord) -> tuple[str, str, str, str]:
    """ARGV 2 to 5 of submit.lua and restore.lua: id, hash as JSON, time of submission, idempotency hash."""
    fields = {
        "document": record.model_dump_json(exclude={"labels", "callback_url"}),
        "state": record.state.value,
        "attempt": str(record.attempt),
        "released": str(record.released),
        "tenant": record.tenant,
        "priority": record.options.priority,
        "trace": record.trace,
        CALLBACK_FIELD: record.callback_url,
        "owner": record.owner,
        "cancel": "1" if record.cancel_requested else None,
        "progress": record.progress and record.progress.model_dump_json(),
        "error": record.error and record.error.model_dump_json(),
        "started": record.started_at_s and repr(record.started_at_s),
        "finished": record.finished_at_s and repr(record.finished_at_s),
    }
    fields |= {name: value or None for name, value in label_fields(LabelChange(**record.labels.model_dump())).items()}
    known = {name: value for name, value in fields.items() if value is not None}
    return record.job_id, json.dumps(known), repr(record.created_at_s), record.idempotency_key or ""


def label_fields(change: LabelChange) -> dict[str, str]:
    """The fields of a job's hash that a change of its labels sets; the caller removes those that become empty."""
    fields = {LABEL_FIELD: change.label or "", METADATA_FIELD: json.dumps(change.metadata) if change.metadata else ""}
    return {name: fields[name] for name in LABEL_FIELDS if name in change.model_fields_set}


def table_of(answer: Sequence[str]) -> dict[str, str]:
    """The fields of a hash that a script returns as alternating names and values."""
    return dict(zip(answer[::2], answer[1::2], strict=True))


def record_of(job_id: str, fields: Mapping[str, str]) -> JobRecord | None:
    """The record in a job's hash; None if the hash is empty, or if it cannot be read, which is logged."""
    if not fields:
        return None
    try:
        return JobRecord.model_validate_json(fields["document"]).model_copy(update=_changed(fields))
    except (ValueError, KeyError) as error:
        extra = {"job_id": job_id, "error": type(error).__name__}
        logger.error("The record of a job cannot be read.", extra=extra)
        return None


def _changed(fields: Mapping[str, str]) -> dict[str, object]:
    """The values of a record that have changed since it was submitted."""
    return {
        "state": JobState(fields["state"]),
        "callback_url": fields.get(CALLBACK_FIELD),
        "labels": Labels(label=fields.get(LABEL_FIELD), metadata=json.loads(fields.get(METADATA_FIELD) or "{}")),
        "attempt": int(fields["attempt"]),
        "released": int(fields["released"]),
        "owner": fields.get("owner"),
        "cancel_requested": "cancel" in fields,
        "progress": _parsed(JobProgress, fields.get("progress")),
        "error": _parsed(JobError, fields.get("error")),
        "started_at_s": float(fields["started"]) if "started" in fields else None,
        "finished_at_s": float(fields["finished"]) if "finished" in fields else None,
        "trace": fields.get("trace"),
    }


def _parsed(model: type[Model], document: str | None) -> Model | None:
    """What a worker reported. Fields that only a later version knows are ignored."""
    return model.model_validate_json(document, extra="ignore") if document else None
