"""Services read what workers of a later version tell, without what they do not know: workers are upgraded first."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from contract.queue.redis_hash import new_record, record_of
from contract.store.store import Store
from contract.wire.job import JobError
from contract.wire.rendering import WorkerAddress
from contract.wire.webhooks import Delivery, TryFailure
from intrasplat.errors import ErrorCode
from intrasplat.names import CURVE, MANIFEST, REPORT
from intrasplat.notices import NoticeCode
from tests.contract.queues import TRAINING, job
from tests.reports import REPORT_OF_A_SCENE, a_warning

LATER: dict[str, Any] = {"of_a_later_version": {"deep": [1]}}


def stored(**changes: str) -> dict[str, str]:
    """The hash of a job on the queue's server."""
    return {**json.loads(new_record(job())[1]), **changes}


def test_progress_with_more_fields_is_read_without_them() -> None:
    told = TRAINING.model_dump() | LATER
    record = record_of("0" * 32, stored(progress=json.dumps(told)))
    assert record is not None
    assert record.progress == TRAINING


def test_an_error_of_a_kind_that_came_later_is_unclassified_and_keeps_its_words() -> None:
    told = {"code": "came_later", "problem": "The moon is full.", "remedy": "Wait."} | LATER
    record = record_of("0" * 32, stored(error=json.dumps(told)))
    assert record is not None
    assert record.error == JobError(code=ErrorCode.UNCLASSIFIED, problem="The moon is full.", remedy="Wait.")


def test_a_try_of_a_webhook_that_failed_for_a_reason_that_came_later_is_unclassified() -> None:
    tries = [{"at_s": 1.0, "failure": "came_later"} | LATER, {"at_s": 9.0, "status_code": 204}]
    told = {"event_id": "5f.1.done", "state": "done", "ended_at_s": 0.5, "tries": tries} | LATER
    assert [each.failure for each in Delivery.model_validate(told).tries] == [TryFailure.UNCLASSIFIED, None]


def test_a_report_with_more_fields_and_notices_that_came_later_is_read(tmp_path: Path) -> None:
    store, submitted = Store(tmp_path), job()
    folder = store.work_folder(submitted.job_id, 1)
    document = REPORT_OF_A_SCENE.model_dump(mode="json") | LATER
    document["warnings"] = [{"code": "came_later", "severity": "warning", "text": "The moon is full."} | LATER]
    (folder / REPORT).write_text(json.dumps(document))
    (folder / CURVE).write_text("t_train_s,psnr_tissue_db,psnr_right_db\n1,30,\n")
    (folder / MANIFEST).write_text("{}")
    store.publish_scene(submitted.job_id, 1)
    warning = a_warning("The moon is full.", NoticeCode.UNCLASSIFIED)
    assert store.newest_report(submitted.job_id, 1) == REPORT_OF_A_SCENE.model_copy(update={"warnings": (warning,)})


def test_a_worker_that_announces_more_is_found() -> None:
    address = WorkerAddress(name="worker-1", endpoint="ipc:///somewhere", device="cpu")
    assert WorkerAddress.model_validate_json(json.dumps(address.model_dump() | LATER)) == address


@pytest.mark.parametrize("later", [LATER, {"options": LATER}])
def test_a_job_that_asks_for_more_is_not_run_without_it(later: dict[str, Any]) -> None:
    fields = stored()
    document = json.loads(fields["document"]) | later
    assert record_of("0" * 32, {**fields, "document": json.dumps(document)}) is None
