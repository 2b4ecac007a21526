"""Uploads in pieces: every offset that was answered is on disk, and a finished upload becomes at most one job."""

from __future__ import annotations

import base64
import fcntl
import hashlib
from collections.abc import Mapping
from pathlib import Path

import httpx
import pytest

from contract.store.shelf import is_job_id
from contract.store.store import Store
from service.partial import promised_bytes
from tests.intrasplat.clip.hostile import CALIBRATION
from tests.service.under_test import CLIP, EMPTY_ZIP, ServiceUnderTest, another_clip, assert_problem, running_service

TUS = {"Tus-Resumable": "1.0.0"}
BYTES = {**TUS, "Content-Type": "application/offset+octet-stream"}


def metadata(**values: str) -> str:
    return ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in values.items())


def create(service: ServiceUnderTest, length: int = len(CLIP), part: str = "clip", **values: str) -> httpx.Response:
    text = metadata(part=part, **(values or {"suffix": ".mp4"}))
    return service.http.post("/uploads", headers={**TUS, "Upload-Length": str(length), "Upload-Metadata": text})


def send(
    service: ServiceUnderTest, path: str, offset: int, piece: bytes, headers: Mapping[str, str] = BYTES
) -> httpx.Response:
    return service.http.request("PATCH", path, content=piece, headers={**headers, "Upload-Offset": str(offset)})


def offset_of(service: ServiceUnderTest, path: str) -> int:
    response = service.http.request("HEAD", path, headers=TUS)
    assert response.status_code == 200
    assert response.headers["cache-control"] == "no-store"
    return int(response.headers["upload-offset"])


def uploaded(service: ServiceUnderTest, content: bytes = CLIP, part: str = "clip", suffix: str = ".mp4") -> str:
    path = create(service, len(content), part, suffix=suffix).headers["location"]
    assert send(service, path, 0, content).status_code == 204
    return path.rpartition("/")[2]


def test_an_upload_in_pieces_becomes_a_job_with_the_very_bytes(service: ServiceUnderTest) -> None:
    created = create(service)
    assert created.status_code == 201
    path = created.headers["location"]
    middle = len(CLIP) // 2
    assert send(service, path, 0, CLIP[:middle]).headers["upload-offset"] == str(middle)
    assert offset_of(service, path) == middle
    assert send(service, path, middle, CLIP[middle:]).headers["upload-offset"] == str(len(CLIP))
    submission = {"clip": path.rpartition("/")[2], "options": {"budget_s": 20}}
    job = service.http.post("/reconstruct", json=submission)
    assert job.status_code == 202, job.text
    assert job.headers["location"] == f"/jobs/{job.json()['id']}"
    record = service.queue.get(job.json()["id"])
    assert record is not None
    assert record.input_sha256 == hashlib.sha256(CLIP).hexdigest()
    assert record.options.budget_s == 20
    assert (service.store.spool_folder(record.job_id) / "clip.mp4").read_bytes() == CLIP


def test_offsets_survive_a_restart_of_the_service(tmp_path: Path) -> None:
    for service in running_service(tmp_path):
        path = create(service).headers["location"]
        send(service, path, 0, CLIP[:100])
    for service in running_service(tmp_path):
        assert offset_of(service, path) == 100
        assert send(service, path, 100, CLIP[100:]).status_code == 204


def test_a_piece_at_another_offset_is_refused_and_the_right_one_named(service: ServiceUnderTest) -> None:
    path = create(service).headers["location"]
    send(service, path, 0, CLIP[:10])
    refused = send(service, path, 0, CLIP[:10])
    assert_problem(refused, 409, "Upload-Offset")
    assert refused.headers["upload-offset"] == "10"
    assert offset_of(service, path) == 10


def test_more_than_was_announced_is_refused(service: ServiceUnderTest) -> None:
    path = create(service, length=10).headers["location"]
    assert_problem(send(service, path, 0, b"x" * 11), 413, "Upload-Length")
    assert offset_of(service, path) == 0


def test_two_requests_never_write_to_one_upload(service: ServiceUnderTest) -> None:
    path = create(service).headers["location"]
    (file,) = (service.store.data_dir / "incoming" / path.rpartition("/")[2]).glob("clip.mp4")
    with file.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert_problem(send(service, path, 0, CLIP), 423, "upload_id")
    assert send(service, path, 0, CLIP).status_code == 204


@pytest.mark.parametrize("headers", [{}, {"Tus-Resumable": "0.2.2"}])
def test_another_version_of_the_protocol_is_refused_with_the_one_spoken(
    service: ServiceUnderTest, headers: dict[str, str]
) -> None:
    refused = service.http.post("/uploads", headers={**headers, "Upload-Length": "5", "Upload-Metadata": ""})
    assert_problem(refused, 412, "Tus-Resumable")
    assert refused.headers["tus-version"] == "1.0.0"
    assert refused.headers["tus-resumable"] == "1.0.0"


def test_a_piece_of_another_content_type_is_refused(service: ServiceUnderTest) -> None:
    path = create(service).headers["location"]
    assert_problem(send(service, path, 0, CLIP, {**TUS, "Content-Type": "video/mp4"}), 415, "Content-Type")


@pytest.mark.parametrize(
    ("text", "status"),
    [
        ("part !", 400),
        (metadata(part="passwd", suffix=".mp4"), 422),
        (metadata(part="clip", suffix=".exe"), 422),
        (metadata(part="clip"), 422),
        ("", 422),
    ],
)
def test_metadata_that_cannot_be_meant_is_refused(service: ServiceUnderTest, text: str, status: int) -> None:
    refused = service.http.post("/uploads", headers={**TUS, "Upload-Length": "5", "Upload-Metadata": text})
    assert assert_problem(refused, status, refused.json()["field"])["remedy"]
    assert service.spooled() == []


def test_of_a_file_name_the_ending_alone_is_kept(service: ServiceUnderTest) -> None:
    assert create(service, filename="Smith_Jane.MOV").status_code == 201
    (folder,) = service.spooled()
    assert sorted(path.name for path in folder.iterdir()) == ["clip.mov", "upload.json"]
    assert "Smith" not in (folder / "upload.json").read_text()


@pytest.mark.parametrize("length", ["0", "-1", "many", None])
def test_a_length_that_cannot_be_meant_is_refused(service: ServiceUnderTest, length: str | None) -> None:
    headers = {**TUS, "Upload-Metadata": metadata(part="clip", suffix=".mp4")}
    refused = service.http.post("/uploads", headers=headers | ({} if length is None else {"Upload-Length": length}))
    assert_problem(refused, 422, "upload-length")


def test_what_is_too_large_is_refused_before_a_byte_is_sent(tmp_path: Path) -> None:
    for service in running_service(tmp_path, max_upload_bytes=1000):
        assert_problem(create(service, length=1001), 413, "clip")
        assert service.spooled() == []


def test_room_on_disk_is_kept_for_what_was_announced(tmp_path: Path) -> None:
    for service in running_service(tmp_path, max_upload_bytes=2**62):
        most_of_it = service.store.free_bytes() * 3 // 4
        path = create(service, length=most_of_it).headers["location"]
        assert promised_bytes(service.store) == most_of_it
        assert_problem(create(service, length=most_of_it), 507)
        assert service.http.request("DELETE", path, headers=TUS).status_code == 204
        assert create(service, length=most_of_it).status_code == 201


def test_of_finished_uploads_no_job_is_made_on_a_full_disk_and_they_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for service in running_service(tmp_path, min_free_bytes=1):
        submission = {"clip": uploaded(service)}
        with monkeypatch.context() as disk:
            disk.setattr(Store, "free_bytes", lambda store: 0)
            assert assert_problem(service.http.post("/reconstruct", json=submission), 507)["code"] == "store_full"
        assert service.store.spooled_ids() == []
        assert service.http.post("/reconstruct", json=submission).status_code == 202


def test_an_upload_given_up_is_gone(service: ServiceUnderTest) -> None:
    path = create(service).headers["location"]
    deleted = service.http.request("DELETE", path, headers=TUS)
    assert deleted.status_code == 204
    assert deleted.headers["tus-resumable"] == "1.0.0"
    assert service.http.request("HEAD", path, headers=TUS).status_code == 404
    assert_problem(send(service, path, 0, CLIP), 404, "upload_id")
    assert service.spooled() == []


def test_the_server_describes_what_it_speaks(service: ServiceUnderTest) -> None:
    response = service.http.request("OPTIONS", "/uploads")
    assert response.status_code == 204
    assert response.headers["tus-version"] == "1.0.0"
    assert response.headers["tus-extension"] == "creation,termination"
    assert int(response.headers["tus-max-size"]) > 0


def test_two_eyes_and_a_calibration_come_as_three_uploads(service: ServiceUnderTest) -> None:
    ids = {
        "left": uploaded(service, CLIP, "left", ".mov"),
        "right": uploaded(service, CLIP, "right", ".mov"),
        "calibration": uploaded(service, CALIBRATION, "calibration", ".json"),
    }
    job = service.http.post("/reconstruct", json=ids)
    assert job.status_code == 202
    folder = service.store.spool_folder(job.json()["id"])
    assert {path.name for path in folder.iterdir()} >= {"left.mov", "right.mov", "calibration.json"}


@pytest.mark.parametrize("content", [b"K: 1", CALIBRATION[:-9]])
def test_a_calibration_that_cannot_be_read_makes_no_job(service: ServiceUnderTest, content: bytes) -> None:
    ids = {"clip": uploaded(service, CLIP), "calibration": uploaded(service, content, "calibration", ".json")}
    assert_problem(service.http.post("/reconstruct", json=ids), 422, "calibration")
    assert service.queue.records() == []
    better = ids | {"calibration": uploaded(service, CALIBRATION, "calibration", ".json")}
    assert service.http.post("/reconstruct", json=better).status_code == 202  # the clip need not come again


def test_the_same_clip_has_the_same_digest_whichever_way_it_came(service: ServiceUnderTest) -> None:
    files = {"right": another_clip(b"right"), "left": CLIP, "calibration": CALIBRATION}
    suffixes = {"calibration": ".json"}
    parts = {part: (f"x{suffixes.get(part, '.mp4')}", files[part]) for part in sorted(files)}
    whole = service.queue.get(service.upload(parts=parts).json()["id"])
    ids = {part: uploaded(service, files[part], part, suffixes.get(part, ".mp4")) for part in files}
    pieces = service.queue.get(service.http.post("/reconstruct", json=ids).json()["id"])
    assert whole is not None
    assert pieces is not None
    assert whole.input_sha256 == pieces.input_sha256


def test_an_upload_becomes_one_job_however_often_it_is_submitted(service: ServiceUnderTest) -> None:
    submission = {"clip": uploaded(service), "options": {"seed": 3}}
    first = service.http.post("/reconstruct", json=submission).json()["id"]
    assert service.http.post("/reconstruct", json=submission).json()["id"] == first
    other = service.http.post("/reconstruct", json={**submission, "options": {"seed": 4}})
    assert assert_problem(other, 409, "clip")["job_id"] == first
    assert len(service.queue.records()) == 1
    assert offset_of(service, f"/uploads/{submission['clip']}") == len(CLIP)
    assert_problem(send(service, f"/uploads/{submission['clip']}", len(CLIP), b""), 409, "upload_id")


def test_of_an_upload_that_is_in_use_no_job_is_made(service: ServiceUnderTest) -> None:
    upload_id = uploaded(service)
    with (service.store.incoming_folder(upload_id) / "clip.mp4").open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        refused = service.http.post("/reconstruct", json={"clip": upload_id})
        assert_problem(refused, 423, "upload")
        assert refused.headers["retry-after"]
    assert service.queue.records() == []
    assert service.http.post("/reconstruct", json={"clip": upload_id}).status_code == 202


def test_submissions_that_name_no_finished_upload_of_that_part_are_refused(service: ServiceUnderTest) -> None:
    unfinished = create(service).headers["location"].rpartition("/")[2]
    assert_problem(service.http.post("/reconstruct", json={"clip": unfinished}), 409, "clip")
    assert_problem(service.http.post("/reconstruct", json={"clip": "0" * 32}), 422, "clip")
    assert_problem(service.http.post("/reconstruct", json={"clip": "../../etc/passwd"}), 422, "clip")
    masks = uploaded(service, EMPTY_ZIP, "masks", ".zip")
    assert_problem(service.http.post("/reconstruct", json={"clip": masks}), 422, "clip")
    assert_problem(service.http.post("/reconstruct", json={"masks": masks}), 422, "clip")
    assert_problem(service.http.post("/reconstruct", json={"clip": unfinished, "passwd": "x"}), 422, "passwd")
    assert_problem(
        service.http.post("/reconstruct", json={"clip": unfinished, "options": {"seed": "x"}}), 422, "options.seed"
    )
    assert service.queue.records() == []


@pytest.mark.parametrize(
    ("body", "status"), [(b"{", 400), (b"[]", 422), (b"", 400), (b"\xff", 400), (b"{}" * 10**5, 413)]
)
def test_a_body_that_is_no_submission_is_a_problem(service: ServiceUnderTest, body: bytes, status: int) -> None:
    response = service.http.post("/reconstruct", content=body, headers={"Content-Type": "application/json"})
    assert response.status_code == status
    assert response.headers["content-type"] == "application/problem+json"


def test_only_so_many_uploads_may_be_open(service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.tus.MAX_OPEN_UPLOADS", 2)
    assert [create(service).status_code for _ in range(3)] == [201, 201, 429]
    assert all(is_job_id(folder.name) for folder in service.spooled())


def test_an_accepted_upload_outlives_a_queue_that_forgot_its_job_and_is_full(tmp_path: Path) -> None:
    for service in running_service(tmp_path, max_queued=1):
        upload_id = uploaded(service)
        job_id = service.http.post("/reconstruct", json={"clip": upload_id}).json()["id"]
        service.queue.cancel(job_id)
        service.queue.forget(job_id)  # as a server does that was started on an empty disk
        assert service.upload().status_code == 202  # and fills the queue
        again = service.http.post("/reconstruct", json={"clip": upload_id})
        assert (again.status_code, again.json()["id"]) == (202, job_id)
        assert service.store.submission(job_id) is not None
