"""Recorded frames as a worker answers them: of the job that trains, and of scenes that keep them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.errors import InputError, SceneError
from contract.wire.names import RECORDED, REPORT
from contract.wire.rendering import RecordedMasks, RecordedRequest
from contract.wire.report import Masks
from tests.reports import REPORT_OF_A_SCENE
from tests.worker.scenes import FRAMES, random_scene
from worker.daemon.serve import NotYetError
from worker.daemon.snapshot import Snapshots
from worker.daemon.views import Views
from worker.input.clip import DepthClip
from worker.render.recorded import EYES, kept_frames
from worker.scene.checkpoint import save_scene

REPORT_OF_IT = REPORT_OF_A_SCENE.model_copy(update={"frame_count": FRAMES}).model_dump_json()


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


def test_recorded_frames_are_of_the_job_that_trains_and_of_its_scene(store: Store) -> None:
    job_id, snapshots = new_job_id(), Snapshots(patience_s=0)
    clip, views = clip_with_masks(), Views(store, snapshots)
    live, kept = (RecordedRequest(scene_id=job_id, attempt=attempt, t=0.5) for attempt in (None, 1))
    snapshots.begin(job_id)
    with pytest.raises(NotYetError):
        views.answer(live)
    snapshots.offer_clip(clip)
    shown = views.answer(live)
    assert (shown.t, shown.iteration, shown.media_type) == (0.5, 0, "image/jpeg")
    work = store.work_folder(job_id, 1)
    (work / REPORT).write_text(REPORT_OF_IT)
    (work / RECORDED).write_bytes(kept_frames(clip, EYES[:1])[0])
    save_scene(work, random_scene())
    store.publish_scene(job_id, 1)
    for masks in RecordedMasks:
        shown = views.answer(live.model_copy(update={"masks": masks}))
        again = views.answer(kept.model_copy(update={"masks": masks}))
        assert again.media_type == shown.media_type == ("image/png" if masks is RecordedMasks.ONLY else "image/jpeg")
        assert (again.t, again.iteration) == (0.5, None)
        if masks is not RecordedMasks.MARKED:  # marks are drawn on what the JPEG has kept
            assert again.body == shown.body
    with pytest.raises(InputError, match="right eye"):
        views.answer(kept.model_copy(update={"eye": "right"}))
    assert views.held == ()  # no model is loaded for it
    snapshots.drop(job_id)
    with pytest.raises(NotYetError):
        views.answer(live)
    store.purge(job_id)
    with pytest.raises(SceneError):
        views.answer(kept)


def test_a_scene_that_keeps_no_recorded_frames_says_so(store: Store) -> None:
    job_id = new_job_id()
    work = store.work_folder(job_id, 1)
    (work / REPORT).write_text(REPORT_OF_IT)
    save_scene(work, random_scene())
    store.publish_scene(job_id, 1)
    with pytest.raises(SceneError, match="keeps no recorded frames"):
        Views(store).answer(RecordedRequest(scene_id=job_id, attempt=1, t=0.0))


def clip_with_masks() -> DepthClip:
    tissue = np.ones((FRAMES, 48, 64), np.bool_)
    tissue[:, :, :20] = False
    return DepthClip(
        rgb=np.full((*tissue.shape, 3), 120, np.uint8),
        tissue=tissue,
        depth_mm=np.zeros(tissue.shape, np.float32),
        depth_confidence=np.zeros(tissue.shape, np.uint8),
        intrinsics=random_scene().intrinsics,
        world_from_camera=np.tile(np.eye(4), (FRAMES, 1, 1)),
        frame_times_s=np.arange(FRAMES) / 25,
        masks=Masks(source="found", share=0.3, sure=0.9),
    )
