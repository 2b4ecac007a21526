"""AsyncClient against a real service: what Client does, without blocking the event loop."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from contract.wire.job import JobProgress
from intrasplat_client import (
    AsyncClient,
    InputError,
    JobCancelled,
    JobState,
    NotFound,
    RequestRefused,
    ServiceUnavailable,
    Unauthorized,
    submission,
)
from tests.client.local_service import LocalService, line_to


def test_a_clip_becomes_a_scene_while_other_work_goes_on(service: LocalService, clip: Path) -> None:
    async def use() -> None:
        async with AsyncClient(service.url) as client:
            assert await client.is_ready()
            job = await client.reconstruct(clip, iterations=30)
            waiting = asyncio.create_task(client.wait(job.id))
            assert (await client.job(job.id)).state is JobState.QUEUED
            assert job.id in {each.id for each in await client.jobs(JobState.QUEUED)}
            await asyncio.to_thread(service.finish)
            assert (await waiting).state is JobState.DONE
            assert (await client.report(job.id)).psnr_tissue_db == 36.2
            assert (await client.curve(job.id)).startswith("t_train_s")
            assert await client.export(job.id) == b"ply\n"
            assert job.id in {scene["id"] for scene in await client.scenes()}
            values = await client.render_array(t=0.5, scene=job.id, layer="depth")
            np.testing.assert_array_equal(values, np.full((4, 6), 0.5, np.float32))
            image = await client.render(scene=job.id)
            assert await client.render(scene=job.id, known=image) is image
            assert (await client.delete(job.id))["verified"]
            with pytest.raises(NotFound):
                await client.job(job.id)
            assert (await client.info())["name"] == "intrasplat"

    asyncio.run(use())


def test_many_views_come_over_one_connection(service: LocalService, clip: Path) -> None:
    async def use() -> None:
        async with AsyncClient(service.url) as client:
            job = await client.reconstruct(clip)
            await asyncio.to_thread(service.finish)
            async with client.stream(job.id) as viewer:
                for t in (0.0, 1.0):
                    assert (await viewer.render(t, format="npy")).array()[0, 0] == t
                assert (await viewer.render(unseen="mark")).unseen == 0.25
                assert (await viewer.render(unseen="guess")).unseen == 0.0
                assert (await viewer.render(1.0, format="npy", highlights="off")).array()[0, 0] == -1.0
                with pytest.raises(RequestRefused, match="yaw"):
                    await viewer.render(pose="orbit:999,0,1")
        async with AsyncClient(service.url, api_key="isp_wrong") as client:
            with pytest.raises(Unauthorized):
                async with client.stream(job.id):
                    pass

    asyncio.run(use())


def test_a_watch_that_is_cut_off_resumes_and_misses_nothing(service: LocalService, clip: Path) -> None:
    async def use() -> list[float | None]:
        seen = []
        async with AsyncClient(line.url) as far:
            job = await far.reconstruct(clip)
            claim = service.claim()
            async for view in far.watch(job.id):
                seen.append(view.fraction)
                if view.state is JobState.RUNNING and view.fraction is None:
                    line.cut()
                    service.queue.beat(claim, JobProgress(stage="train", fraction=0.5))
                    service.finish(claim)
        return seen

    with line_to(service) as line:
        assert [fraction for fraction in asyncio.run(use()) if fraction] == [0.5, 0.5]
        assert line.connections >= 2


def test_an_upload_in_pieces_resumes_where_the_line_was_cut(
    service: LocalService, clip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = clip.stat().st_size
    monkeypatch.setattr(submission, "PIECE_BYTES", size // 3)
    monkeypatch.setattr(submission, "READ_BYTES", size // 20)
    told: list[int] = []

    async def use() -> str:
        async with AsyncClient(line.url) as far:
            return (await far.reconstruct(clip, in_pieces=True, on_upload=on_upload)).id

    def on_upload(sent: int, total: int) -> None:
        if sent > total // 2 and not any(each > total // 2 for each in told):
            line.cut()
        told.append(sent)

    with line_to(service) as line:
        job_id = asyncio.run(use())
        assert line.connections == 2
    assert told[-1] == size
    assert (service.store.spool_folder(job_id) / "clip.mp4").read_bytes() == clip.read_bytes()


def test_errors_are_the_same(service: LocalService, clip: Path, tmp_path: Path) -> None:
    async def use() -> None:
        async with AsyncClient(service.url) as client:
            with pytest.raises(InputError, match="cannot be read"):
                await client.reconstruct(tmp_path / "nothing.mp4")
            job = await client.reconstruct(clip, idempotency_key="async", seed=1)
            with pytest.raises(RequestRefused, match="Idempotency-Key"):
                await client.reconstruct(clip, idempotency_key="async", seed=2)
            await client.cancel(job.id)
            with pytest.raises(JobCancelled):
                await client.wait(job.id)
        async with AsyncClient("http://127.0.0.1:9") as nobody:
            assert not await nobody.is_ready()
            with pytest.raises(ServiceUnavailable, match="intrasplat up"):
                await nobody.wait("a")

    asyncio.run(use())
