"""Around the routes: what does not exist, who is let in, how the API describes itself."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from contract.queue.embedded import short_socket_path
from contract.wire.rendering import WorkerAddress
from intrasplat.errors import UnavailableError
from tests.service.under_test import ServiceUnderTest, assert_problem, bearer, running_service


@pytest.mark.parametrize("has_page", [False, True])
def test_what_does_not_exist_is_a_problem_that_names_what_does(tmp_path: Path, has_page: bool) -> None:
    page = tmp_path / "page"
    page.mkdir()
    (page / "index.html").write_text("<!doctype html><title>intrasplat</title>")
    for service in running_service(tmp_path / "data", dashboard_dir=page if has_page else None):
        assert_problem(service.http.get("/nothing"), 404)
        job = f"/jobs/{service.upload().json()['id']}"
        for method, path, allowed, named in (
            ("PUT", "/jobs", "GET, HEAD", "GET /jobs (list_jobs)"),
            ("GET", "/reconstruct", "POST", "POST /reconstruct (reconstruct)"),
            ("POST", job, "DELETE, GET, HEAD, PATCH", "DELETE /jobs/{job_id} (cancel_job)"),
        ):
            response = service.http.request(method, path)
            assert named in assert_problem(response, 405)["remedy"]
            assert response.headers["allow"] == allowed
        remedy = assert_problem(service.http.post(f"{job}/cancel"), 404)["remedy"]
        assert remedy.startswith("There is DELETE /jobs/{job_id} (cancel_job).")
        assert "GET /jobs/{job_id} (get_job)" in assert_problem(service.http.get(f"{job}/nothing"), 404)["remedy"]


@pytest.mark.parametrize(
    "headers",
    [{"host": "evil.example"}, {"host": "["}, {"origin": "https://evil.example"}, {"origin": "http://["}],
)
def test_foreign_pages_and_names_are_refused(service: ServiceUnderTest, headers: dict[str, str]) -> None:
    assert service.http.post("/reconstruct", headers=headers).status_code == 403
    assert service.http.get("/jobs", headers=headers).status_code == 403


def test_the_page_itself_may_use_the_service_and_nothing_from_elsewhere_may_run(service: ServiceUnderTest) -> None:
    response = service.http.get("/jobs", headers={"origin": "http://127.0.0.1:8765"})
    assert response.status_code == 200
    assert "default-src 'none'" in response.headers["content-security-policy"]
    assert response.headers["x-content-type-options"] == "nosniff"


OPERATIONS = {
    *("reconstruct", "check_clip", "list_jobs", "get_job", "label_job", "cancel_job", "retry_job", "watch_job"),
    "list_deliveries",
    "list_exports",
    "send_again",
    *("describe_uploads", "create_upload", "get_upload", "append_to_upload", "delete_upload"),
    *(
        "render",
        "list_scenes",
        "get_scene",
        "get_curve",
        "get_masks",
        "get_recorded",
        "get_cameras",
        "list_exports",
        "export_scene",
        "measure",
        "purge_scene",
    ),
    *("get_file", "get_thumbnail", "import_scene", "get_key"),
    *("open_feed", "list_feeds", "get_feed", "watch_feed", "pause_feed", "resume_feed", "end_feed"),
    *("cut_feed", "push_video"),
    *("healthz", "readyz", "info", "metrics"),
}
"""What clients are generated from: renaming or removing one breaks them."""


def test_the_api_describes_itself_with_stable_operation_ids(service: ServiceUnderTest) -> None:
    document = service.http.get("/openapi.json").json()
    operations = [each for path in document["paths"].values() for each in path.values()]
    assert {each["operationId"] for each in operations} == OPERATIONS
    problem = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    assert all(each["responses"]["default"]["content"] == problem for each in operations)
    assert all(each["description"] for each in operations)
    assert document["components"]["schemas"]["JobView"]["examples"]
    assert "HTTPValidationError" not in document["components"]["schemas"]


def test_the_api_describes_every_choice_of_a_render_and_of_a_reconstruction(service: ServiceUnderTest) -> None:
    document = service.http.get("/openapi.json").json()
    paths = document["paths"]
    render = {each["name"]: each for each in paths["/render"]["get"]["parameters"] if each["in"] == "query"}
    options = document["components"]["schemas"]["JobOptions"]["properties"]
    assert {"unseen", "highlights"} <= render.keys()
    assert "eyes" in options
    for name, described in (render | options).items():
        assert len(described["description"].split()) >= 3, name


def test_the_service_tells_its_limits_in_numbers(service: ServiceUnderTest) -> None:
    info = service.http.get("/info").json()
    assert "Not a medical device" in info["notice"]
    limits = info["limits"]
    assert limits["max_frames"] == 1000
    assert limits["retention_hours"] is None
    numbers = [value for name, value in limits.items() if "retention" not in name]
    assert all(isinstance(value, int | float) for value in numbers)


def test_every_answer_has_an_id_and_a_safe_one_that_was_given_is_kept(service: ServiceUnderTest) -> None:
    given = "4bf92f35-77b3-4da6-a3ce-929d0e0e4736"
    assert service.http.get("/jobs", headers={"X-Request-Id": given}).headers["x-request-id"] == given
    for unsafe in ("Smith", "a b", "x" * 100, "<script>"):
        made = service.http.get("/nothing", headers={"X-Request-Id": unsafe}).headers["x-request-id"]
        assert unsafe not in made
        assert len(made) == 32
    assert service.http.get("/jobs", headers={"host": "evil.example"}).headers["x-request-id"]


def test_an_unforeseen_error_is_a_problem_that_tells_nothing(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("patient Smith")

    monkeypatch.setattr(service.queue, "workers", broken)
    response = service.http.get("/readyz")
    assert "X-Request-Id" in assert_problem(response, 500)["remedy"]
    assert "Smith" not in response.text
    assert response.headers["x-request-id"]


@pytest.mark.parametrize("length", ["-1", "ten", "1e3", "9" * 30])
def test_a_length_that_is_none_is_a_problem(service: ServiceUnderTest, length: str) -> None:
    headers = {"content-length": length, "content-type": "multipart/form-data; boundary=x"}
    assert_problem(service.http.post("/reconstruct", content=b"", headers=headers), 400, "Content-Length")


def test_the_service_is_not_ready_without_queue_worker_or_room(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert service.http.get("/readyz").json()["ready"] is True

    def away() -> list[WorkerAddress]:
        raise UnavailableError("The queue does not answer.", "Start it.")

    (worker,) = service.queue.workers()
    service.queue.announce(worker.model_copy(update={"renders_only": True}))
    assert "only render" in assert_problem(service.http.get("/readyz"), 503, "worker")["detail"]
    service.queue.withdraw("worker-1")
    assert_problem(service.http.get("/readyz"), 503, "worker")
    monkeypatch.setattr(service.queue, "workers", away)
    assert_problem(service.http.get("/readyz"), 503, "queue")
    assert service.http.get("/healthz").json() == {"alive": True}


def test_the_service_is_not_ready_as_soon_as_its_only_worker_has_died(
    service: ServiceUnderTest, tmp_path: Path
) -> None:
    (worker,) = service.queue.workers()
    nobody = f"ipc://{short_socket_path(tmp_path, 'nobody.sock')}"
    service.queue.announce(worker.model_copy(update={"endpoint": nobody}))  # which lasts for WORKER_TTL_S
    began_s = time.monotonic()
    assert_problem(service.http.get("/readyz"), 503, "worker")
    assert time.monotonic() - began_s < 1.0


def test_who_has_no_key_hears_no_names_of_workers_nor_how_full_the_disk_is(tmp_path: Path) -> None:
    for service in running_service(tmp_path, host="0.0.0.0", hosts=("127.0.0.1",)):
        told = service.http.get("/readyz").json()
        assert (told["ready"], told["devices"], told["workers"], told["free_bytes"]) == (True, ["cpu"], None, None)
        told = service.http.get("/readyz", headers=bearer(service, "ward-3")).json()
        assert told["workers"] == ["worker-1"]
        assert told["free_bytes"] > 0


def test_the_dashboard_is_served_at_the_root(tmp_path: Path) -> None:
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "index.html").write_text("<!doctype html><title>intrasplat</title>")
    for service in running_service(tmp_path / "data", dashboard_dir=folder):
        assert "intrasplat" in service.http.get("/").text
        assert service.http.get("/jobs").json() == []
        assert_problem(service.http.get("/nothing.js"), 404)


def script_of_page(service: ServiceUnderTest, path: str = "/") -> str:
    index = service.http.get(path)
    assert index.headers["Cache-Control"] == "no-cache"
    return "/" + index.text.split('src="')[1].split('"')[0]


def test_the_dashboards_files_are_compressed_and_cached_under_an_address_that_changes_with_them(tmp_path: Path) -> None:
    folder = tmp_path / "page"
    (folder / "parts").mkdir(parents=True)
    (folder / "index.html").write_text('<script type="module" src="parts/main.js"></script><a href="./live.html">')
    (folder / "live.html").write_text('<script type="module" src="parts/main.js"></script><a href="./index.html">')
    script = folder / "parts" / "main.js"
    script.write_text("first();" + " " * 2000)
    for service in running_service(tmp_path / "data", dashboard_dir=folder):
        address = script_of_page(service)
        assert script_of_page(service, "/live.html") == script_of_page(service, "/index.html") == address
        answer = service.http.get(address)
        assert "first();" in answer.text
        assert "immutable" in answer.headers["Cache-Control"]
        assert answer.headers["Content-Encoding"] == "gzip"
        script.write_text("second();")
        assert script_of_page(service) != address
        late = service.http.get(address)  # of a page that was loaded before
        assert "second();" in late.text
        assert late.headers["Cache-Control"] == "no-store"
        assert service.http.get("/parts/main.js").headers["Cache-Control"] == "no-store"
        assert 'href="./live.html"' in service.http.get("/").text
        assert_problem(service.http.get("/v/0/../../data"), 404)


@pytest.mark.parametrize("source", ['export * from "./b.js";', 'import { gone } from "./gone.js";', b"\xff"])
def test_scripts_that_cannot_be_joined_are_served_as_written(
    tmp_path: Path, source: str | bytes, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "index.html").write_text('<script type="module" src="main.js"></script>')
    (folder / "live.html").write_text('<script type="module" src="live.js"></script>')
    live = 'import { b } from "./b.js";\nb();\n'
    (folder / "live.js").write_text(live)
    (folder / "b.js").write_text("export const b = () => {};\n")
    content = source if isinstance(source, bytes) else source.encode()
    (folder / "main.js").write_bytes(content)
    for service in running_service(tmp_path / "data", dashboard_dir=folder):
        answer = service.http.get(script_of_page(service))
        assert (answer.status_code, answer.content) == (200, content)
        assert service.http.get(script_of_page(service, "/live.html")).text == live
        assert [each.getMessage() for each in caplog.records if "as they were written" in each.getMessage()] != []
        (folder / "main.js").write_text("mended();")
        assert "mended();" in service.http.get(script_of_page(service)).text
        assert "import {" not in service.http.get(script_of_page(service, "/live.html")).text


@pytest.mark.parametrize(
    ("path", "field", "remedy"),
    [
        ("/render?scene=SCENE&layers=depth", "layers", "Did you mean layer?"),
        ("/render?scene=SCENE&t=0.2&t=0.3", "t", "Send it once."),
        ("/jobs?stat=done", "stat", "Did you mean state?"),
        ("/jobs/SCENE?verbose=1", "verbose", "Leave it out."),
        ("/scenes/SCENE/export?fromat=splat", "fromat", "Did you mean format?"),
    ],
)
def test_a_query_name_that_is_unknown_or_comes_twice_is_refused(
    service: ServiceUnderTest, path: str, field: str, remedy: str
) -> None:
    scene = service.finished_scene()
    problem = assert_problem(service.http.get(path.replace("SCENE", scene)), 422, field)
    assert problem["remedy"].startswith(remedy)


def test_head_is_answered_wherever_get_is_with_its_headers_and_without_a_body(service: ServiceUnderTest) -> None:
    scene, job = service.finished_scene(), service.upload().json()["id"]
    paths = ["/healthz", "/readyz", "/info", "/jobs", f"/jobs/{job}", f"/jobs/{job}/events", "/scenes", "/nowhere"]
    paths += [f"/scenes/{scene}", f"/scenes/{scene}/export?format=ply", f"/render?scene={scene}", "/openapi.json"]
    for path in paths:
        head = service.http.request("HEAD", path, timeout=5)
        assert head.content == b"", path
        if not path.endswith("/events"):  # which GET would go on to tell
            get = service.http.get(path)
            assert head.status_code == get.status_code, path
            assert head.headers.get("content-type") == get.headers.get("content-type"), path
            assert head.headers.get("content-length") == get.headers.get("content-length"), path
        else:
            assert head.status_code == 200
    assert service.http.request("HEAD", "/reconstruct").status_code == 405


@pytest.mark.parametrize(
    ("layer", "format", "unit"),
    [("depth", "png", "0.01 mm"), ("depth", "npy", "mm"), ("depth", "jpeg", None), ("rgb", "png", None)],
)
def test_a_render_of_depth_tells_its_unit(service: ServiceUnderTest, layer: str, format: str, unit: str | None) -> None:
    scene = service.finished_scene()
    response = service.http.get("/render", params={"scene": scene, "layer": layer, "format": format})
    assert response.headers.get("X-Intrasplat-Depth-Unit") == unit


@pytest.mark.parametrize(("format", "expected"), [("jpeg", "41 78"), ("png", None)])
def test_depth_in_false_colours_tells_between_which_depths(
    service: ServiceUnderTest, format: str, expected: str | None
) -> None:
    scene = service.finished_scene()
    response = service.http.get("/render", params={"scene": scene, "layer": "depth", "format": format})
    assert response.headers.get("X-Intrasplat-Depth-Range-Mm") == expected
    (plain,) = service.painter.requests
    assert "near_mm" not in plain.model_dump_json()  # older workers do not know it
    chosen = {"scene": scene, "layer": "depth", "format": format, "near_mm": 50, "far_mm": 90}
    assert service.http.get("/render", params=chosen).status_code == 200
    assert (service.painter.requests[1].near_mm, service.painter.requests[1].far_mm) == (50, 90)
    assert_problem(service.http.get("/render", params={**chosen, "near_mm": 0}), 422, "near_mm")
    assert_problem(service.http.get("/render", params={**chosen, "near_mm": 90}), 422, "far_mm")
