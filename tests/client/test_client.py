"""The blocking client against a real service: clip to scene, lines that are cut, and every refusal by its name."""

from __future__ import annotations

import asyncio
import inspect
import os
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from contract.access.keys import KeyFile, KeyScope
from contract.wire.job import JobError, JobProgress
from intrasplat.names import MASKS
from intrasplat_client import (
    AsyncClient,
    Client,
    Conflict,
    Forbidden,
    InputError,
    JobCancelled,
    JobFailed,
    JobRejected,
    JobState,
    NotFound,
    RequestRefused,
    ServiceUnavailable,
    Unauthorized,
    submission,
)
from tests.cameras import CAMERAS
from tests.client.local_service import SNAPSHOT_ITERATION, LocalService, line_to, local_service
from tests.intrasplat.clip.hostile import CALIBRATION
from tests.reports import REPORT_OF_A_SCENE

WAIT_S = 10.0


def test_a_clip_becomes_a_scene_with_report_curve_export_and_renders(
    service: LocalService, client: Client, clip: Path
) -> None:
    job = client.reconstruct(clip, iterations=30)
    assert job.state is JobState.QUEUED
    assert job.options.iterations == 30
    service.finish()
    assert client.wait(job.id).state is JobState.DONE
    assert client.report(job.id).psnr_tissue_db == 36.2
    assert client.curve(job.id).startswith("t_train_s")
    assert client.export(job.id) == b"ply\n"
    (service.store.scene_folder(job.id, 1) / MASKS).write_bytes(b"PK")
    assert client.masks(job.id) == b"PK"
    assert client.file(job.id, "manifest.json") == b'{"files": {}}'
    with pytest.raises(NotFound, match=r"no file 'scene\.safetensors'"):
        client.file(job.id)
    assert set(client.key()["scopes"]) == set(KeyScope)
    assert client.recorded(job.id, 0.5) == b"jpeg"
    measured = client.measure(job.id, [(10, 40), (20.5, 40)], t=0.25, width=120)
    assert measured.distance is not None
    assert measured.distance.distance_mm == pytest.approx(10.5 / 2)
    (refused,) = client.measure(job.id, [(59, 20)]).points
    assert refused.refusal is not None
    assert refused.refusal.code == "low_confidence"
    assert client.cameras(job.id).model_dump() == CAMERAS.model_dump()
    assert client.thumbnail(job.id) == service.store.thumbnail(job.id, 1)
    assert job.id in {scene["id"] for scene in client.scenes()}
    receipt = client.delete(job.id)
    assert receipt["verified"]
    with pytest.raises(NotFound) as caught:
        client.report(job.id)
    assert caught.value.status == 404


@pytest.mark.parametrize("in_pieces", [False, True])
def test_a_clip_is_used_again_with_better_masks(
    service: LocalService, client: Client, clip: Path, tmp_path: Path, in_pieces: bool
) -> None:
    first = client.reconstruct(clip)
    (tmp_path / "better.zip").write_bytes(b"PK\x05\x06" + bytes(18))
    again = client.reconstruct(clip_of=first.id, masks=tmp_path / "better.zip", seed=2, in_pieces=in_pieces)
    assert (again.clip_of, again.options.seed) == (first.id, 2)
    folder = service.store.spool_folder(again.id)
    assert (folder / "clip.mp4").read_bytes() == clip.read_bytes()
    assert (folder / "masks.zip").read_bytes() == (tmp_path / "better.zip").read_bytes()
    assert client.reconstruct(clip_of=first.id, in_pieces=in_pieces, on_upload=lambda *_: None).clip_of == first.id
    for given in ({}, {"clip": clip, "clip_of": first.id}):
        with pytest.raises(InputError) as caught:
            client.reconstruct(**given)
        assert caught.value.field == ("clip_of" if given else "clip")


def test_a_report_waits_for_its_scores(service: LocalService, client: Client, clip: Path) -> None:
    job = client.reconstruct(clip, iterations=30)
    claim = service.claim()
    service.finish(claim, scored=False)
    assert not client.report(job.id, scores_within_s=0.0).scored
    (summary,) = (scene for scene in client.scenes() if scene["id"] == job.id)
    assert not summary["scored"]
    add = partial(service.store.add_scores, "worker-1", job.id, claim.attempt, REPORT_OF_A_SCENE)
    threading.Timer(0.5, add).start()
    assert client.report(job.id).scored


def test_a_render_comes_as_a_file_as_an_array_or_as_what_is_known(
    service: LocalService, client: Client, clip: Path
) -> None:
    job = client.reconstruct(clip)
    service.finish()
    image = client.render(t=0.5, scene=job.id, layer="depth", format="npy", width=64)
    np.testing.assert_array_equal(image.array(), np.full((4, 6), 0.5, np.float32))
    np.testing.assert_array_equal(client.render_array(t=0.25, scene=job.id), np.full((4, 6), 0.25, np.float32))
    assert (image.scene, image.t, image.state) == (job.id, 0.5, "done")
    assert (image.warning, image.warning_codes) == ("seen from afar", ("unclassified",))
    assert (image.unseen, client.render(t=0.5, scene=job.id, unseen="guess").unseen) == (0.25, 0.0)
    assert client.render(t=0.5, scene=job.id, layer="depth", format="npy", width=64, known=image) is image
    assert client.render(t=0.5, scene=job.id, layer="rgb", known=image) is not image
    with pytest.raises(InputError, match="npy"):
        client.render(t=0.5, scene=job.id).array()


def test_highlights_can_be_left_out(service: LocalService, client: Client, clip: Path) -> None:
    job = client.reconstruct(clip)
    service.finish()
    with client.stream(job.id) as viewer:
        for highlights, expected in ((None, 0.5), ("on", 0.5), ("off", -0.5)):
            image = client.render(t=0.5, scene=job.id, format="npy", highlights=highlights)
            streamed = viewer.render(0.5, format="npy", highlights=highlights)
            array = client.render_array(t=0.5, scene=job.id, highlights=highlights)
            assert [each[0, 0] for each in (image.array(), streamed.array(), array)] == [expected] * 3


def test_a_job_that_trains_shows_its_newest_snapshot_and_one_that_waits_is_a_conflict(
    service: LocalService, client: Client, clip: Path
) -> None:
    job = client.reconstruct(clip)
    with pytest.raises(Conflict):
        client.render(scene=job.id)
    service.claim()
    image = client.render(scene=job.id)
    assert (image.state, image.iteration) == ("running", SNAPSHOT_ITERATION)


def test_many_views_come_over_one_connection(service: LocalService, client: Client, clip: Path) -> None:
    job = client.reconstruct(clip)
    service.finish()
    with client.stream(job.id) as viewer:
        for t in (0.0, 0.5, 1.0):
            image = viewer.render(t, "orbit:5,0,1", layer="depth", format="npy")
            assert (image.t, image.scene) == (t, job.id)
            assert image.array()[0, 0] == t
        with pytest.raises(RequestRefused) as caught:
            viewer.render(0.0, "orbit:999,0,1")
        assert caught.value.field == "pose"
        assert viewer.render(0.0).media_type == "image/jpeg"
        assert [viewer.render(0.0, unseen=each).unseen for each in (None, "mark", "guess")] == [0.25, 0.25, 0.0]
    with client.stream("nosuch") as viewer, pytest.raises(NotFound):
        viewer.render()


def test_watching_shows_each_state_and_ends_with_the_last(service: LocalService, client: Client, clip: Path) -> None:
    job = client.reconstruct(clip)
    states = []
    for view in client.watch(job.id):
        states.append(view.state)
        if view.state is JobState.QUEUED and states.count(JobState.QUEUED) == 1:
            client.cancel(job.id)
    assert (states[0], states[-1]) == (JobState.QUEUED, JobState.CANCELLED)
    with pytest.raises(JobCancelled):
        client.wait(job.id)


def test_a_watch_that_is_left_early_lets_go_of_its_connection(service: LocalService, clip: Path) -> None:
    with line_to(service) as line, Client(line.url) as far:
        job = far.reconstruct(clip)
        for _ in range(3):
            watching = far.watch(job.id)
            assert next(watching).state is JobState.QUEUED
            watching.close()
            assert far.job(job.id).id == job.id
        deadline_s = time.monotonic() + WAIT_S
        while line.open_connections > 1:  # the one that is kept for the next call
            assert time.monotonic() < deadline_s
            time.sleep(0.02)


def test_the_blocking_client_works_where_an_event_loop_runs(service: LocalService, client: Client, clip: Path) -> None:
    async def use() -> JobState:
        job = client.reconstruct(clip)
        service.finish()
        return client.wait(job.id).state

    assert asyncio.run(use()) is JobState.DONE


def test_a_watch_that_is_cut_off_resumes_and_misses_nothing(service: LocalService, client: Client, clip: Path) -> None:
    job = client.reconstruct(clip)
    seen: list[float] = []
    with line_to(service) as line, Client(line.url) as far:
        claim = service.claim()
        for view in far.watch(job.id):
            seen.append(view.fraction or 0.0)
            if view.state is JobState.RUNNING and view.fraction is None:
                line.cut()
                for fraction in (0.25, 0.5):
                    service.queue.beat(claim, JobProgress(stage="train", fraction=fraction))
                service.finish(claim)
        assert line.connections == 2
    assert [fraction for fraction in seen if fraction] == [0.25, 0.5, 0.5]


def test_a_job_that_failed_by_its_input_differs_from_one_that_failed_otherwise(
    service: LocalService, client: Client, clip: Path
) -> None:
    rejected = client.reconstruct(clip)
    service.fail(JobError(problem="one eye only.", field="clip", remedy="Send both."))
    broken = client.reconstruct(clip)
    service.fail(JobError(problem="it diverged."))
    with pytest.raises(JobRejected, match="Send both"):
        client.wait(rejected.id)
    with pytest.raises(JobFailed, match="diverged"):
        client.wait(broken.id)
    assert {job.id for job in client.jobs(JobState.FAILED)} >= {rejected.id, broken.id}
    assert client.retry(broken.id).state is JobState.QUEUED
    with pytest.raises(Conflict):
        client.retry(broken.id)


def test_a_large_clip_uploads_in_pieces_and_resumes_where_the_line_was_cut(
    service: LocalService, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(submission, "PIECE_BYTES", 2**22)
    large = tmp_path / "Smith.mp4"
    small, size = clip.read_bytes(), 3 * 2**22
    with large.open("wb") as file:
        file.write(small + (size - len(small)).to_bytes(4, "big") + b"free")
        file.truncate(size)
    told: list[int] = []
    with line_to(service) as line:

        def on_upload(sent: int, total: int) -> None:
            assert total == size
            if sent > 5 * 2**20 and not any(each > 5 * 2**20 for each in told):
                line.cut()
            told.append(sent)

        with Client(line.url) as far:
            job = far.reconstruct(large, in_pieces=True, on_upload=on_upload)
        assert line.connections == 2
    assert job.input_bytes == size
    assert told[-1] == size
    assert (service.store.spool_folder(job.id) / "clip.mp4").read_bytes() == large.read_bytes()


def test_two_eyes_calibration_and_masks_arrive_as_what_they_are(
    service: LocalService, client: Client, clip: Path, tmp_path: Path
) -> None:
    calibration = tmp_path / "calibration.json"
    calibration.write_bytes(CALIBRATION)
    for in_pieces in (False, True):
        job = client.reconstruct(clip, clip, calibration=calibration, masks=clip, in_pieces=in_pieces)
        spooled = {path.name for path in service.store.spool_folder(job.id).iterdir()}
        assert spooled >= {"left.mp4", "right.mp4", "calibration.json", "masks.mp4"}


def test_the_same_key_is_the_same_job_and_another_is_another(service: LocalService, client: Client, clip: Path) -> None:
    first, again, other = (client.reconstruct(clip, idempotency_key=key) for key in ("a", "a", None))
    assert first.id == again.id != other.id
    with pytest.raises(RequestRefused) as caught:
        client.reconstruct(clip, idempotency_key="a", seed=5)
    assert (caught.value.status, caught.value.field) == (422, "Idempotency-Key")


def test_a_refused_request_names_field_remedy_and_request(client: Client, tmp_path: Path) -> None:
    odd = tmp_path / "clip.exe"
    odd.write_bytes(b"x")
    for in_pieces in (False, True):
        with pytest.raises(RequestRefused) as caught:
            client.reconstruct(odd, in_pieces=in_pieces)
        assert (caught.value.status, caught.value.field) == (422, "clip")
        assert ".mp4" in caught.value.remedy
        assert caught.value.request_id


def test_a_file_that_is_not_there_or_empty_is_a_bad_input(client: Client, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\.mp4"):
        client.reconstruct(tmp_path / "nothing.mp4")
    (tmp_path / "empty.mp4").touch()
    with pytest.raises(InputError, match="is empty"):
        client.reconstruct(tmp_path / "empty.mp4")


@pytest.mark.parametrize("in_pieces", [False, True])
@pytest.mark.parametrize("change", [Path.unlink, lambda path: os.truncate(path, 10)])
def test_a_file_that_is_lost_while_the_clip_is_sent_is_named(
    client: Client, clip: Path, tmp_path: Path, change: Callable[[Path], None], in_pieces: bool
) -> None:
    masks = tmp_path / "masks.mp4"
    masks.write_bytes(clip.read_bytes())
    lost = False

    def lose(sent: int, total: int) -> None:
        nonlocal lost
        if not lost:
            change(masks)
        lost = True

    with pytest.raises(InputError, match=r"masks\.mp4") as caught:
        client.reconstruct(clip, masks=masks, in_pieces=in_pieces, on_upload=lose)
    assert caught.value.field == "masks"


def test_a_key_opens_what_it_may_and_nothing_else(tmp_path: Path, clip: Path) -> None:
    keys = KeyFile(tmp_path)
    _, viewing = keys.create("ward", {KeyScope.VIEW})
    _, both = keys.create("ward")
    with local_service(tmp_path, hosts=("ward.example",)) as service:
        with Client(service.url) as nobody, pytest.raises(Unauthorized):
            nobody.jobs()
        with Client(service.url, api_key=f"{both}\n") as client:
            job = client.reconstruct(clip)
            with pytest.raises(Forbidden, match="purge"):
                client.delete(job.id)
        with Client(service.url, api_key=f"{viewing}\n") as client:
            assert client.job(job.id).id == job.id
            with pytest.raises(Forbidden, match="reconstruct"):
                client.cancel(job.id)
            with client.stream(job.id) as viewer, pytest.raises(Conflict):
                viewer.render()
        with Client(service.url, api_key="isp_wrong") as client, pytest.raises(Unauthorized), client.stream(job.id):
            pass


def test_no_service_is_unavailable_at_once_and_not_ready() -> None:
    with Client("http://127.0.0.1:9") as client:
        assert not client.is_ready()
        for ask in (client.jobs, lambda: client.wait("a"), lambda: client.stream("a")):
            with pytest.raises(ServiceUnavailable, match="intrasplat up"):
                ask()


def test_both_clients_can_do_the_same() -> None:
    def methods(kind: type) -> dict[str, list[str]]:
        found = inspect.getmembers(kind, inspect.isfunction)
        return {name: list(inspect.signature(each).parameters) for name, each in found if not name.startswith("_")}

    blocking, awaited = methods(Client), methods(AsyncClient)
    assert blocking.pop("close") == awaited.pop("aclose")
    assert blocking == awaited
    assert {name for name in blocking if not inspect.getdoc(getattr(Client, name))} == set()
    assert inspect.signature(Client.report).return_annotation == "Report"
