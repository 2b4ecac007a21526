"""What the tests of the page stand on: a service that can end and come back, a painter, and a browser."""

# long: an installation, its painter and its browser, which every test of the page needs together
from __future__ import annotations

import contextlib
import io
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

from client.page import DASHBOARD
from contract.queue.embedded import short_socket_path
from contract.queue.interface import Claim
from contract.runtime.settings import Settings
from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.cameras import CamerasRequest
from contract.wire.job import JobFiles, JobProgress, JobRecord
from contract.wire.rendering import (
    ExportRequest,
    MeasureRequest,
    PictureCamera,
    RecordedRequest,
    RenderRequest,
    SceneRequest,
    WorkerAddress,
)
from intrasplat.errors import InputError, SceneError
from intrasplat.names import CURVE, MANIFEST, REPORT, Eye, Light, Smoke
from intrasplat.notices import Notice, NoticeCode
from intrasplat.picture import MEDIA_TYPES, Highlights, ImageFormat, Layer, Unseen
from intrasplat.pose import OrbitPose
from intrasplat.report import DetailScores, LightChanges, Report
from intrasplat.scene.checkpoint import save_scene
from intrasplat.scene.scene import TrainedScene
from service.app import create_app
from service.renderer import ZmqRenderer
from service.server import Server
from tests.answers import at_once
from tests.cameras import CAMERAS, cameras_reply
from tests.measurements import RANGE_MM, measurement_reply
from tests.memory_queue import MemoryQueue
from tests.reports import REPORT_OF_A_SCENE, a_warning
from worker.pace import RenderPace
from worker.reply import Reply
from worker.serve import RequestServer

CHROMIUM, CHROMEDRIVER = shutil.which("chromium"), shutil.which("chromedriver")
CALIBRATION = DASHBOARD / "example" / "calibration.json"
WAIT_S = 15.0
MAX_WAIT_S = 1.0
LOOK_S = 0.05
WORKER = "worker-1"
SNAPSHOT_ITERATION = 40
CAMERA = PictureCamera(
    width=60, height=48, fx=80, fy=80, cx=30, cy=24, world_from_camera=(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0)
)
DEPTH_MM = 50.0
RECORDED_SHADE = 8
"""Darker than any scene."""
FAR_DEG = 25.0
FAR_OUT_ZOOM = 0.9
UNSEEN = "No frame saw 12% of this view."
HIGHLIGHTS_STAY = "This scene was taught by one eye."
FAR = "This pose is far from the endoscope's: most of it is a guess."
CURVE_OF_THE_PAGE = "t_train_s,iteration,psnr_tissue_db,psnr_right_db\n1,10,27,\n2,50,30,27.5\n3,100,31.2,28.4\n"
REPORT_OF_THE_PAGE = REPORT_OF_A_SCENE.model_copy(
    update={
        "psnr_tissue_db": 31.2,
        "baseline_blend_db": 29.0,
        "baseline_flow_db": 29.5,
        "psnr_right_db": 28.4,
        "baseline_warp_db": 28.6,
        "psnr_clear_db": 33.0,
        "psnr_right_clear_db": 30.1,
        "detail": DetailScores(psnr_tissue_db=32.4, psnr_right_db=29.6, ssim=0.95),
        "coverage": 0.97,
        "depth_agreement_mm": 0.8,
        "gaussians": 31000,
        "warnings": (a_warning("The clip is short."),),
        "assumptions": (Notice.info(NoticeCode.MASKS, "Bright in the masks is the instrument."),),
        "seconds": {"t_train_s": 12.5},
        "light": LightChanges(
            reference=3, stops=(0.5,) * 12, red=(1.1,) * 12, blue=(0.9,) * 12, smoke_share=(0.2,) * 12, vignetting=0.6
        ),
    }
)


def first_report_of_the_page() -> Report:
    """Before the scores are known."""
    scores = ("psnr", "baseline", "detail", "depth_agreement")
    figures = [name for name in Report.model_fields if name.startswith(scores)]
    return REPORT_OF_THE_PAGE.model_copy(update={**dict.fromkeys(figures), "scored": False})


def grey_of(job_id: str) -> int:
    """The one shade in which a scene is painted, 16 steps or more from white and black."""
    return 16 + int(job_id[:2], 16) * 7 // 8


def depth_of(request: RenderRequest) -> bytes:
    """[H, W] float32 mm as NPY: DEPTH_MM everywhere; nothing right of the clip's middle."""
    width, height, cx = request.camera.width or CAMERA.width, request.camera.height or CAMERA.height, request.camera.cx
    middle = CAMERA.cx if cx is None else cx
    columns = np.arange(width) + 0.5
    depth_mm = np.where(columns <= middle, np.float32(DEPTH_MM), np.float32(0))
    buffer = io.BytesIO()
    np.save(buffer, np.tile(depth_mm, (height, 1)).astype(np.float32))
    return buffer.getvalue()


class Painter:
    """Paints each scene in a shade of its own, and warns of what lies far off, or beyond the picture's borders."""

    def __init__(self) -> None:
        self.pause_s = 0.0
        self.warnings: list[Notice] = []
        """Of every picture."""
        self.unseen_share = 0.0
        """Of pictures without the warning."""
        self.shown_unseen: Unseen | None = None
        self.shown_highlights: Highlights | None = None
        self.eye: Eye = "left"
        self.light: tuple[Light, Smoke] = ("steady", "remove")
        """Of the newest picture."""
        self.asked: RenderRequest | None = None
        self.lacks_frames = False
        """Whether nothing recorded can be compared with."""
        self.not_recorded: str | None = None
        """The scene without recorded frames."""
        self.cameras = CAMERAS

    def answer(self, request: SceneRequest) -> Reply:
        if isinstance(request, CamerasRequest):
            return cameras_reply(request, self.cameras)
        if isinstance(request, MeasureRequest):
            return measurement_reply(request)
        if isinstance(request, ExportRequest):
            return Reply(b"ply\n", "application/octet-stream", request.options.t or 0.0)
        if isinstance(request, RecordedRequest):
            if request.scene_id == self.not_recorded:
                raise SceneError("This scene keeps no recorded frames.")
            picture = cv2.imencode(".jpg", np.full((48, 60, 3), RECORDED_SHADE, np.uint8))[1].tobytes()
            of_frame = round(request.t * REPORT_OF_THE_PAGE.frame_count) / REPORT_OF_THE_PAGE.frame_count
            return Reply(picture, "image/jpeg", of_frame, iteration=0 if request.attempt is None else None)
        time.sleep(self.pause_s)
        if request.layer is Layer.ERROR and self.lacks_frames:
            raise InputError("layer", "The recorded frames are damaged.", "Ask for another layer.")
        self.asked = request
        self.shown_unseen, self.shown_highlights, self.eye = request.unseen, request.highlights, request.eye
        self.light = (request.light, request.smoke)
        picture = np.full((48, 60, 3), grey_of(request.scene_id), np.uint8)
        warnings = list(self.warnings)
        if isinstance(request.pose, OrbitPose) and abs(request.pose.yaw_deg) > FAR_DEG:
            warnings.append(a_warning(FAR, NoticeCode.POSE_FAR))
        if isinstance(request.pose, OrbitPose) and request.pose.zoom < FAR_OUT_ZOOM:
            warnings.append(a_warning(UNSEEN, NoticeCode.UNSEEN))
        if request.highlights is Highlights.OFF:
            warnings.append(Notice.info(NoticeCode.HIGHLIGHTS_UNKNOWN, HIGHLIGHTS_STAY))
        if request.format is ImageFormat.NPY:
            return Reply(depth_of(request), MEDIA_TYPES[request.format], request.t, camera=CAMERA)
        image = cv2.imencode(f".{request.format.value}", picture)[1].tobytes()
        iteration = SNAPSHOT_ITERATION if request.attempt is None else None
        range_mm = (request.near_mm or RANGE_MM[0], request.far_mm or RANGE_MM[1])
        return Reply(
            image,
            MEDIA_TYPES[request.format],
            request.t,
            tuple(warnings),
            iteration,
            0.12 if NoticeCode.UNSEEN in [each.code for each in warnings] else self.unseen_share,
            camera=CAMERA,
            depth_range_mm=range_mm if request.layer is Layer.DEPTH else None,
        )


class Site:
    """A service with its page on a port that stays; queue, store and worker outlive it."""

    def __init__(self, data_dir: Path, endpoint: str, painter: Painter, pace: RenderPace, **changes: Any) -> None:
        self.queue, self.store, self.painter, self.pace = MemoryQueue(), Store(data_dir), painter, pace
        self._endpoint = endpoint
        with contextlib.closing(socket.socket()) as probe:
            probe.bind(("127.0.0.1", 0))
            port: int = probe.getsockname()[1]
        settings = Settings(data_dir=data_dir, port=port, dashboard_dir=DASHBOARD, min_free_bytes=0)
        self._settings = settings.model_copy(update={"render_timeout_s": 5.0, **changes})
        self.url = f"http://127.0.0.1:{port}"
        self.announce()
        self.start()

    def start(self) -> None:
        renderer = ZmqRenderer(self.queue, self._settings.render_timeout_s)
        app = create_app(self._settings, self.queue, self.store, renderer)
        self._server = Server(app, self._settings)
        self._thread = threading.Thread(target=self._server.run)
        self._thread.start()
        while not self._server.started:
            assert self._thread.is_alive()
            time.sleep(0.01)

    def stop(self) -> None:
        self._server.handle_exit(signal.SIGTERM, None)
        self._thread.join()

    def announce(self, job_id: str | None = None) -> None:
        self.queue.announce(WorkerAddress(name=WORKER, endpoint=self._endpoint, device="cpu", job_id=job_id))

    def queued_job(self, mark: str = "") -> str:
        """A job whose id begins with the mark."""
        job_id = mark + new_job_id()[len(mark) :]
        self.queue.submit(JobRecord(job_id=job_id, files=JobFiles(clip="clip.mp4"), created_at_s=time.time()))
        return job_id

    def claim(self) -> Claim:
        record = self.queue.claim(WORKER, WAIT_S)
        assert record is not None
        self.announce(record.job_id)
        return Claim(record.job_id, record.attempt, WORKER)

    def train(
        self,
        claim: Claim,
        iteration: int,
        psnr_db: float,
        psnr_right_db: float | None = None,
        seconds_left: float = 20.0,
    ) -> None:
        """Tell that training has come so far, of 100."""
        progress = JobProgress(
            stage="train", fraction=iteration / 100, iteration=iteration, iterations=100, psnr_db=psnr_db
        )
        self.queue.beat(
            claim, progress.model_copy(update={"seconds_left": seconds_left, "psnr_right_db": psnr_right_db})
        )

    def finish(
        self,
        claim: Claim,
        *,
        scored: bool = True,
        model: TrainedScene | None = None,
        beside: Mapping[str, bytes] | None = None,
        report: Report = REPORT_OF_THE_PAGE,
    ) -> str:
        """The job's scene; model and the files beside it: as they are stored, for those who read them."""
        folder = self.store.work_folder(claim.job_id, claim.attempt)
        if model is None:
            (folder / MANIFEST).write_text('{"files": {}}')
        else:
            save_scene(folder, model, beside)
        (folder / REPORT).write_text((report if scored else first_report_of_the_page()).model_dump_json())
        (folder / CURVE).write_text(CURVE_OF_THE_PAGE)
        self.store.publish_scene(claim.job_id, claim.attempt)
        assert self.queue.finish(claim)
        self.announce()
        return claim.job_id

    def scene(
        self, mark: str = "", model: TrainedScene | None = None, beside: Mapping[str, bytes] | None = None
    ) -> str:
        """A finished scene whose id begins with the mark."""
        self.queued_job(mark)
        return self.finish(self.claim(), model=model, beside=beside)


@contextmanager
def site_at(data_dir: Path, answer: Callable[[SceneRequest], Reply] | None = None, **changes: Any) -> Iterator[Site]:
    """A site; answer: of its worker, the painter's if it is left out."""
    painter = Painter()
    endpoint = f"ipc://{short_socket_path(Store(data_dir).run_dir, 'worker-1.sock')}"
    pace = RenderPace()
    with RequestServer(endpoint, at_once(answer or painter.answer, pace, max_wait_s=MAX_WAIT_S)):
        site = Site(data_dir, endpoint, painter, pace, **changes)
        try:
            yield site
        finally:
            site.stop()


GRAPHICS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""WebGL2 on the processor."""


@contextmanager
def browser(graphics: Sequence[str] = ("--disable-gpu",)) -> Iterator[webdriver.Chrome]:
    """Chromium without a window; skips where there is none."""
    if CHROMIUM is None or CHROMEDRIVER is None:
        pytest.skip("no browser: install chromium and chromedriver (Debian: chromium, chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", *graphics):
        options.add_argument(argument)
    options.add_argument("--window-size=1280,800")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, Service(CHROMEDRIVER))
    try:
        yield driver
    finally:
        driver.quit()


class Page:
    """The page in a browser, as somebody who looks at it and uses it would say."""

    def __init__(self, driver: webdriver.Chrome, url: str) -> None:
        self.driver = driver
        self.url = url
        self.log: list[str] = []

    def open(self) -> None:
        self.driver.get(self.url)

    def find(self, css: str) -> WebElement:
        """An element to use; what has stepped back returns, as it does for whoever reaches for it."""
        self.script("document.dispatchEvent(new PointerEvent('pointermove'))")
        return self.driver.find_element(By.CSS_SELECTOR, css)

    def text(self, css: str) -> str:
        """What can be read there, at once: an element may be made anew between finding and reading it."""
        found: str | None = self.script("return document.querySelector(arguments[0])?.innerText", css)
        return found or ""

    def script(self, source: str, *arguments: object) -> Any:
        return self.driver.execute_script(source, *arguments)

    def until(self, what: Callable[[], object]) -> None:
        """Wait for it."""
        WebDriverWait(self.driver, WAIT_S, LOOK_S).until(lambda _: what(), f"state is {self.state}: {self.messages()}")

    def until_text(self, css: str, part: str) -> None:
        self.until(lambda: part in self.text(css))

    def click(self, css: str) -> None:
        """Click it as soon as it is there."""
        self.until(lambda: self.script("return !!document.querySelector(arguments[0])", css))
        self.script("document.querySelector(arguments[0]).click()", css)

    def press(self, job_id: str, name: str) -> None:
        """Click one of a job's buttons; a job that the list lacks is asked for, for the page asks every two seconds."""
        if not self.script("return document.querySelector(arguments[0]) !== null", f'[data-job="{job_id}"]'):
            self.script("import(document.scripts[0].src).then(({ jobs }) => jobs.poll())")
        self.click(f'[data-job="{job_id}"] button[aria-label^="{name}"]')

    @property
    def state(self) -> str:
        """What the page says that its picture is."""
        found: str = self.script("return document.querySelector('#stage').dataset.state")
        return found

    def until_state(self, state: str) -> None:
        self.until(lambda: self.state == state)

    @property
    def shade(self) -> int:
        """Of the picture's middle; -1: there is none."""
        found: int = self.script(SHADE)
        return found

    @property
    def view(self) -> str:
        """What the picture says that it shows."""
        found: str = self.script("return document.querySelector('#picture').getAttribute('aria-label')")
        return found

    def show(self, drawer: str) -> None:
        """Open one of the drawers in front of the picture: library, drawer (a new clip) or report-drawer."""
        if self.script("return document.getElementById(arguments[0]).hidden", drawer):
            self.click(f"#tools [data-drawer={drawer}]")

    def speak(self, language: str) -> None:
        """Choose the language in the help."""
        self.script(
            "const choice = document.querySelector('[data-language]'); choice.value = arguments[0];"
            "choice.dispatchEvent(new Event('change'))",
            language,
        )

    def choose(self, name: str, *paths: Path) -> None:
        """Files in one of the form's pickers."""
        self.show("drawer")
        self.find(f'#upload [name="{name}"]').send_keys("\n".join(map(str, paths)))

    def send(self, clip: Path) -> None:
        """Send a video of two eyes by the form."""
        self.choose("clip", clip)
        self.choose("calibration", CALIBRATION)
        self.click("#upload [type=submit]")

    def messages(self) -> dict[str, str]:
        return {css: self.text(css) for css in ("#stage-message", "#upload-message", "#jobs", "#connection")}

    def faults(self) -> list[str]:
        """What the browser says is wrong with the page: breaches of its policy, and errors that nobody caught."""
        entries = self.driver.get_log("browser")  # type: ignore[no-untyped-call]
        self.log += [entry["message"] for entry in entries]
        return [text for text in self.log if "Content Security Policy" in text or "Uncaught" in text]


SHADE = """
const picture = document.querySelector("#picture");
if (picture.hidden || picture.width === 0) return -1;
return picture.getContext("2d").getImageData(picture.width / 2, picture.height / 2, 1, 1).data[0];
"""
