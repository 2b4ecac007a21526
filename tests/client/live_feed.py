"""What the tests of the live screen stand on: a worker that follows feeds whose pictures carry their own time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.queue.embedded import short_socket_path
from contract.store.shelf import new_job_id
from contract.wire.feeds import CutRange, FeedOptions, FeedRecord, FeedReport, FeedShown
from contract.wire.rendering import (
    CutRequest,
    MeasureRequest,
    PushRequest,
    RecordedRequest,
    RenderRequest,
    WorkerAddress,
)
from intrasplat.errors import InputError
from intrasplat.live.looking import FUTURE_S
from intrasplat.live.state import FeedReason, FeedState
from intrasplat.live.times import LIVE, FeedTimeKind
from intrasplat.notices import Notice, NoticeCode
from tests.client.local_service import CLIP
from tests.client.page import CAMERA, Page, Site
from tests.measurements import measurement_reply
from tests.reports import a_warning
from tests.service.feed_worker import FeedWorker
from worker.reply import Reply

FPS = 30.0
PICTURE_LAG_S = 0.06
"""From the arrival of a pair to its picture."""
MODEL_LAG_S = 0.4
PAST_S = 90.0
BITS = 24
CELL_PX = 16
"""Of a picture's upper edge: BITS cells, white or black, spell its time in ms, the highest bit first."""
FAR_DEG = 15.0
CALIBRATION = (
    '{"model": "rectified", "width": 400, "height": 320, "fx_px": 400, "fy_px": 400, "cx_px": 200, "cy_px": 160, '
    '"baseline_mm": 4.0, "disparity_offset_px": 0}'
)

READ_TIME = """
const canvas = document.getElementById(arguments[0]);
if (canvas.hidden || canvas.width === 0) return null;
const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, 16);
const cell = canvas.width / 25;
let ms = 0;
const row = canvas.width * 8;
for (let bit = 0; bit < 24; bit++) ms = ms * 2 + (data[4 * (row + Math.floor((bit + .5) * cell))] > 127 ? 1 : 0);
const age = (Date.now() - ms) % 2 ** 24;
return { ms, ageMs: age < 2 ** 23 ? age : age - 2 ** 24, text: document.getElementById(arguments[1]).textContent };
"""
"""A picture's time as it spells it, its age by this machine's clock, and what the page says."""


def painted(at_s: float, shade: int) -> NDArray[np.uint8]:
    """[320, 400, 3] a picture of this moment."""
    rows, columns = np.mgrid[:320, :400].astype(np.float32)
    wave = 30 * np.sin(columns / 25 + 2 * at_s) * np.cos(rows / 40)
    picture = np.stack([shade * 0.4 + wave, shade * 0.45 + wave, shade + wave], axis=-1)
    spelt = int(at_s * 1000) % 2**BITS
    for bit in range(BITS):
        value = 255 if spelt >> (BITS - 1 - bit) & 1 else 0
        picture[:CELL_PX, bit * CELL_PX : (bit + 1) * CELL_PX] = value
    return np.clip(picture, 0, 255).astype(np.uint8)


class LivePainter(FeedWorker):
    """Follows feeds in real time. Its pictures are of now less a lag, at FPS; `stops_s`: nothing comes in after it."""

    def __init__(self, site: Site, folder: Path) -> None:
        super().__init__(site.queue, folder, clip=CLIP.read_bytes())
        self.began_s = time.time() - PAST_S
        self.stops_s: float | None = None
        self.reason: FeedReason | None = None
        self.recording: FeedReason | None = None
        self.model_lag_s = MODEL_LAG_S
        self.has_model = True
        self.is_coarse = False
        self.answer_after_s = 0.0
        self.refuses_cuts: InputError | None = None
        self.renders: list[RenderRequest] = []
        self.measured: list[MeasureRequest] = []
        self._lock = threading.Lock()
        self._announced_s = 0.0

    def newest(self, lag_s: float) -> float:
        """UNIX time of the newest pair that is known this much later."""
        now_s = time.time() if self.stops_s is None else min(time.time(), self.stops_s)
        return int((now_s - lag_s) * FPS) / FPS

    def report(self) -> FeedReport:
        if time.monotonic() > self._announced_s + 1:
            self._announced_s = time.monotonic()
            for feed_id in self._claims:
                name = f"worker-1-feed-{feed_id[:8]}"
                endpoint = f"ipc://{short_socket_path(self._folder, f'{name}.sock')}"
                address = WorkerAddress(name=name, endpoint=endpoint, device="cpu", feed_id=feed_id, renders_only=True)
                self._queue.announce(address)
        now_s, arrived_s, model_s = time.time(), self.newest(0), self.newest(self.model_lag_s)
        is_fed = self.stops_s is None and self.state in (FeedState.LIVE, FeedState.BEHIND)
        reason = FeedReason.BY_HAND if self.state is FeedState.PAUSED else self.reason
        return FeedReport(
            state=self.state,
            reason=reason,
            since_s=self.began_s,
            recording=self.recording,
            received_fps=FPS if is_fed else 0.0,
            used_fps=4.9 if is_fed else 0.0,
            dropped=7,
            model_age_s=now_s - model_s if self.has_model else None,
            decode_lag_s=PICTURE_LAG_S,
            reconnects=2,
            last_frame_at_s=arrived_s,
            stored_bytes=12_300_000,
            begins_s=self.began_s if self.has_model else None,
            ends_s=model_s if self.has_model else None,
            source_begins_s=0.0 if self.has_model else None,
            source_ends_s=model_s - self.began_s if self.has_model else None,
        )

    def _shown(self, at_s: float, newest_s: float) -> FeedShown:
        return FeedShown(
            state=self.state,
            source_s=at_s - self.began_s,
            captured_at_s=at_s,
            age_s=time.time() - at_s,
            is_newest=at_s == newest_s,
        )

    def _answer(self, request: Any) -> Reply:
        time.sleep(self.answer_after_s)
        if isinstance(request, RecordedRequest):
            at_s = self.newest(PICTURE_LAG_S)
            picture = cv2.imencode(".jpg", painted(at_s, 150))[1].tobytes()
            return Reply(picture, "image/jpeg", 0.0, feed=self._shown(at_s, at_s))
        if isinstance(request, MeasureRequest):
            self.measured.append(request)
            return measurement_reply(request.model_copy(update={"t": 0.0}))
        assert isinstance(request, RenderRequest)
        with self._lock:
            self.renders = [*self.renders, request][-200:]
        newest_s = self.newest(self.model_lag_s)
        at_s = newest_s if request.moment in (None, LIVE) else self._at(request.moment, newest_s)
        shown = self._shown(at_s, newest_s)
        if request.newer_than_s is not None and shown.source_s <= request.newer_than_s + 1e-6:
            return Reply(b"", "image/jpeg", 0.0, feed=shown)
        picture = cv2.imencode(".jpg", painted(at_s, 190))[1].tobytes()
        yaw_deg = abs(getattr(request.pose, "yaw_deg", 0.0))
        warnings = (a_warning("far", NoticeCode.POSE_FAR),) if yaw_deg > FAR_DEG else ()
        if self.is_coarse:
            warnings += (Notice.info(NoticeCode.COARSE, "coarse"),)
        camera = CAMERA.model_copy(update={"width": 400, "height": 320, "fx": 400, "fy": 400, "cx": 200, "cy": 160})
        return Reply(picture, "image/jpeg", 0.0, warnings, camera=camera, feed=shown)

    def _answer_aside(self, request: CutRequest | PushRequest, content: bytes) -> Reply:
        if self.refuses_cuts is not None and isinstance(request, CutRequest):
            raise self.refuses_cuts
        return super()._answer_aside(request, content)

    def _at(self, moment: Any, newest_s: float) -> float:
        at_s = moment.seconds if moment.kind is FeedTimeKind.UNIX else newest_s - moment.seconds
        if at_s < self.began_s:
            raise InputError("t", "This is before the feed's past.", "Give a later moment.")
        if at_s > time.time() + FUTURE_S:
            raise InputError("t", "This is in the future.", "Give an earlier moment.")
        return min(newest_s, round(at_s * FPS) / FPS)


def opened_feed(site: Site, label: str | None = None, source: str | None = None) -> str:
    """A feed that its caller has opened."""
    feed_id = new_job_id()
    record = FeedRecord(
        feed_id=feed_id,
        options=FeedOptions(label=label, source=source),
        calibration=CALIBRATION,
        calibration_name="calibration.json",
        created_at_s=time.time(),
    )
    site.queue.open_feed(record, 8, 8)
    return feed_id


@contextmanager
def live_painter(site: Site, folder: Path) -> Iterator[LivePainter]:
    """A worker that follows the site's feeds until the end of the context."""
    with LivePainter(site, folder) as painter:
        painter.cut = CutRange(from_s=time.time() - 31, to_s=time.time() - 1, frames=900)
        yield painter


class LivePage(Page):
    """The live screen in a browser."""

    def watch(self, feed_id: str) -> None:
        """Open a feed's screen."""
        self.driver.get("about:blank")  # or only the hash changes
        self.driver.get(f"{self.url}/live.html#/{feed_id}")

    @property
    def state(self) -> str:
        """The kind of what the word on top says."""
        found: str = self.script("return document.body.dataset.kind")
        return found

    def messages(self) -> dict[str, str]:
        return {css: self.text(css) for css in ("#word", "#live-word", "#live-message", "#model-message", "#message")}
