"""Around the routes: what does not exist, who is let in, how the API describes itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.service.house import House, assert_problem, make_house


@pytest.mark.parametrize(("method", "path", "status"), [("GET", "/nothing", 404), ("PUT", "/jobs", 405)])
def test_what_does_not_exist_is_a_problem_too(house: House, method: str, path: str, status: int) -> None:
    assert_problem(house.http.request(method, path), status)


@pytest.mark.parametrize(
    "headers",
    [{"host": "evil.example"}, {"host": "["}, {"origin": "https://evil.example"}, {"origin": "http://["}],
)
def test_foreign_pages_and_names_are_refused(house: House, headers: dict[str, str]) -> None:
    assert house.http.post("/reconstruct", headers=headers).status_code == 403
    assert house.http.get("/jobs", headers=headers).status_code == 403


def test_the_page_itself_may_use_the_service_and_nothing_from_elsewhere_may_run(house: House) -> None:
    response = house.http.get("/jobs", headers={"origin": "http://127.0.0.1:8765"})
    assert response.status_code == 200
    assert "default-src 'none'" in response.headers["content-security-policy"]
    assert response.headers["x-content-type-options"] == "nosniff"


def test_the_api_describes_itself_with_stable_operation_ids(house: House) -> None:
    document = house.http.get("/openapi.json").json()
    operations = {each["operationId"] for path in document["paths"].values() for each in path.values()}
    assert operations == {
        "reconstruct",
        "list_jobs",
        "get_job",
        "cancel_job",
        "render",
        "list_scenes",
        "get_scene",
        "get_curve",
        "export_scene",
        "delete_scene",
        "healthz",
        "readyz",
        "info",
    }
    assert "Not a medical device" in house.http.get("/info").json()["notice"]


def test_the_dashboard_is_served_at_the_root(tmp_path: Path) -> None:
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "index.html").write_text("<!doctype html><title>intrasplat</title>")
    for house in make_house(tmp_path / "data", dashboard_dir=folder):
        assert "intrasplat" in house.http.get("/").text
        assert house.http.get("/jobs").json() == []
        assert_problem(house.http.get("/nothing.js"), 404)
