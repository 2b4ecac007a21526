"""Webhooks asked for from the client and from the command line."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from client.cli import main
from intrasplat.commands.exits import ExitCode
from intrasplat_client import Client, InputError
from tests.archives import archived, small_scene
from tests.client.local_service import LocalService, local_service
from tests.receiver import Receiver

SECRET = "s" * 32


@pytest.fixture(scope="module")
def receiver() -> Iterator[Receiver]:
    with Receiver() as receiver:
        yield receiver


@pytest.fixture(scope="module")
def telling(receiver: Receiver, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalService]:
    """A service that may send webhooks to the receiver."""
    changes = {"webhook_secret": SECRET, "webhook_hosts": (receiver.origin,), "webhook_private": "yes"}
    with local_service(tmp_path_factory.mktemp("data"), **changes) as service:
        yield service


@pytest.mark.parametrize("in_pieces", [False, True])
def test_a_caller_is_told_of_its_jobs_end_and_sees_the_log(
    telling: LocalService, receiver: Receiver, clip: Path, in_pieces: bool
) -> None:
    with Client(telling.url) as client:
        job = client.reconstruct(clip, callback_url=f"{receiver.origin}/hook", in_pieces=in_pieces)
        again = client.reconstruct(clip_of=job.id, callback_url=f"{receiver.origin}/again")
        assert client.deliveries(job.id) == []
        for each in (job, again):
            client.cancel(each.id)
        told = {webhook.path: webhook.document["data"]["job_id"] for webhook in (receiver.next(), receiver.next())}
        assert told == {"/hook": job.id, "/again": again.id}
        while not (deliveries := client.deliveries(job.id))[0].tries:
            time.sleep(0.02)
        assert [each.status_code for each in deliveries[0].tries] == [204]
        (owed,) = client.send_again(job.id)
        assert (owed.event_id, owed.forgiven_tries) == (deliveries[0].event_id, 1)
        assert receiver.next().headers["webhook-id"] == owed.event_id


def test_a_place_that_is_not_allowed_is_refused_by_its_name(telling: LocalService, clip: Path) -> None:
    with Client(telling.url) as client, pytest.raises(InputError) as caught:
        client.reconstruct(clip, callback_url="https://evil.example/")
    assert caught.value.field == "callback_url"


def test_the_command_line_asks_for_webhooks_of_clips_and_of_scenes(
    telling: LocalService, receiver: Receiver, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "scene.zip"
    scene.write_bytes(archived(tmp_path / "there", small_scene(50)))
    for command, path in (("submit", clip), ("import", scene)):
        callback = ["--callback-url", f"{receiver.origin}/{command}", "--url", telling.url]
        assert main([command, str(path), *callback]) == ExitCode.OK
        job_id = capsys.readouterr().out.strip()
        telling.queue.cancel(job_id)
        webhook = receiver.next()
        assert (webhook.path, webhook.document["data"]["job_id"]) == (f"/{command}", job_id)
