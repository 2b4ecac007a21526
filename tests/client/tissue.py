"""A worker that paints what is as hard to code as tissue, a slow line, and what a page shows over it."""

from __future__ import annotations

import cv2
import numpy as np

from contract.wire.cameras import CamerasRequest, ClipCamera
from contract.wire.rendering import PictureCamera, RenderRequest, SceneRequest
from tests.cameras import CAMERAS, cameras_reply
from tests.client.page import Painter
from worker.reply import Reply

WIDTH, HEIGHT = 674, 540
BIT_PER_S, LATENCY_S = 400_000, 0.4
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
