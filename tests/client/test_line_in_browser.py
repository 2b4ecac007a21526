"""Slow lines in a real browser: pictures of a view that moves are small enough to come, and full when it rests."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
from selenium import webdriver

from contract.wire.cameras import CamerasRequest, ClipCamera
from contract.wire.rendering import PictureCamera, RenderRequest, SceneRequest
from tests.cameras import CAMERAS, cameras_reply
from tests.client.page import Page, Painter, site_at
from tests.client.slow_line import slow_line
from worker.reply import Reply

WIDTH, HEIGHT = 674, 540
BIT_PER_S, LATENCY_S = 400_000, 0.4
WATCHED_S = 8.0
MIN_RATE_HZ = 2.0
LENS = ClipCamera(width=WIDTH, height=HEIGHT, fx=700, fy=700, cx=337, cy=270)
WATCH = """
window.pictures = [];
import(document.scripts[0].src).then(({ viewer }) => viewer.addEventListener("shown", () =>
  pictures.push([performance.now() / 1000, viewer.parts.canvas.width])));
"""


def texture() -> np.ndarray:
    """As hard to code as tissue: about 90 kB as a JPEG of usual quality."""
    noise = np.random.default_rng(0).normal(128, 40, (HEIGHT, WIDTH, 3)).astype(np.float32)
    fine, coarse = cv2.GaussianBlur(noise, (0, 0), 0.9), cv2.GaussianBlur(noise, (0, 0), 12) * 6 - 640
    return np.asarray(np.clip(0.5 * fine + 0.5 * coarse, 0, 255), np.uint8)


class TissuePainter(Painter):
    """Paints tissue in the size and quality that is asked for."""

    def answer(self, request: SceneRequest) -> Reply:
        if isinstance(request, CamerasRequest):
            return cameras_reply(request, CAMERAS.model_copy(update={"intrinsics": LENS}))
        if not isinstance(request, RenderRequest):
            return super().answer(request)
        size = request.camera.size(WIDTH, HEIGHT)
        picture = cv2.resize(texture(), size, interpolation=cv2.INTER_AREA)
        body = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, request.quality])[1].tobytes()
        scaled = {name: value * size[0] / WIDTH for name, value in LENS.model_dump().items()}
        camera = PictureCamera.model_validate(
            {**scaled, "width": size[0], "height": size[1], "world_from_camera": (1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0)}
        )
        return Reply(body, "image/jpeg", request.t, camera=camera)


def test_a_slow_line_shows_a_moving_picture_and_a_full_one_at_rest(tmp_path: Path, driver: webdriver.Chrome) -> None:
    with (
        site_at(tmp_path / "data", TissuePainter().answer) as site,
        slow_line(int(site.url.rpartition(":")[2]), BIT_PER_S, LATENCY_S) as port,
    ):
        site.scene()
        page = Page(driver, f"http://127.0.0.1:{port}")
        page.open()
        page.until_state("live")
        page.until(lambda: page.script("return document.querySelector('#picture').width") == WIDTH)
        page.script(WATCH)
        page.until(lambda: not page.script("return document.querySelector('#play').disabled"))
        site.announce()  # its worker lives
        page.click("#play")
        time.sleep(WATCHED_S)
        site.announce()
        pictures = page.script("return pictures")
        page.click("#play")
        began_s, ended_s = pictures[0][0], pictures[-1][0]
        print(f"{(len(pictures) - 1) / (ended_s - began_s):.1f} pictures a second, {pictures[-1][1]} pixels wide")
        assert (len(pictures) - 1) / (ended_s - began_s) >= MIN_RATE_HZ
        assert ended_s - began_s > WATCHED_S / 2
        assert pictures[-1][1] < WIDTH
        page.until(lambda: page.script("return document.querySelector('#picture').width") == WIDTH)
        assert page.faults() == []
        driver.get("about:blank")
