"""Uploads in pieces: every offset that was answered is on disk, and a finished upload becomes at most one job."""

from __future__ import annotations

import base64
import fcntl
import hashlib
from collections.abc import Mapping
from pathlib import Path

import httpx
import pytest

from contract.store.store import is_job_id
from service.partial import promised_bytes
from tests.service.house import CLIP, EMPTY_ZIP, House, another_clip, assert_problem, make_house

TUS = {"Tus-Resumable": "1.0.0"}
BYTES = {**TUS, "Content-Type": "application/offset+octet-stream"}


def metadata(**values: str) -> str:
    return ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in values.items())


def create(house: House, length: int = len(CLIP), part: str = "clip", **values: str) -> httpx.Response:
    text = metadata(part=part, **(values or {"suffix": ".mp4"}))
    return house.http.post("/uploads", headers={**TUS, "Upload-Length": str(length), "Upload-Metadata": text})


def send(house: House, path: str, offset: int, piece: bytes, headers: Mapping[str, str] = BYTES) -> httpx.Response:
    return house.http.request("PATCH", path, content=piece, headers={**headers, "Upload-Offset": str(offset)})


def offset_of(house: House, path: str) -> int:
    response = house.http.request("HEAD", path, headers=TUS)
    assert response.status_code == 200
    assert response.headers["cache-control"] == "no-store"
    return int(response.headers["upload-offset"])


def uploaded(house: House, content: bytes = CLIP, part: str = "clip", suffix: str = ".mp4") -> str:
    path = create(house, len(content), part, suffix=suffix).headers["location"]
    assert send(house, path, 0, content).status_code == 204
    return path.rpartition("/")[2]


def test_an_upload_in_pieces_becomes_a_job_with_the_very_bytes(house: House) -> None:
    created = create(house)
    assert created.status_code == 201
    path = created.headers["location"]
    middle = len(CLIP) // 2
    assert send(house, path, 0, CLIP[:middle]).headers["upload-offset"] == str(middle)
    assert offset_of(house, path) == middle
    assert send(house, path, middle, CLIP[middle:]).headers["upload-offset"] == str(len(CLIP))
    submission = {"clip": path.rpartition("/")[2], "options": {"budget_s": 20}}
    job = house.http.post("/reconstruct", json=submission)
    assert job.status_code == 202, job.text
    assert job.headers["location"] == f"/jobs/{job.json()['id']}"
    record = house.queue.get(job.json()["id"])
    assert record is not None
    assert record.input_sha256 == hashlib.sha256(CLIP).hexdigest()
    assert record.options.budget_s == 20
    assert (house.store.spool_folder(record.job_id) / "clip.mp4").read_bytes() == CLIP


def test_offsets_survive_a_restart_of_the_service(tmp_path: Path) -> None:
    for house in make_house(tmp_path):
        path = create(house).headers["location"]
        send(house, path, 0, CLIP[:100])
    for house in make_house(tmp_path):
        assert offset_of(house, path) == 100
        assert send(house, path, 100, CLIP[100:]).status_code == 204


def test_a_piece_at_another_offset_is_refused_and_the_right_one_named(house: House) -> None:
    path = create(house).headers["location"]
    send(house, path, 0, CLIP[:10])
    refused = send(house, path, 0, CLIP[:10])
    assert_problem(refused, 409, "Upload-Offset")
    assert refused.headers["upload-offset"] == "10"
    assert offset_of(house, path) == 10


def test_more_than_was_announced_is_refused(house: House) -> None:
    path = create(house, length=10).headers["location"]
    assert_problem(send(house, path, 0, b"x" * 11), 413, "Upload-Length")
    assert offset_of(house, path) == 0


def test_two_requests_never_write_to_one_upload(house: House) -> None:
    path = create(house).headers["location"]
    (file,) = (house.store.data_dir / "incoming" / path.rpartition("/")[2]).glob("clip.mp4")
    with file.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert_problem(send(house, path, 0, CLIP), 423)
    assert send(house, path, 0, CLIP).status_code == 204


@pytest.mark.parametrize("headers", [{}, {"Tus-Resumable": "0.2.2"}])
def test_another_version_of_the_protocol_is_refused_with_the_one_spoken(house: House, headers: dict[str, str]) -> None:
    refused = house.http.post("/uploads", headers={**headers, "Upload-Length": "5", "Upload-Metadata": ""})
    assert_problem(refused, 412, "Tus-Resumable")
    assert refused.headers["tus-version"] == "1.0.0"
    assert refused.headers["tus-resumable"] == "1.0.0"


def test_a_piece_of_another_content_type_is_refused(house: House) -> None:
    path = create(house).headers["location"]
    assert_problem(send(house, path, 0, CLIP, {**TUS, "Content-Type": "video/mp4"}), 415, "Content-Type")


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
def test_metadata_that_cannot_be_meant_is_refused(house: House, text: str, status: int) -> None:
    refused = house.http.post("/uploads", headers={**TUS, "Upload-Length": "5", "Upload-Metadata": text})
    assert assert_problem(refused, status, refused.json()["field"])["remedy"]
    assert house.spooled() == []


def test_of_a_file_name_the_ending_alone_is_kept(house: House) -> None:
    assert create(house, filename="Smith_Jane.MOV").status_code == 201
    (folder,) = house.spooled()
    assert sorted(path.name for path in folder.iterdir()) == ["clip.mov", "upload.json"]
    assert "Smith" not in (folder / "upload.json").read_text()


@pytest.mark.parametrize("length", ["0", "-1", "many", None])
def test_a_length_that_cannot_be_meant_is_refused(house: House, length: str | None) -> None:
    headers = {**TUS, "Upload-Metadata": metadata(part="clip", suffix=".mp4")}
    refused = house.http.post("/uploads", headers=headers | ({} if length is None else {"Upload-Length": length}))
    assert_problem(refused, 422, "upload-length")


def test_what_is_too_large_is_refused_before_a_byte_is_sent(tmp_path: Path) -> None:
    for house in make_house(tmp_path, max_upload_bytes=1000):
        assert_problem(create(house, length=1001), 413, "clip")
        assert house.spooled() == []


def test_room_on_disk_is_kept_for_what_was_announced(tmp_path: Path) -> None:
    for house in make_house(tmp_path, max_upload_bytes=2**62):
        most_of_it = house.store.free_bytes() * 3 // 4
        path = create(house, length=most_of_it).headers["location"]
        assert promised_bytes(house.store) == most_of_it
        assert_problem(create(house, length=most_of_it), 507)
        assert house.http.request("DELETE", path, headers=TUS).status_code == 204
        assert create(house, length=most_of_it).status_code == 201


def test_an_upload_given_up_is_gone(house: House) -> None:
    path = create(house).headers["location"]
    deleted = house.http.request("DELETE", path, headers=TUS)
    assert deleted.status_code == 204
    assert deleted.headers["tus-resumable"] == "1.0.0"
    assert house.http.request("HEAD", path, headers=TUS).status_code == 404
    assert_problem(send(house, path, 0, CLIP), 404)
    assert house.spooled() == []


def test_the_server_describes_what_it_speaks(house: House) -> None:
    response = house.http.request("OPTIONS", "/uploads")
    assert response.status_code == 204
    assert response.headers["tus-version"] == "1.0.0"
    assert response.headers["tus-extension"] == "creation,termination"
    assert int(response.headers["tus-max-size"]) > 0


def test_two_eyes_and_a_calibration_come_as_three_uploads(house: House) -> None:
    ids = {
        "left": uploaded(house, CLIP, "left", ".mov"),
        "right": uploaded(house, CLIP, "right", ".mov"),
        "calibration": uploaded(house, b"K: 1", "calibration", ".yaml"),
    }
    job = house.http.post("/reconstruct", json=ids)
    assert job.status_code == 202
    folder = house.store.spool_folder(job.json()["id"])
    assert {path.name for path in folder.iterdir()} >= {"left.mov", "right.mov", "calibration.yaml"}


def test_the_same_clip_has_the_same_digest_whichever_way_it_came(house: House) -> None:
    parts = {"left": ("l.mp4", CLIP), "right": ("r.mp4", another_clip(b"right"))}
    whole = house.queue.get(house.upload(parts=parts).json()["id"])
    ids = {eye: uploaded(house, content, eye) for eye, content in (("right", another_clip(b"right")), ("left", CLIP))}
    pieces = house.queue.get(house.http.post("/reconstruct", json=ids).json()["id"])
    assert whole is not None
    assert pieces is not None
    assert whole.input_sha256 == pieces.input_sha256


def test_an_upload_becomes_one_job_however_often_it_is_submitted(house: House) -> None:
    submission = {"clip": uploaded(house), "options": {"seed": 3}}
    first = house.http.post("/reconstruct", json=submission).json()["id"]
    assert house.http.post("/reconstruct", json=submission).json()["id"] == first
    other = house.http.post("/reconstruct", json={**submission, "options": {"seed": 4}})
    assert assert_problem(other, 409)["job_id"] == first
    assert len(house.queue.records()) == 1
    assert offset_of(house, f"/uploads/{submission['clip']}") == len(CLIP)
    assert_problem(send(house, f"/uploads/{submission['clip']}", len(CLIP), b""), 409)


def test_of_an_upload_that_is_in_use_no_job_is_made(house: House) -> None:
    upload_id = uploaded(house)
    with (house.store.incoming_folder(upload_id) / "clip.mp4").open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        refused = house.http.post("/reconstruct", json={"clip": upload_id})
        assert_problem(refused, 423, "upload")
        assert refused.headers["retry-after"]
    assert house.queue.records() == []
    assert house.http.post("/reconstruct", json={"clip": upload_id}).status_code == 202


def test_submissions_that_name_no_finished_upload_of_that_part_are_refused(house: House) -> None:
    unfinished = create(house).headers["location"].rpartition("/")[2]
    assert_problem(house.http.post("/reconstruct", json={"clip": unfinished}), 409, "clip")
    assert_problem(house.http.post("/reconstruct", json={"clip": "0" * 32}), 422, "clip")
    assert_problem(house.http.post("/reconstruct", json={"clip": "../../etc/passwd"}), 422, "clip")
    masks = uploaded(house, EMPTY_ZIP, "masks", ".zip")
    assert_problem(house.http.post("/reconstruct", json={"clip": masks}), 422, "clip")
    assert_problem(house.http.post("/reconstruct", json={"masks": masks}), 422, "clip")
    assert_problem(house.http.post("/reconstruct", json={"clip": unfinished, "passwd": "x"}), 422, "passwd")
    assert_problem(
        house.http.post("/reconstruct", json={"clip": unfinished, "options": {"seed": "x"}}), 422, "options.seed"
    )
    assert house.queue.records() == []


@pytest.mark.parametrize(
    ("body", "status"), [(b"{", 400), (b"[]", 422), (b"", 400), (b"\xff", 400), (b"{}" * 10**5, 413)]
)
def test_a_body_that_is_no_submission_is_a_problem(house: House, body: bytes, status: int) -> None:
    response = house.http.post("/reconstruct", content=body, headers={"Content-Type": "application/json"})
    assert response.status_code == status
    assert response.headers["content-type"] == "application/problem+json"


def test_only_so_many_uploads_may_be_open(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.tus.MAX_OPEN_UPLOADS", 2)
    assert [create(house).status_code for _ in range(3)] == [201, 201, 429]
    assert all(is_job_id(folder.name) for folder in house.spooled())


def test_an_accepted_upload_outlives_a_queue_that_forgot_its_job_and_is_full(tmp_path: Path) -> None:
    for house in make_house(tmp_path, max_queued=1):
        upload_id = uploaded(house)
        job_id = house.http.post("/reconstruct", json={"clip": upload_id}).json()["id"]
        house.queue.cancel(job_id)
        house.queue.forget(job_id)  # as a server does that was started on an empty disk
        assert house.upload().status_code == 202  # and fills the queue
        again = house.http.post("/reconstruct", json={"clip": upload_id})
        assert (again.status_code, again.json()["id"]) == (202, job_id)
        assert house.store.submission(job_id) is not None
