"""GET /scenes/{id}/measure: asked of the worker, refused with the field that is at fault."""

from __future__ import annotations

import pytest

from contract.access.keys import KeyScope
from contract.wire.rendering import MeasureRequest
from intrasplat.measuring import Measurement
from intrasplat.picture import IntrinsicsOverride
from intrasplat.pose import OrbitPose
from tests.measurements import measured_flat
from tests.service.under_test import ServiceUnderTest, assert_problem, bearer


def test_points_of_a_view_are_measured_by_the_worker(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    asked = {"points": "10,40;20.5,40", "t": 0.25, "pose": "orbit:5,0,1", "width": 120, "height": 96}
    answer = service.http.get(f"/scenes/{scene}/measure", params=asked)
    assert answer.status_code == 200
    assert answer.headers["cache-control"] == "no-store"
    (request,) = service.painter.requests
    assert isinstance(request, MeasureRequest)
    assert (request.scene_id, request.attempt, request.t) == (scene, 1, 0.25)
    assert request.points == ((10, 40), (20.5, 40))
    assert request.pose == OrbitPose(yaw_deg=5, pitch_deg=0, zoom=1)
    assert request.camera == IntrinsicsOverride(width=120, height=96)
    found = Measurement.model_validate(answer.json())
    assert found == measured_flat(request)
    assert found.distance is not None
    assert found.distance.distance_mm == pytest.approx(10.5 / 2)  # half a millimetre a pixel
    assert "Research use only" in answer.json()["notice"]


def test_a_shape_of_points_is_asked_of_the_worker_and_comes_with_its_unit(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    asked = {"points": "10,20;20,20;20,30;10,30", "shape": "area"}
    found = Measurement.model_validate(service.http.get(f"/scenes/{scene}/measure", params=asked).json())
    (request,) = service.painter.requests
    assert isinstance(request, MeasureRequest)
    assert request.shape == "area"
    assert found == measured_flat(request)
    assert found.shape is not None
    assert found.shape.unit == "mm2"
    plain = request.model_copy(update={"shape": None})
    assert "shape" not in plain.model_dump_json()  # older workers do not know it


def test_a_point_that_is_refused_says_why_by_a_code(service: ServiceUnderTest) -> None:
    answer = service.http.get(f"/scenes/{service.finished_scene()}/measure", params={"points": "10,12;55,12"})
    assert answer.status_code == 200
    document = answer.json()
    assert document["distance"] is None
    assert [each["refusal"] and each["refusal"]["code"] for each in document["points"]] == [None, "low_confidence"]
    assert document["points"][1]["refusal"]["field"] == "points[1]"


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ({}, "points"),
        ({"points": "1"}, "points"),
        ({"points": "1,2", "shape": "line"}, "points"),
        ({"points": "1,2;3,4", "shape": "circle"}, "shape"),
        ({"points": "1,2", "t": -1}, "t"),
        ({"points": "1,2", "pose": "orbit:1"}, "pose"),
        ({"points": "1,2", "width": 4}, "width"),
        ({"points": "1,2", "point": "1,2"}, "point"),
    ],
)
def test_a_question_that_cannot_be_answered_names_its_field(
    service: ServiceUnderTest, query: dict[str, object], field: str
) -> None:
    assert_problem(service.http.get(f"/scenes/{service.finished_scene()}/measure", params=query), 422, field)
    assert service.painter.requests == []


def test_nothing_is_measured_in_a_job_that_trains(service: ServiceUnderTest) -> None:
    job_id = service.running_job()
    assert_problem(service.http.get(f"/scenes/{job_id}/measure", params={"points": "1,2"}), 409, "scene")


def test_measuring_needs_the_scope_view_and_ones_own_scene(service: ServiceUnderTest) -> None:
    scene = service.finished_scene()
    path, asked = f"/scenes/{scene}/measure", {"points": "1,2"}
    assert_problem(service.http.get(path, params=asked, headers=bearer(service, "another")), 404, "scene")
    without = bearer(service, "default", {KeyScope.RECONSTRUCT})
    assert service.http.get(path, params=asked, headers=without).status_code == 403
