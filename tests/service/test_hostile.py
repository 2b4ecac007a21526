"""The hostile corpus over HTTP: a 4xx for what shows at once, a failed job for the rest, and the worker goes on."""

from __future__ import annotations

from pathlib import Path

import pytest

from client.demo import started_service
from intrasplat_client import Client, JobRejected, RequestRefused
from tests.service.under_test import ServiceUnderTest, assert_problem
from tests.worker.input.clip.hostile import CALIBRATION, CORPUS, VIDEO, Hostile

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


def rejection(client: Client, hostile: Hostile, folder: Path) -> JobRejected:
    """What the caller hears of a job with that file."""
    parts = {"clip": VIDEO, "calibration": folder / "good.json"} | {hostile.part: hostile.write(folder)}
    job = client.reconstruct(parts.pop("clip"), **parts, iterations=30)
    with pytest.raises(JobRejected) as caught:
        client.wait(job.id)
    return caught.value
