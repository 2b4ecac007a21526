"""The generated types: they are those of contract/wire, and read what a later version adds."""

from __future__ import annotations

import json

import pytest

from client.generate_models import MODELS, generate
from contract.wire.job import TERMINAL_STATES
from intrasplat.notices import NoticeCode
from intrasplat.options import JobOptions
from intrasplat_client import InputError, JobState, JobView, Report, models
from intrasplat_client.submission import checked_options
from tests.reports import REPORT_OF_A_SCENE, a_warning

JOB = {"id": "0" * 32, "state": "queued", "options": {}, "input_bytes": 1, "created_at_s": 0.0, "links": {}}


def test_the_file_is_what_contract_wire_generates() -> None:
    assert MODELS.read_text(encoding="utf-8") == generate(), "run: python -m client.generate_models"


def test_a_job_of_a_later_version_is_read_and_its_new_fields_are_kept() -> None:
    job = JobView.model_validate({**JOB, "ward": "3", "options": {"preset": "of-tomorrow", "bases": 9}})
    assert job.state is JobState.QUEUED
    assert job.options.preset == "of-tomorrow"
    assert job.model_dump()["ward"] == "3"
    assert job.options.model_dump()["bases"] == 9


def test_a_report_of_a_later_version_is_read_with_notices_of_unknown_codes() -> None:
    known = a_warning("Rows differ.", NoticeCode.ROWS_MISALIGNED).model_dump(mode="json")
    unknown = {"code": "smoke", "severity": "alarm", "text": "?"}
    document = {**REPORT_OF_A_SCENE.model_dump(mode="json"), "warnings": [known, unknown]}
    first, second = Report.model_validate_json(json.dumps(document)).warnings
    assert first.code is models.NoticeCode.ROWS_MISALIGNED
    assert first.severity is models.Severity.WARNING
    assert (second.code, second.severity, second.text) == ("smoke", "alarm", "?")


def test_terminal_states_are_the_services() -> None:
    assert {state.value for state in models.TERMINAL_STATES} == {state.value for state in TERMINAL_STATES}


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"preset": "paper", "iterations": 30, "holdout": "1,9", "seed": 5},
        {"holdout": [1, 9, 17], "budget_s": 60, "priority": "high", "retention_hours": 12},
        {"budget_s": None, "iterations": 30},
        {"min_depth_mm": 4.0, "max_depth_mm": 120.0},
    ],
)
def test_options_that_the_client_lets_through_are_options_of_a_job(options: dict[str, object]) -> None:
    checked = checked_options(options)
    assert checked == options
    JobOptions.model_validate(checked)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"preset": "fsat"}, "options.preset"),
        ({"presset": "fast"}, "options.presset"),
        ({"iterations": 0}, "options.iterations"),
        ({"budget_s": 10_000}, "options.budget_s"),
        ({"holdout": "every9"}, "options.holdout"),
        ({"iterations": 30, "budget_s": 60}, "options.budget_s"),
    ],
)
def test_an_option_that_cannot_be_used_is_refused_before_anything_is_sent(
    options: dict[str, object], field: str
) -> None:
    with pytest.raises(InputError) as caught:
        checked_options(options)
    assert caught.value.field == field
    with pytest.raises(ValueError, match=field.removeprefix("options.")):
        JobOptions.model_validate(options)
