"""The player in a browser adds the detail of recorded frames to its views as a worker does."""

from __future__ import annotations

import base64
import dataclasses
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selenium import webdriver

from intrasplat.motion.veil import Veil
from intrasplat.motion.vignetting import Vignetting
from intrasplat.names import DETAIL, RECORDED
from intrasplat.scene.checkpoint import load_scene, save_scene
from intrasplat.scene.recorded_file import EYES, MASK, name_of
from intrasplat.scene.recorded_video import RecordedEye, encoded
from intrasplat.scene.scene import TrainedScene
from intrasplat.scene.training_pictures import coded
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.render import render_frame
from intrasplat.view.renderer import renderer_of
from tests.client.player import Seen, drawing_browser, player_page
from tests.client.test_player import LEAST_DB, RIGHT_EYE_MM, scattered

SIZE = (127, 95)
"""Odd, so that the video's pictures are larger than the eye's."""


@pytest.fixture(scope="module")
def driver() -> Iterator[webdriver.Chrome]:
    with drawing_browser() as driver:
        yield driver


def texture(frame: int, eye: int) -> NDArray[np.float32]:
    """[h, w, 3] of what the model misses: stripes that move, and a spot that one eye sees alone."""
    width, height = SIZE
    y, x = np.mgrid[:height, :width].astype(np.float32)
    wave = np.sin((x + 1.5 * frame - 6 * eye) / 4) * np.cos((y - frame) / 5)
    spot = np.exp(-((x - 40 - 20 * eye) ** 2 + (y - 50) ** 2) / 60)
    return np.asarray(0.08 * wave[..., None] + 0.2 * spot[..., None] * (1.0, 0.8, 0.3), np.float32)


def stored(folder: Path, scene: TrainedScene, eyes: int, *, is_masked: bool = True) -> TrainedScene:
    """The scene with recorded frames: what it shows in their light, with a texture, and perhaps an instrument."""
    lens = scene.intrinsics.resized(*SIZE)
    right = np.eye(4)
    right[:3, 3] = RIGHT_EYE_MM
    cameras = [RecordedEye(lens, np.eye(4)), RecordedEye(dataclasses.replace(lens, cx=lens.cx + 1.5), right)][:eyes]
    renderer = renderer_of(scene)

    def recorded(eye: int, frame: int) -> NDArray[np.uint8]:
        t = frame / scene.frame_count
        seen = renderer.seen_from(t, endoscope_pose(scene, t) @ cameras[eye].left_from_eye, cameras[eye].lens)
        return np.asarray(np.clip((seen.rgb + texture(frame, eye)) * 255 + 0.5, 0, 255), np.uint8)

    video = encoded(scene.trained_frames, cameras, lambda eye, frame: coded(recorded(eye, frame)))
    assert video is not None
    tool = np.zeros(SIZE[::-1], np.uint8)
    tool[:30, -40:] = 255
    png = cv2.imencode(".png", np.dstack([tool] * 4))[1].tobytes()
    content = BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for eye in EYES[:eyes] if is_masked else ():
            for frame in scene.trained_frames:
                archive.writestr(name_of(eye, frame, MASK), png)
    save_scene(folder, scene, {DETAIL: video, RECORDED: content.getvalue()})
    return load_scene(folder)


def in_recorded_light(scene: TrainedScene) -> TrainedScene:
    """The scene, recorded through smoke by a camera that adapts, and that darkens the picture's border."""
    count = scene.frame_count
    gains = np.linspace(-0.3, 0.3, count)[:, None] * (1.0, 0.8, 1.1)
    thickness = np.random.default_rng(0).uniform(0, 1, (count, 3, 4)).astype(np.float32)
    depth_mm = 60 / scene.units_per_mm
    light = {
        "log_gains": gains.tolist(),
        "vignetting": Vignetting(2.0, 0.8).stored(),
        "veil": Veil(thickness, np.array([0.7, 0.75, 0.8], np.float32), depth_mm).stored(),
        "motion_error": 40.0,
    }
    return dataclasses.replace(scene, settings={**scene.settings, **light})


@pytest.mark.parametrize(("eyes", "is_lit"), [(2, False), (1, False), (2, True)])
def test_the_player_adds_the_detail_that_a_worker_does(
    driver: webdriver.Chrome, tmp_path: Path, eyes: int, is_lit: bool
) -> None:
    model = scattered(14 if eyes == 2 else 13, moves=True)
    model = dataclasses.replace(model, trained_t=(0.0, 1 / 3, 2 / 3))
    scene = stored(tmp_path, in_recorded_light(model) if is_lit else model, eyes)
    first, second = scene.trained_frames[1:]
    recorded, between = first / scene.frame_count, (0.6 * first + 0.4 * second) / scene.frame_count
    with player_page(driver, tmp_path) as page:
        page.load()
        for t in (recorded, between):
            for seen in (
                Seen(t),
                Seen(t, orbit=(5.0, 0.0, 1.0)),
                Seen(t, orbit=(-8.0, 6.0, 1.0)),
                Seen(t, eye="right"),
            ):
                compared = page.compare(scene, seen, 2.0)
                assert compared.psnr_db >= LEAST_DB, seen
            plain = render_frame(scene, t, None, scene.intrinsics.resized(128, 96), detail="off").rgb
            gained = page.compare(scene, Seen(t, is_marked=False), 2.0).drawn.astype(np.float64) - plain
            assert np.abs(gained).mean() > 2


FLOW = """
const { opticalFlow } = await import("/player/flow.js");
const [first, second] = given.slice(0, 2).map((text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)));
const { u, v } = opticalFlow(first, second, given[2], given[3]);
return [[...u], [...v]];
"""


@pytest.mark.parametrize("size", [(320, 256), (201, 150), (64, 48)])
def test_the_player_finds_the_flow_that_opencv_finds(
    driver: webdriver.Chrome, tmp_path: Path, size: tuple[int, int]
) -> None:
    width, height = size
    noise = np.random.default_rng(0).random((height + 20, width + 20)).astype(np.float32)
    whole = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    moved = cv2.remap(whole, x + 10 - 2.3 * np.sin(y / 40), y + 10 + 1.5 * np.cos(x / 50), cv2.INTER_LINEAR)
    first, second = (each.round().astype(np.uint8) for each in (whole[10:-10, 10:-10], moved))
    preset = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    known = preset.calc(np.ascontiguousarray(first), second, np.zeros((height, width, 2), np.float32))
    with player_page(driver, tmp_path) as page:
        texts = [base64.b64encode(each.tobytes()).decode() for each in (first, second)]
        found = np.array(page.run(FLOW, *texts, width, height)).reshape(2, height, width).transpose(1, 2, 0)
    assert np.abs(known).mean() > 0.8
    assert np.abs(found - known).mean() < 0.01
