"""Layer error: the model against the recorded frame of the same moment, of scenes and of jobs that train."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.rendering import RecordedRequest, RenderRequest
from intrasplat.colours import ERROR_COLOURS
from intrasplat.errors import InputError
from intrasplat.names import RECORDED, REPORT
from intrasplat.picture import BRIGHTEST_ERROR, ImageFormat, IntrinsicsOverride, Layer, RecordedMasks
from intrasplat.pose import parse_pose
from intrasplat.scene.checkpoint import save_scene
from intrasplat.view.recorded import EYES, recorded_files
from tests.intrasplat.scenes import FRAMES, random_scene
from tests.worker.test_recorded_views import REPORT_OF_IT, clip_with_masks
from worker.reply import Reply
from worker.views import Views


@pytest.fixture
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return Store(tmp_path_factory.mktemp("data"))


def stored(store: Store, *, keeps_frames: bool = True) -> str:
    job_id = new_job_id()
    work = store.work_folder(job_id, 1)
    (work / REPORT).write_text(REPORT_OF_IT)
    if keeps_frames:
        (work / RECORDED).write_bytes(recorded_files(clip_with_masks(), EYES[:1], ())[0][RECORDED] or b"")
    save_scene(work, random_scene())
    store.publish_scene(job_id, 1)
    return job_id


def array(reply: Reply) -> NDArray[np.float32]:
    found: NDArray[np.float32] = np.load(io.BytesIO(reply.body)).astype(np.float32)
    return found


def picture(reply: Reply, flags: int = cv2.IMREAD_COLOR) -> NDArray[np.uint8]:
    found = cv2.imdecode(np.frombuffer(reply.body, np.uint8), flags)
    assert found is not None
    return np.asarray(found[..., ::-1] if flags == cv2.IMREAD_COLOR else found, np.uint8)


def test_the_error_is_the_difference_of_model_and_recorded_frame_at_the_frames_own_time(store: Store) -> None:
    scene, views = stored(store), Views(store)
    between = 3.3 / FRAMES
    asked = RenderRequest(scene_id=scene, attempt=1, t=between, layer=Layer.ERROR, format=ImageFormat.NPY)
    reply = views.answer(asked)
    found = array(reply)
    assert reply.t == 3 / FRAMES
    as_recorded = {"layer": Layer.RGB, "t": 3 / FRAMES, "light": "recorded", "smoke": "show", "detail": "off"}
    model = array(views.answer(asked.model_copy(update=as_recorded)))
    frame = RecordedRequest(scene_id=scene, attempt=1, t=between, masks=RecordedMasks.OFF)
    recorded = picture(views.answer(frame)).astype(np.float32)
    tool = picture(views.answer(frame.model_copy(update={"masks": RecordedMasks.ONLY})), cv2.IMREAD_GRAYSCALE) > 0
    height, width = found.shape
    resized = cv2.resize(recorded, (width, height), interpolation=cv2.INTER_LINEAR)
    tool = cv2.resize(tool.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    known = np.isfinite(found)
    assert 0 < known.sum() < known.size
    assert not known[tool].any()  # an instrument is no error of the model
    np.testing.assert_allclose(found[known], np.abs(model - resized).mean(axis=2)[known], atol=1e-3)

    shown = picture(views.answer(asked.model_copy(update={"format": ImageFormat.JPEG, "quality": 100})))
    signed = np.nan_to_num(found) * np.sign((model - resized).mean(axis=2)) / BRIGHTEST_ERROR
    darker, alike, brighter = np.frombuffer(ERROR_COLOURS, np.uint8).reshape(3, 3).astype(float)
    shares = np.clip(np.abs(signed), 0, 1)[..., None]
    colours = alike + shares * (np.where(signed[..., None] < 0, darker, brighter) - alike)
    assert (signed[known] < -0.1).any()
    assert (signed[known] > 0.1).any()
    inner = cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert inner.any()
    assert np.abs(shown[inner] - colours[inner]).mean() < 8  # of the encoder
    outer = cv2.erode((~known).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert shown[outer].max() < 100  # the hatch
    levels = picture(views.answer(asked.model_copy(update={"format": ImageFormat.PNG})), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(levels, np.rint(np.nan_to_num(found)))


def test_an_error_needs_the_endoscopes_own_view_and_recorded_frames(store: Store) -> None:
    views = Views(store)
    asked = RenderRequest(scene_id=stored(store), attempt=1, t=0.5, layer=Layer.ERROR, format=ImageFormat.NPY)
    for changed, field in ({"pose": parse_pose("orbit:5,0,1")}, "pose"), ({"camera": IntrinsicsOverride(fx=9)}, "fx"):
        with pytest.raises(InputError) as refused:
            views.answer(asked.model_copy(update=changed))
        assert refused.value.field == field
    small = views.answer(asked.model_copy(update={"camera": IntrinsicsOverride(width=24)}))
    assert array(small).shape[1] == 24
    with pytest.raises(InputError, match="recorded") as refused:  # the scene is there, and has other layers
        views.answer(asked.model_copy(update={"scene_id": stored(store, keeps_frames=False)}))
    assert refused.value.field == "layer"
