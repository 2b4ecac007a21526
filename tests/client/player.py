"""The page's player in a browser, beside the pictures that a worker renders."""

from __future__ import annotations

import base64
import functools
import http.server
import threading
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from selenium import webdriver

from client.page import DASHBOARD
from intrasplat.names import RECORDED
from intrasplat.pose import parse_pose
from intrasplat.scene.recorded_file import MASK
from intrasplat.scene.scene import TrainedScene
from intrasplat.view.camera import pose_of
from intrasplat.view.render import render_frame
from intrasplat.view.unseen import hatched
from service.guard import ANSWER_HEADERS
from tests.client.page import GRAPHICS, browser

Picture = NDArray[np.uint8]

SCRIPT_TIMEOUT_S = 300
PAGE, SCENES = "/icon.svg", "/scene/"
TIE_LEVELS = 24
"""Levels by which no pixel may differ, unless two Gaussians at one depth are blended the other way round."""
RUN = """
const [done, given] = [arguments[arguments.length - 1], [...arguments].slice(0, -1)];
(async () => { %s })().then(done, (error) => done({ error: String(error?.stack ?? error) }));
"""
DECODE = """
const { readTable } = await import("/player/table.js");
const file = await (await fetch(given[0] + "scene.safetensors")).arrayBuffer();
const { count, tables } = await readTable(file);
"""
READ = f"""{DECODE}
const columns = tables.map((each) => each.length / count);
const whole = new Int32Array(count * columns.reduce((a, b) => a + b));
for (let n = 0, at = 0; n < count; n++) {{
  tables.forEach((each, part) => {{
    whole.set(each.subarray(n * columns[part], (n + 1) * columns[part]), at);
    at += columns[part];
  }});
}}
const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", whole));
return {{ sha256: [...digest].map((byte) => byte.toString(16).padStart(2, "0")).join("") }};
"""
LOAD = """
const { Player } = await import("/player/player.js");
const manifest = await (await fetch(given[0] + "manifest.json")).json();
const scene = await (await fetch(given[0] + "scene.safetensors")).arrayBuffer();
window.player?.close();
window.player = await Player.of({ manifest, scene }, new OffscreenCanvas(1, 1));
if (player.hasDetail) {
  const { Detail } = await import("/player/detail.js");
  const video = new Uint8Array(await (await fetch(given[0] + "detail.mkv")).arrayBuffer());
  const mask = async (eye, frame) => {
    const answer = await fetch(`${given[0]}${["left", "right"][eye]}/${String(frame).padStart(6, "0")}.png`);
    return answer.ok ? answer.blob() : null;
  };
  const source = { bytes: video.length, read: async (first, end) => video.slice(first, end), mask };
  player.takeDetail(() => Detail.of(player, source));
}
return player.times;
"""
DRAW = """
const [{ t, orbit, eye, width, height, highlights, isMarked, isTimed }] = given;
const shown = player.cameras.shownTime(t);
const own = eye === "right" ? player.cameras.rightEye(shown) : player.cameras.endoscope(shown);
const pose = orbit ? player.cameras.orbit(...orbit) : own;
const drawn = await player.draw({ t, pose, width, height, highlights, isMarked, isTimed, isRefined: player.hasDetail });
const pixels = player.pixels();
let text = "";
for (let i = 0; i < pixels.length; i += 8192) text += String.fromCharCode(...pixels.subarray(i, i + 8192));
return { ...drawn, pose, pixels: btoa(text), times: player.times };
"""


@dataclass(frozen=True)
class Seen:
    """A view: orbit (yaw, pitch in degrees, zoom; x, y, z of the point looked at), or one of the endoscope's eyes."""

    t: float = 0.0
    orbit: tuple[float, ...] | None = None
    eye: str = "left"
    highlights: bool = True
    is_marked: bool = True


@dataclass(frozen=True, eq=False)
class Compared:
    """A picture of the player beside the worker's: [H, W, 3] each."""

    drawn: Picture
    rendered: Picture
    codes: tuple[list[str], list[str]]
    unseen: tuple[float, float]
    times: dict[str, float]

    @property
    def psnr_db(self) -> float:
        error = (self.drawn.astype(np.float64) - self.rendered) ** 2
        return float(10 * np.log10(255**2 / max(error.mean(), 1e-9)))

    @property
    def levels(self) -> NDArray[np.int64]:
        """[H, W] largest difference of a channel."""
        return np.abs(self.drawn.astype(np.int64) - self.rendered).max(-1)


class PlayerPage:
    """A page of the service's origin and policy, in which the player's modules run."""

    def __init__(self, driver: webdriver.Chrome, url: str) -> None:
        self._driver = driver
        driver.set_script_timeout(SCRIPT_TIMEOUT_S)
        driver.get(url + PAGE)

    def run(self, source: str, *given: object) -> Any:
        """What the script's function returns; AssertionError if it throws."""
        answer = self._driver.execute_async_script(RUN % source, *given)  # type: ignore[no-untyped-call]
        assert not (isinstance(answer, dict) and "error" in answer), answer["error"]
        return answer

    def read(self) -> dict[str, Any]:
        """The table as the player decodes it: its SHA-256 as int32 [N, K]."""
        found: dict[str, Any] = self.run(READ, SCENES)
        return found

    def decode(self) -> None:
        """Download and decode the scene, no more."""
        self.run(DECODE, SCENES)

    def load(self) -> dict[str, float]:
        """Load the scene into the player; milliseconds."""
        times: dict[str, float] = self.run(LOAD, SCENES)
        return times

    def compare(self, scene: TrainedScene, seen: Seen, scale: float = 1.0, *, is_timed: bool = False) -> Compared:
        """A view of the scene that is loaded, drawn by both."""
        camera = scene.intrinsics
        camera = camera.resized(round(camera.width * scale), round(camera.height * scale))
        asked = {
            "t": seen.t,
            "orbit": seen.orbit,
            "eye": seen.eye,
            "highlights": seen.highlights,
            "isMarked": seen.is_marked,
            "width": camera.width,
            "height": camera.height,
            "isTimed": is_timed,
        }
        answer = self.run(DRAW, asked)
        pixels = np.frombuffer(base64.b64decode(answer["pixels"]), np.uint8)
        pose = None if seen.eye == "left" else np.array(answer["pose"])
        if seen.orbit is not None:
            pose = pose_of(scene, parse_pose(f"orbit:{','.join(map(str, seen.orbit))}"))
        frame = render_frame(scene, seen.t, pose, camera, highlights=seen.highlights)
        return Compared(
            drawn=pixels.reshape(camera.height, camera.width, 4)[..., :3],
            rendered=hatched(frame.rgb, frame.unseen) if seen.is_marked else frame.rgb,
            codes=([each["code"] for each in answer["warnings"]], [each.code.value for each in frame.warnings]),
            unseen=(answer["unseen"], frame.unseen_share),
            times=answer["times"],
        )


class _Files(http.server.SimpleHTTPRequestHandler):
    """The dashboard's files, and a scene's and its masks under SCENES, with the headers of the service."""

    def __init__(self, *arguments: Any, scene: Path) -> None:
        self._scene = scene
        super().__init__(*arguments)

    def translate_path(self, path: str) -> str:
        if path.startswith(SCENES):
            return str(self._scene / Path(path).name)
        return str(DASHBOARD / path.lstrip("/"))

    def do_GET(self) -> None:
        if not (self.path.startswith(SCENES) and self.path.endswith(f".{MASK}")):
            return super().do_GET()
        try:
            with zipfile.ZipFile(self._scene / RECORDED) as archive:
                content = archive.read(self.path.removeprefix(SCENES))
        except KeyError:
            return self.send_error(HTTPStatus.NOT_FOUND)
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def end_headers(self) -> None:
        for name, value in ANSWER_HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *arguments: Any) -> None:
        pass


@contextmanager
def player_page(driver: webdriver.Chrome, scene: Path) -> Iterator[PlayerPage]:
    """A page for the scene in a folder."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Files, scene=scene)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield PlayerPage(driver, f"http://127.0.0.1:{server.server_address[1]}")
        finally:
            driver.get("about:blank")
            server.shutdown()
            thread.join()


@contextmanager
def drawing_browser() -> Iterator[webdriver.Chrome]:
    """A browser that draws on the processor."""
    with browser(GRAPHICS) as driver:
        yield driver
