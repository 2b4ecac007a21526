"""The hostile corpus over HTTP: a 4xx for what shows at once, a failed job for the rest, and the worker goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from intrasplat_client import Client, JobRejected, RequestRefused
from lab.demo import started_service
from tests.intrasplat.clip.hostile import CALIBRATION, CORPUS, VIDEO, Hostile
from tests.service.under_test import ServiceUnderTest, assert_problem

JSON = {"Content-Type": "application/json"}
FOREIGN = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"}


def sent(options: str) -> dict[str, Any]:
    """A good clip with these options."""
    return {"files": {"clip": (VIDEO.name, VIDEO.read_bytes())}, "data": {"options": options}}


PLAIN = [name for name, hostile in CORPUS.items() if hostile.refused_at == "upload"]
DECODED = [name for name, hostile in CORPUS.items() if hostile.refused_at == "decoding"]


@pytest.mark.parametrize("name", PLAIN)
def test_what_cannot_be_a_clip_is_refused_when_it_arrives_and_leaves_nothing(
    service: ServiceUnderTest, tmp_path: Path, name: str
) -> None:
    hostile = CORPUS[name]
    path = hostile.write(tmp_path)
    parts = {"clip": (VIDEO.name, VIDEO.read_bytes())} | {hostile.part: (path.name, path.read_bytes())}
    response = service.upload(parts=parts)
    assert response.status_code in (413, 422)
    assert assert_problem(response, response.status_code, hostile.part)["remedy"]
    assert service.spooled() == []
    assert service.queue.records() == []


def test_what_only_decoding_shows_fails_its_job_and_the_worker_takes_the_next(tmp_path: Path) -> None:
    (tmp_path / "good.json").write_bytes(CALIBRATION)
    with started_service(tmp_path / "data", tmp_path / "service.log") as client:
        for name in DECODED:
            rejected = rejection(client, CORPUS[name], tmp_path)
            assert rejected.field == CORPUS[name].part, name
            assert rejected.remedy, name
        with pytest.raises(RequestRefused) as refused:
            client.reconstruct(CORPUS["a link"].write(tmp_path))
        assert refused.value.field == "clip"
        jobs = client.jobs()
        assert [job.attempt for job in jobs] == [1] * len(DECODED)  # no job took the worker with it
        assert client.is_ready()
    assert list((tmp_path / "data" / "scenes").iterdir()) == []


DEEP, BUDGET, ENDLESS = "[" * 99_999, "options.budget_s", "k" * 5_000
REQUESTS: dict[str, tuple[str, str, dict[str, Any], int, str | None]] = {
    "deep options": ("POST", "/reconstruct", sent(options=f'{{"preset": {DEEP}'), 413, "options"),
    "options nested as deep as they are long": ("POST", "/reconstruct", sent(options="[" * 9_000), 422, "options"),
    "a deep body": ("POST", "/reconstruct", {"content": f'{{"clip": {DEEP}', "headers": JSON}, 400, "body"),
    "a body of deep objects": (
        "POST",
        "/reconstruct",
        {"content": '{"options":' * 9_999, "headers": JSON},
        400,
        "body",
    ),
    "a body whose key is endless": ("POST", "/reconstruct", {"json": {ENDLESS: 1}}, 422, "k" * 80),
    "options whose key is endless": (
        "POST",
        "/reconstruct",
        sent(options=f'{{"{ENDLESS}": 1}}'),
        422,
        ("options." + "k" * 80)[:80],
    ),
    "labels whose key is endless": ("PATCH", "/jobs/x", {"json": {ENDLESS: 1}}, 422, "k" * 80),
    "a budget that is no number": ("POST", "/reconstruct", sent(options='{"budget_s": NaN}'), 422, BUDGET),
    "a budget beyond all numbers": (
        "POST",
        "/reconstruct",
        sent(options='{"budget_s": 1e999}'),
        422,
        "options.budget_s",
    ),
    "a budget below nothing": ("POST", "/reconstruct", sent(options='{"budget_s": -1}'), 422, BUDGET),
    "two eyes without a calibration": ("POST", "/reconstruct", sent(options='{"layout": "sbs"}'), 422, "calibration"),
    "a layer by a wrong name": ("GET", "/render?scene=x&layers=depth", {}, 422, "layers"),
    "a state by a wrong name": ("GET", "/jobs?stat=failed", {}, 422, "stat"),
    "a time that is no number": ("GET", "/render?t=nan", {}, 422, "t"),
    "a lens beyond all numbers": ("GET", "/render?fx=inf", {}, 422, "fx"),
    "pixels beyond all screens": ("GET", "/render?width=1000000", {}, 422, "width"),
    "an image of a foreign page": ("GET", "/render", {"headers": FOREIGN}, 403, "Sec-Fetch-Site"),
}
"""What was found to do harm, or to be passed over: method, address, arguments, status, field."""


@pytest.mark.parametrize("name", REQUESTS)
def test_a_hostile_request_is_refused_by_its_field_and_leaves_nothing(service: ServiceUnderTest, name: str) -> None:
    method, address, arguments, status, field = REQUESTS[name]
    problem = assert_problem(service.http.request(method, address, **arguments), status, field)
    assert problem["remedy"]
    assert service.spooled() == []
    assert service.queue.records() == []


def rejection(client: Client, hostile: Hostile, folder: Path) -> JobRejected:
    """What the caller hears of a job with that file."""
    parts = {"clip": VIDEO, "calibration": folder / "good.json"} | {hostile.part: hostile.write(folder)}
    job = client.reconstruct(parts.pop("clip"), **parts, iterations=30)
    with pytest.raises(JobRejected) as caught:
        client.wait(job.id)
    return caught.value
