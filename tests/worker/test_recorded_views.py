"""Recorded frames and what they are compared with, the views of either eye: as a worker answers them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.rendering import RecordedRequest, RenderRequest
from intrasplat.clip import DepthClip
from intrasplat.errors import InputError, SceneError
from intrasplat.names import RECORDED, REPORT
from intrasplat.picture import ImageFormat, IntrinsicsOverride, RecordedMasks
from intrasplat.pose import parse_pose
from intrasplat.report import Masks, RightEye
from intrasplat.scene.checkpoint import save_scene
from intrasplat.view.recorded import EYES, recorded_files
from tests.intrasplat.scenes import FRAMES, random_scene
from tests.reports import REPORT_OF_A_SCENE
from worker.reply import NotYetError
from worker.snapshot import Snapshots
from worker.views import Views

LEFT_FROM_RIGHT = np.array([[1.0, 0, 0.01, 4.2], [0, 1, 0, 0.1], [-0.01, 0, 1, 0], [0, 0, 0, 1]])
RIGHT_EYE = RightEye(
    moved_px=1.0,
    lower_px=0.5,
    pitch_deg=0.1,
    yaw_deg=0.0,
    roll_deg=0.0,
    zoom=0.01,
    left_from_right=tuple(LEFT_FROM_RIGHT.flatten().tolist()),
    fx_px=82.0,
    fy_px=83.0,
    cx_px=30.0,
    cy_px=25.0,
    residual_px=0.1,
    gain=(1.0, 1.0, 1.0),
    offset=(0.0, 0.0, 0.0),
    colour_correlation=0.99,
)
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
    (work / RECORDED).write_bytes(recorded_files(clip, EYES[:1], ())[0][RECORDED] or b"")
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
    assert views.cached == ()  # no model is loaded for it
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


def scene_of_two_eyes(store: Store, told: RightEye | None) -> str:
    """A finished scene of an endoscope that moves, whose report tells this of the right eye."""
    job_id = new_job_id()
    work = store.work_folder(job_id, 1)
    report = REPORT_OF_A_SCENE.model_copy(update={"frame_count": FRAMES, "right_eye": told})
    (work / REPORT).write_text(report.model_dump_json())
    save_scene(work, random_scene())
    store.publish_scene(job_id, 1)
    return job_id


@pytest.mark.parametrize("t", [0.0, 0.5, 1.0])
def test_the_right_eyes_view_is_the_one_of_its_pose_and_lens(store: Store, t: float) -> None:
    job_id, views = scene_of_two_eyes(store, RIGHT_EYE), Views(store)
    asked = RenderRequest(scene_id=job_id, attempt=1, t=t, eye="right", format=ImageFormat.NPY)
    shown = views.answer(asked)
    pose = random_scene().world_from_camera[min(round(t * FRAMES), FRAMES - 1)] @ LEFT_FROM_RIGHT
    rows = ",".join(repr(float(each)) for each in pose[:3].flatten())
    lens = {"fx": RIGHT_EYE.fx_px, "fy": RIGHT_EYE.fy_px, "cx": RIGHT_EYE.cx_px, "cy": RIGHT_EYE.cy_px}
    given = {"eye": "left", "pose": parse_pose(rows), "camera": IntrinsicsOverride(**lens)}
    expected = views.answer(asked.model_copy(update=given))
    assert (shown.body, shown.camera) == (expected.body, expected.camera)
    assert views.answer(asked.model_copy(update={"eye": "left"})).body != shown.body
    narrow = views.answer(asked.model_copy(update={"camera": IntrinsicsOverride(width=32)})).camera
    assert narrow is not None
    assert (narrow.width, narrow.height, narrow.fx) == (32, 24, RIGHT_EYE.fx_px / 2)


def test_the_right_eye_of_a_job_that_trains_is_its_clips(store: Store) -> None:
    job_id, snapshots = new_job_id(), Snapshots(patience_s=0)
    snapshots.begin(job_id)
    snapshots.offer(random_scene(), 3)
    asked = RenderRequest(scene_id=job_id, t=0.5, eye="right", format=ImageFormat.NPY)
    views = Views(store, snapshots)
    with pytest.raises(InputError, match="right eye's camera"):
        views.answer(asked)
    snapshots.offer_clip(dataclasses.replace(clip_with_masks(), registration=RIGHT_EYE))
    camera = views.answer(asked).camera
    assert camera is not None
    assert (camera.fx, camera.cx) == (RIGHT_EYE.fx_px, RIGHT_EYE.cx_px)


def test_a_right_eye_that_is_not_known_or_given_with_a_pose_is_refused(store: Store) -> None:
    asked = RenderRequest(scene_id=scene_of_two_eyes(store, None), attempt=1, t=0.5, eye="right")
    with pytest.raises(InputError, match="right eye's camera"):
        Views(store).answer(asked)
    with pytest.raises(InputError, match="exclude each other"):
        Views(store).answer(asked.model_copy(update={"pose": parse_pose("orbit:1,2,3")}))


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
