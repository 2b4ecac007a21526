"""Live feeds by the Python client: opened, looked at, cut and ended."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from client.cli import main
from intrasplat.commands.exits import ExitCode
from intrasplat_client import AsyncClient, Client, FeedState, InputError, JobState, NotFound, RequestRefused
from tests.client.local_service import CLIP, LocalService, local_service
from tests.service.feed_worker import BEGAN_S, following, wait_until
from tests.service.test_feeds import RECTIFIED


@pytest.fixture
def service(tmp_path: Path) -> Iterator[LocalService]:
    with local_service(tmp_path / "data") as service:
        yield service


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "endoscope of Smith.json"
    path.write_text(RECTIFIED)
    return path


def test_a_feed_is_opened_looked_at_cut_and_ended(service: LocalService, client: Client, calibration: Path) -> None:
    feed = client.open_feed(calibration, label="room 4", layout="sbs", keep_s=60)
    assert (feed.label, feed.state, feed.reason) == ("room 4", FeedState.CONNECTING, "no_worker")
    assert feed.options.keep_s == 60
    with following(service.queue, service.store.run_dir, CLIP.read_bytes()):
        wait_until(lambda: client.feed(feed.id).state is FeedState.LIVE)
        assert [each.id for each in client.feeds()] == [feed.id]
        image = client.render("-10", scene=feed.id)
        assert (image.content, image.state, image.source_s, image.age_s) == (b"picture", "live", 50, 10.5)
        assert image.captured_at == "2023-11-14T22:14:10.000+00:00"
        assert client.render(scene=feed.id).source_s == 60
        assert client.recorded(feed.id, "live") == b"picture"
        assert client.export(feed.id, -5) == b"ply\n"
        with client.stream(feed.id) as viewer:
            assert viewer.render("live").source_s == 60
        assert client.pause_feed(feed.id).state is FeedState.PAUSED
        assert client.resume_feed(feed.id).state is FeedState.LIVE
        job = client.cut_feed(feed.id, -30, iterations=30, label="the bleeding")
        assert (job.state, job.label, job.options.iterations) == (JobState.QUEUED, "the bleeding", 30)
        assert (job.cut.from_s, job.cut.frames) == (BEGAN_S + 30, 900)
        assert client.job(job.id).id == job.id
        receipt = client.end_feed(feed.id)
    assert (receipt.feed_id, receipt.verified) == (feed.id, True)
    with pytest.raises(NotFound):
        client.feed(feed.id)


def test_the_same_key_opens_one_feed(service: LocalService, client: Client, calibration: Path) -> None:
    first, again = (client.open_feed(calibration, idempotency_key="room 4") for _ in range(2))
    assert first.id == again.id
    assert client.open_feed(calibration).id != first.id


def test_what_cannot_be_opened_or_cut_is_named(service: LocalService, client: Client, calibration: Path) -> None:
    with pytest.raises(InputError, match="calibration"):
        client.open_feed(calibration.with_name("missing.json"))
    with pytest.raises(RequestRefused) as refused:
        client.open_feed(calibration, "rtsp://camera.example.org/1")
    assert refused.value.field == "options.source"
    feed = client.open_feed(calibration)
    with pytest.raises(InputError, match="budget"):
        client.cut_feed(feed.id, -30, budget="long")  # type: ignore[call-arg]


def test_the_asynchronous_client_has_the_same_calls(service: LocalService, calibration: Path) -> None:
    async def use() -> None:
        async with AsyncClient(service.url) as client:
            feed = await client.open_feed(calibration)
            assert [each.id for each in await client.feeds()] == [feed.id]
            assert (await client.end_feed(feed.id)).record

    asyncio.run(use())


def test_the_commands_open_list_pause_cut_and_end_feeds(
    service: LocalService, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: str) -> str:
        assert main(["feeds", *arguments, "--url", service.url]) == ExitCode.OK
        return capsys.readouterr().out.strip()

    feed_id = run("open", "--calibration", str(calibration), "--label", "room 4", "--keep-s", "60")
    assert run("list") == f"{feed_id}  connecting  [room 4]  no_worker"
    with following(service.queue, service.store.run_dir, CLIP.read_bytes()):
        wait_until(lambda: "live" in run("list"))
        assert "5.0 of 30.0 pairs/s" in run("list")
        assert run("pause", feed_id) == "paused"
        assert run("resume", feed_id) == "live"
        job = service.queue.get(run("cut", feed_id, "-30", "--iterations", "30"))
        assert job is not None
        assert job.options.iterations == 30
        assert json.loads(run("end", feed_id))["verified"]
    assert run("list") == ""
    assert main(["feeds", "pause", feed_id, "--url", service.url]) == ExitCode.BAD_INPUT
    assert "intrasplat feeds list" in capsys.readouterr().err
