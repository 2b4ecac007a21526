"""What a client sends: kept whole before the answer, or refused with the part named and nothing left behind."""

from __future__ import annotations

import asyncio
import hashlib
import os
import re
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from fastapi import FastAPI

from contract.store.shelf import ABANDONED_AFTER_S, new_job_id
from contract.store.store import Store
from contract.wire.job import JobRecord
from intrasplat.errors import ErrorCode
from intrasplat.names import SUBMISSION
from service.problems import Problem, install_handlers
from service.upload import UploadLimits, receive_upload
from tests.intrasplat.clip.hostile import CALIBRATION
from tests.service.asgi import serving
from tests.service.under_test import CLIP, EMPTY_ZIP, ServiceUnderTest, assert_problem, running_service

PATIENCE_S = 10.0
UPLOAD_HEADERS = {
    "Tus-Resumable": "1.0.0",
    "Upload-Length": str(len(CLIP)),
    "Upload-Metadata": "part Y2xpcA==,suffix Lm1wNA==",
}


def test_an_accepted_clip_is_on_disk_and_queued_before_the_answer(service: ServiceUnderTest) -> None:
    response = service.upload('{"preset": "fast", "iterations": 30, "holdout": [1, 9]}')
    assert response.status_code == 202
    job = response.json()
    assert response.headers["location"] == f"/jobs/{job['id']}"
    assert job["state"] == "queued"
    record = service.queue.get(job["id"])
    assert record is not None
    assert record.options.holdout == "1,9"
    assert record.input_sha256 == hashlib.sha256(CLIP).hexdigest()
    folder = service.store.spool_folder(job["id"])
    assert (folder / "clip.mp4").read_bytes() == CLIP
    assert JobRecord.model_validate_json((folder / SUBMISSION).read_text()) == record
    assert list((service.store.data_dir / "incoming").iterdir()) == []


def test_a_file_of_poses_is_kept_and_one_that_is_no_text_is_refused(service: ServiceUnderTest) -> None:
    parts = {"clip": ("c.mp4", CLIP), "poses_file": ("Smith.TUM", b"0 0 0 0 0 0 0 1\n")}
    record = service.queue.get(service.upload(parts=parts).json()["id"])
    assert record is not None
    assert record.files.poses_file == "poses_file.tum"
    assert '"poses_file"' in record.model_dump_json()
    parts["poses_file"] = ("poses.tum", "0 0 0 0 0 0 0 1\n".encode("utf-16"))
    assert service.upload(parts=parts).status_code == 202
    parts["poses_file"] = ("poses.tum", b"\0\0")
    assert_problem(service.upload(parts=parts), 422, "poses_file")


def test_a_field_of_view_is_stored_and_what_is_no_png_or_contradicts_the_options_is_refused(
    service: ServiceUnderTest,
) -> None:
    written, png = cv2.imencode(".png", np.full((64, 80), 255, np.uint8))
    assert written
    parts = {"clip": ("c.mp4", CLIP), "fov_mask": ("Smith.PNG", png.tobytes())}
    record = service.queue.get(service.upload(parts=parts).json()["id"])
    assert record is not None
    assert record.files.fov_mask == "fov_mask.png"
    assert JobRecord.model_validate_json(record.model_dump_json()) == record
    assert_problem(service.upload('{"fov": "all"}', parts), 422, "fov_mask")
    for name, content in (("f.png", b"\xff\xd8\xff\xe0"), ("f.jpg", png.tobytes())):
        assert_problem(service.upload(parts={**parts, "fov_mask": (name, content)}), 422, "fov_mask")
    without = service.queue.get(service.upload(parts={"clip": ("c.mp4", CLIP)}).json()["id"])
    assert without is not None
    assert '"fov_mask"' not in without.model_dump_json()  # workers of older versions do not know it


def test_two_eyes_calibration_and_masks_are_kept_under_our_names(service: ServiceUnderTest) -> None:
    eyes = {"left": ("Smith_L.MOV", CLIP), "right": ("Smith_R.mov", CLIP)}
    response = service.upload(
        parts={**eyes, "calibration": ("stereo.json", CALIBRATION), "masks": ("m.zip", EMPTY_ZIP)}
    )
    record = service.queue.get(response.json()["id"])
    assert record is not None
    assert record.files.model_dump() == {
        "clip": "left.mov",
        "right": "right.mov",
        "calibration": "calibration.json",
        "masks": "masks.zip",
    }
    assert "Smith" not in "".join(path.read_text() for path in service.store.data_dir.rglob("*.json"))


@pytest.mark.parametrize(
    ("parts", "field"),
    [
        ({"left": ("l.mp4", b"x")}, "right"),
        ({"right": ("r.mp4", b"x")}, "left"),
        ({"masks": ("m.zip", b"x")}, "clip"),
        ({"clip": ("c.mp4", b"x"), "right": ("r.mp4", b"x")}, "clip"),
        ({"clip": ("c.exe", b"x")}, "clip"),
        ({"clip": ("c", b"x")}, "clip"),
        ({"clip": ("c.mp4", b"")}, "clip"),
        ({"clip": ("c.mp4", b"x"), "calibration": ("k.pkl", b"x")}, "calibration"),
        ({"clip": ("c.mp4", b"x"), "passwd": ("k.json", b"x")}, "passwd"),
    ],
)
def test_an_upload_that_cannot_be_used_names_the_part_and_leaves_nothing(
    service: ServiceUnderTest, parts: dict[str, tuple[str, bytes]], field: str
) -> None:
    assert assert_problem(service.upload(parts=parts), 422, field)["remedy"]
    assert service.spooled() == []
    assert service.queue.records() == []


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ('{"budget_s": 0}', "options.budget_s"),
        ('{"budget_s": 1, "iterations": 1}', "options.budget_s"),
        ('{"layout": "diagonal"}', "options.layout"),
        ('{"colour": 1}', "options.colour"),
        ("[1]", "options"),
        ("{", "options"),
    ],
)
def test_an_option_that_cannot_be_meant_is_named(service: ServiceUnderTest, options: str, field: str) -> None:
    assert_problem(service.upload(options), 422, field)
    assert service.spooled() == []


def test_a_part_that_comes_twice_is_refused(service: ServiceUnderTest) -> None:
    twice = [("clip", ("a.mp4", b"x")), ("clip", ("b.mp4", b"y"))]
    assert_problem(service.http.post("/reconstruct", files=twice), 422, "clip")


@pytest.mark.parametrize(
    ("content_type", "body"),
    [
        ("text/plain", b"{}"),
        ("", b""),
        ("multipart/form-data", b"--x"),
        ("multipart/form-data; boundary=x", b"this is no multipart body"),
        ("multipart/form-data; boundary=" + "x" * 5000, b"--x"),
        (
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="clip"; filename="a.mp4"\r\n\r\nab',
        ),
    ],
)
def test_a_body_that_is_no_complete_form_is_a_bad_request(
    service: ServiceUnderTest, content_type: str, body: bytes
) -> None:
    response = service.http.post("/reconstruct", content=body, headers={"content-type": content_type})
    assert response.status_code == 400
    assert response.json()["remedy"]
    assert service.spooled() == []


def test_uploads_cut_off_by_the_end_of_an_earlier_service_are_removed_at_the_start_of_the_next(tmp_path: Path) -> None:
    folder = Store(tmp_path).open_incoming(new_job_id())
    (folder / "clip.mp4").write_bytes(b"half")
    long_ago_s = time.time() - ABANDONED_AFTER_S - 60
    for path in (folder / "clip.mp4", folder):
        os.utime(path, (long_ago_s, long_ago_s))
    for service in running_service(tmp_path):
        deadline = time.monotonic() + PATIENCE_S
        while service.spooled() and time.monotonic() < deadline:
            time.sleep(0.02)
        assert service.spooled() == []


def test_an_upload_over_the_limit_is_cut_off_while_it_is_counted(tmp_path: Path) -> None:
    for service in running_service(tmp_path, max_upload_bytes=1000):
        assert "INTRASPLAT_MAX_UPLOAD_BYTES" in assert_problem(service.upload(), 413, "clip")["remedy"]
        assert service.spooled() == []


def test_an_upload_leaves_the_room_on_disk_that_must_stay_free(tmp_path: Path) -> None:
    limits = UploadLimits(upload_bytes=10**9, available_bytes=1000, min_free_bytes=77)

    async def body() -> AsyncIterator[bytes]:
        yield b'--x\r\nContent-Disposition: form-data; name="clip"; filename="a.mp4"\r\n\r\n' + b"x" * 1000

    with pytest.raises(Problem, match="room for 1000 bytes") as caught:
        asyncio.run(receive_upload("multipart/form-data; boundary=x", body(), tmp_path, limits))
    assert caught.value.status == 507
    assert "77 must stay free (INTRASPLAT_MIN_FREE_BYTES)" in str(caught.value.remedy)


def test_a_disk_that_fills_up_is_told_as_such() -> None:
    app = FastAPI()
    install_handlers(app)

    @app.get("/{device}")
    def write(device: str) -> None:
        Path("/dev", device).write_bytes(b"x")

    with serving(app, "http://127.0.0.1") as http:
        assert "Delete scenes" in assert_problem(http.get("/full"), 507)["remedy"]
        assert_problem(http.get("/null/nothing"), 404)


def test_nothing_is_accepted_on_a_full_disk(tmp_path: Path) -> None:
    for service in running_service(tmp_path, min_free_bytes=2**62):
        for problem in (
            assert_problem(service.upload(), 507),
            assert_problem(service.http.get("/readyz"), 503, "disk"),
            assert_problem(service.http.post("/uploads", headers=UPLOAD_HEADERS), 507),
        ):
            assert problem["code"] == ErrorCode.STORE_FULL
            assert f"{2**62} must stay free (INTRASPLAT_MIN_FREE_BYTES)" in problem["remedy"]
            (missing,) = re.findall(r"Free (\d+) bytes", problem["remedy"])
            assert 2**61 < int(missing) <= 2**62 + len(CLIP) + 1000
    for service in running_service(tmp_path, min_free_bytes=2**62, host="0.0.0.0", hosts=("127.0.0.1",)):
        assert "Free space" in assert_problem(service.http.get("/readyz"), 503, "disk")["remedy"]


def test_a_declared_length_that_is_too_large_is_refused_before_the_body_is_read(tmp_path: Path) -> None:
    async def never() -> AsyncIterator[bytes]:
        raise AssertionError("the body was read")
        yield b""

    headers = {"content-type": "multipart/form-data; boundary=x", "content-length": "1001"}
    for service in running_service(tmp_path, max_upload_bytes=1000):
        assert_problem(service.http.post("/reconstruct", content=never(), headers=headers), 413, "clip")
        assert service.spooled() == []
    headers["content-length"] = str(2**62)
    for service in running_service(tmp_path, max_upload_bytes=2**63):
        assert_problem(service.http.post("/reconstruct", content=never(), headers=headers), 507)


def test_only_so_many_uploads_are_received_at_once(tmp_path: Path) -> None:
    for service in running_service(tmp_path, max_uploads=0):
        refused = service.upload()
        assert_problem(refused, 503, "uploads")
        assert refused.headers["retry-after"]
        assert service.spooled() == []


async def stalled() -> AsyncIterator[bytes]:
    yield b"--x\r\n"
    await asyncio.sleep(PATIENCE_S)


async def dripping() -> AsyncIterator[bytes]:
    yield b'--x\r\nContent-Disposition: form-data; name="clip"; filename="a.mp4"\r\n\r\n'
    for _ in range(1000):
        yield b"-"
        await asyncio.sleep(0.01)


@pytest.mark.parametrize("body", [stalled, dripping])
def test_a_body_that_brings_hardly_anything_is_given_up(
    tmp_path: Path, body: Callable[[], AsyncIterator[bytes]]
) -> None:
    headers = {"content-type": "multipart/form-data; boundary=x"}
    for service in running_service(tmp_path, upload_silence_s=0.1):
        assert_problem(service.http.post("/reconstruct", content=body(), headers=headers), 408, "body")
        assert service.spooled() == []
        assert service.upload().status_code == 202
