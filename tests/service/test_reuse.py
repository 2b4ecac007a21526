"""A job of another job's clip: it has the files of its own, and whoever may not see the clip cannot use it."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from contract.wire.job import JobRecord
from intrasplat.errors import UnavailableError
from tests.intrasplat.clip.hostile import CALIBRATION, OPENCV
from tests.service.test_safety import audit
from tests.service.test_tus import uploaded
from tests.service.under_test import (
    CLIP,
    EMPTY_ZIP,
    ServiceUnderTest,
    another_clip,
    assert_problem,
    bearer,
    running_service,
)

OTHER_ZIP = EMPTY_ZIP[:-2] + b"\x03\x00abc"
"""With a comment."""
LEFT, RIGHT = another_clip(b"left"), another_clip(b"right")


def again(
    service: ServiceUnderTest,
    job_id: str,
    parts: dict[str, tuple[str, bytes]] | None = None,
    headers: dict[str, str] | None = None,
) -> httpx.Response:
    """The form that uses a job's clip again, with other parts."""
    files = {name: (None, text) for name, text in {"clip_of": job_id, "options": '{"seed": 3}'}.items()}
    return service.http.post("/reconstruct", files={**files, **(parts or {})}, headers=headers)


def record_of(service: ServiceUnderTest, response: httpx.Response) -> JobRecord:
    assert response.status_code == 202, response.text
    record = service.queue.get(response.json()["id"])
    assert record is not None
    return record


def contents(service: ServiceUnderTest, record: JobRecord) -> dict[str, bytes]:
    folder = service.store.spool_folder(record.job_id)
    return {name: (folder / name).read_bytes() for name in record.files.model_dump(exclude_none=True).values()}


def test_a_clip_is_used_again_with_better_masks_and_is_as_if_it_were_sent_again(service: ServiceUnderTest) -> None:
    eyes = {"left": ("l.mov", LEFT), "right": ("r.mov", RIGHT), "calibration": ("k.json", CALIBRATION)}
    first = record_of(service, service.upload(parts={**eyes, "masks": ("m.zip", EMPTY_ZIP)}))
    second = record_of(service, again(service, first.job_id, {"masks": ("m.zip", OTHER_ZIP)}))
    files = {"left.mov": LEFT, "right.mov": RIGHT, "calibration.json": CALIBRATION, "masks.zip": OTHER_ZIP}
    assert contents(service, second) == files
    assert (second.clip_of, second.options.seed) == (first.job_id, 3)
    whole = record_of(service, service.upload(parts={**eyes, "masks": ("m.zip", OTHER_ZIP)}))
    assert whole.input_sha256 == second.input_sha256 != first.input_sha256
    assert contents(service, first)["masks.zip"] == EMPTY_ZIP
    assert list((service.store.data_dir / "incoming").iterdir()) == []


def test_what_is_not_sent_is_the_earlier_jobs_and_the_format_may_be_another(service: ServiceUnderTest) -> None:
    first = record_of(
        service,
        service.upload(
            parts={"clip": ("a.mp4", CLIP), "calibration": ("k.json", CALIBRATION), "masks": ("m.zip", EMPTY_ZIP)}
        ),
    )
    second = record_of(service, again(service, first.job_id, {"calibration": ("k.yaml", OPENCV)}))
    assert contents(service, second) == {"clip.mp4": CLIP, "calibration.yaml": OPENCV, "masks.zip": EMPTY_ZIP}


def test_each_of_the_two_is_removed_by_itself_and_the_receipt_names_who_keeps_the_clip(
    service: ServiceUnderTest,
) -> None:
    first = service.finished_scene()
    second = record_of(service, again(service, first, {"masks": ("m.zip", EMPTY_ZIP)}))
    third = record_of(service, again(service, second.job_id))
    assert third.clip_of == first
    receipt = service.http.delete(f"/scenes/{first}").json()
    assert (receipt["verified"], receipt["files"]["spool"]) == (True, 2)
    assert sorted(receipt["clip_kept_by"]) == sorted([second.job_id, third.job_id])
    assert contents(service, second) == {"clip.mp4": CLIP, "masks.zip": EMPTY_ZIP}
    assert_problem(again(service, first), 404, "clip_of")
    service.http.delete(f"/jobs/{second.job_id}")
    assert contents(service, third) == {"clip.mp4": CLIP, "masks.zip": EMPTY_ZIP}
    service.http.delete(f"/jobs/{third.job_id}")
    receipt = service.http.delete(f"/scenes/{third.job_id}").json()
    assert receipt["clip_kept_by"] == []
    assert service.spooled() == []


def test_uploads_go_with_an_earlier_clip_and_are_used_once(service: ServiceUnderTest) -> None:
    first, other = service.upload().json()["id"], service.upload().json()["id"]
    submission = {"masks": uploaded(service, EMPTY_ZIP, "masks", ".zip"), "clip_of": first}
    second = record_of(service, service.http.post("/reconstruct", json=submission))
    assert contents(service, second) == {"clip.mp4": CLIP, "masks.zip": EMPTY_ZIP}
    assert service.http.post("/reconstruct", json=submission).json()["id"] == second.job_id
    refused = service.http.post("/reconstruct", json={**submission, "clip_of": other})
    assert assert_problem(refused, 409, "masks")["job_id"] == second.job_id
    alone = service.http.post("/reconstruct", json={"clip_of": first, "options": {"seed": 1}})
    assert contents(service, record_of(service, alone)) == {"clip.mp4": CLIP}


def test_a_clip_of_nobody_of_a_cancelled_job_or_beside_another_clip_is_refused(service: ServiceUnderTest) -> None:
    first = service.upload().json()["id"]
    assert "GET /jobs" in assert_problem(again(service, "0" * 32), 404, "clip_of")["remedy"]
    assert_problem(again(service, "../../etc/passwd"), 422, "clip_of")
    for part in ("clip", "left"):
        together = again(service, first, {part: ("a.mp4", CLIP)})
        assert part in assert_problem(together, 422, "clip_of")["detail"]
    assert_problem(service.http.post("/reconstruct", json={"clip_of": "x"}), 422, "clip_of")
    assert_problem(
        service.http.post("/reconstruct", json={"clip_of": first, "clip": uploaded(service)}), 422, "clip_of"
    )
    service.http.delete(f"/jobs/{first}")
    gone = assert_problem(again(service, first), 409, "clip_of")
    assert "Send the clip itself" in gone["remedy"]
    assert list((service.store.data_dir / "spool").iterdir()) == []


def test_another_tenants_clip_is_as_unknown_as_none_and_the_try_is_recorded(service: ServiceUnderTest) -> None:
    owner, stranger = bearer(service, "ward-a"), bearer(service, "ward-b")
    job_id = service.upload(headers=owner).json()["id"]
    unknown = assert_problem(again(service, "0" * 32, headers=stranger), 404, "clip_of")
    refused = assert_problem(again(service, job_id, headers=stranger), 404, "clip_of")
    assert unknown["detail"].replace("0" * 32, job_id) == refused["detail"]
    lines = [line for line in audit(service) if line["job_id"] == job_id]
    assert [(line["action"], line["outcome"]) for line in lines] == [("accepted", "ok"), ("refused", "404")]
    second = record_of(service, again(service, job_id, headers=owner))
    assert second.tenant == "ward-a"
    assert audit(service)[-1]["outcome"] == f"ok (clip of {job_id})"


def test_all_files_together_are_no_larger_than_an_upload_may_be(tmp_path: Path) -> None:
    for service in running_service(tmp_path, max_upload_bytes=len(CLIP) + 1000):
        first = service.upload().json()["id"]
        assert again(service, first).status_code == 202
        large = again(service, first, {"masks": ("m.zip", EMPTY_ZIP[:-2] + b"\xe8\x03" + bytes(1000))})
        assert "INTRASPLAT_MAX_UPLOAD_BYTES" in assert_problem(large, 413, "clip_of")["remedy"]


def test_options_that_cannot_go_with_the_clip_are_refused_at_once(service: ServiceUnderTest) -> None:
    masks = {"clip": ("a.mp4", CLIP), "masks": ("m.zip", EMPTY_ZIP)}
    assert_problem(service.upload('{"poses": "given"}'), 422, "options.poses")
    assert_problem(service.upload('{"mask_source": "none"}', parts=masks), 422, "options.mask_source")
    first = service.upload(parts=masks).json()["id"]
    for options, status in (({"mask_source": "none"}, 202), ({"poses": "given"}, 422)):
        assert service.http.post("/reconstruct", json={"clip_of": first, "options": options}).status_code == status
    assert len(service.spooled()) == 2


def test_a_clip_that_is_removed_while_it_is_linked_is_not_half_used(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = {"clip": ("a.mp4", CLIP), "masks": ("m.zip", EMPTY_ZIP)}
    first = record_of(service, service.upload(parts=parts))
    fetch_clip = service.store.fetch_clip

    def fetch_and_lose(job_id: str) -> Path:
        folder = fetch_clip(job_id)
        (folder / "masks.zip").unlink()
        return folder

    monkeypatch.setattr(service.store, "fetch_clip", fetch_and_lose)
    assert_problem(again(service, first.job_id), 409, "clip_of")
    assert [each.job_id for each in service.queue.records()] == [first.job_id]
    assert list((service.store.data_dir / "incoming").iterdir()) == []


def test_a_clip_is_used_again_while_the_queue_is_away(
    service: ServiceUnderTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = service.upload().json()["id"]

    def away(*_: object) -> None:
        raise UnavailableError("The queue does not answer.", "Start it.", may_return=True)

    with monkeypatch.context() as patch:
        patch.setattr(service.queue, "get", away)
        patch.setattr(service.queue, "submit", away)
        assert "safe" in assert_problem(again(service, first), 503, "queue")["detail"]
    assert len(service.store.spooled_ids()) == 2
