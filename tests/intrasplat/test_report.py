"""Reports and their notices: old ones load, codes are documented."""

from __future__ import annotations

import json

from intrasplat.notices import NoticeCode, Severity
from intrasplat.report import REPORT_VERSION, LightChanges, Report
from tests.reports import REPORT_OF_A_SCENE, a_warning


def test_a_report_survives_its_json() -> None:
    report = REPORT_OF_A_SCENE.model_copy(update={"warnings": (a_warning("look out", NoticeCode.VEILED),)})
    assert Report.model_validate_json(report.model_dump_json()) == report


def test_a_report_of_before_light_was_stored_loads_without_it() -> None:
    light = LightChanges(reference=1, stops=(-0.5, 0.0), red=(1.1, 1.0), blue=(0.9, 1.0), smoke_share=(0.2, 0.0))
    document = json.loads(REPORT_OF_A_SCENE.model_copy(update={"light": light}).model_dump_json())
    assert Report.model_validate_json(json.dumps(document)).light == light
    del document["light"]
    assert Report.model_validate_json(json.dumps(document)) == REPORT_OF_A_SCENE


def test_a_report_of_version_1_with_plain_texts_still_loads() -> None:
    document = json.loads(REPORT_OF_A_SCENE.model_dump_json())
    document |= {"report_version": 1, "warnings": ["It is dark."], "assumptions": ["depth: millimetres"]}
    report = Report.model_validate_json(json.dumps(document))
    assert report.report_version == REPORT_VERSION
    (warning,), (assumption,) = report.warnings, report.assumptions
    assert (warning.text, warning.code, warning.severity) == ("It is dark.", NoticeCode.UNCLASSIFIED, Severity.WARNING)
    assert (assumption.text, assumption.severity) == ("depth: millimetres", Severity.INFO)
