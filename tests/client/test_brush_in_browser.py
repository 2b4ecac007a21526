"""Painting masks in the page: from the found masks of a rectified clip to the job that has the strokes in its own."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select

from intrasplat.camera import Intrinsics
from intrasplat.clip import ClipLimits, DepthClip
from intrasplat.clip.masks import open_masks, tissue_from_masks
from intrasplat.clip.recorded_masks import Rectification
from intrasplat.instruments import zipped_masks
from intrasplat.names import MASKS, RECORDED
from intrasplat.report import Masks
from intrasplat.view.recorded import recorded_files
from tests.client.local_service import CLIP
from tests.client.page import CALIBRATION, REPORT_OF_THE_PAGE, Page, Site
from tests.client.words import say

FRAMES, HEIGHT, WIDTH = REPORT_OF_THE_PAGE.frame_count, 152, 190  # no whole number of bytes a row of a mask
OPTIONS = {"poses": "fixed", "mask_source": "given", "mask_polarity": "tool"}
"""Of the job that gets the masks."""
Mask = NDArray[np.bool_]

ROTATION = cv2.Rodrigues(np.array([0.01, -0.03, 0.04]))[0]
MOVED = Rectification(
    camera=((180.0, 0.0, 94.0), (0.0, 182.0, 77.0), (0.0, 0.0, 1.0)),
    distortion=(-0.21, 0.06, 0.002, -0.001, 0.01),
    rotation=tuple(map(tuple, ROTATION.tolist())),
    projection=((171.0, 0.0, 90.0, 0.0), (0.0, 171.0, 79.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
)
"""Moves pixels by some ten of them."""
ASKED = "return performance.getEntriesByType('resource').map(({ name }) => name)"
PLACES = """
const [width, height, pixels, done] = arguments;
import(new URL("masks/strokes.js", document.scripts[0].src)).then(({ recordedPlace }) => {
  const place = recordedPlace(pixels);
  done(Array.from({ length: width * height }, (_, i) => place(i % width, Math.floor(i / width))));
});
"""


def masked_clip(masks: Masks, rectification: Rectification | None) -> DepthClip:
    """Frames of a chequered plane, over which an instrument moves."""
    shape = (FRAMES, HEIGHT, WIDTH)
    tissue = np.ones(shape, np.bool_)
    for frame in range(FRAMES):
        tissue[frame, 100:, 20 + 3 * frame : 60 + 3 * frame] = False
    rows, columns = np.indices((HEIGHT, WIDTH))
    checked = np.where((rows // 8 + columns // 8) % 2, 150, 110).astype(np.uint8)
    return DepthClip(
        rgb=np.broadcast_to(checked[None, :, :, None], (*shape, 3)),
        tissue=tissue,
        depth_mm=np.zeros(shape, np.float32),
        depth_confidence=np.zeros(shape, np.uint8),
        intrinsics=Intrinsics(width=WIDTH, height=HEIGHT, fx=171, fy=171, cx=90, cy=79),
        world_from_camera=np.tile(np.eye(4), (FRAMES, 1, 1)),
        frame_times_s=np.arange(FRAMES) / 25,
        masks=masks,
        rectification=rectification,
    )


def recorded_places() -> NDArray[np.float32]:
    """[H, W, 2] column and row in the recording of each pixel of a kept frame."""
    moved = [np.array(each) for each in (MOVED.camera, MOVED.distortion, MOVED.rotation, MOVED.projection)]
    return np.stack(cv2.initUndistortRectifyMap(*moved, (WIDTH, HEIGHT), cv2.CV_32FC1), axis=-1)


UNSEEN = 3
"""The frame of FOUND that nobody looked at: the scene does not store it, and the one before stands for it."""
FOUND = dataclasses.replace(masked_clip(Masks(source="found", share=0.07, sure=0.9), MOVED), skipped=(UNSEEN,))
GIVEN = masked_clip(Masks(source="given", share=0.07), None)


def scene_of(site: Site, page: Page, clip: DepthClip) -> str:
    """The finished scene of a clip that was sent with an option."""
    page.choose("clip", CLIP)
    page.choose("calibration", CALIBRATION)
    page.click("#upload > details > summary")
    Select(page.find("#upload [name=poses]")).select_by_value("fixed")
    page.click("#upload [type=submit]")
    page.until_text("#jobs", "waiting")
    files, kept = recorded_files(clip, ("left",), ())
    report = REPORT_OF_THE_PAGE.model_copy(update={"masks": clip.masks, "recorded": kept})
    scene = site.finish(site.claim(), report=report)
    folder = site.store.scene_folder(scene, 1)
    (folder / RECORDED).write_bytes(files[RECORDED] or b"")
    return scene


HOLD = """
const [path, fetch] = [arguments[0], window.fetch];
const released = new Promise((done) => (window.release = done));
window.fetch = async (asked, ...more) => {
  if (new URL(asked.url ?? asked, location).pathname.endsWith(path)) await released;
  return fetch(asked, ...more);
};
"""
"""What is asked of a path waits until release() is called."""
LABEL = "document.querySelector('#upload [name=label]')"


class Brush:
    """The screen, as somebody who paints on it uses it."""

    def __init__(self, page: Page, scene: str) -> None:
        self._page = page
        self._scene = scene

    def until_frame(self, frame: int) -> None:
        shown = "return document.querySelector('.brush')?.dataset.shown"
        self._page.until(lambda: self._page.script(shown) == str(frame))

    def press(self, *keys: str) -> None:
        ActionChains(self._page.driver).send_keys(*keys).perform()

    def click(self, place: str) -> None:
        self._page.click(f'.brush button[aria-label="{say(place)}"]')

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Where a pixel of the frame is on the screen."""
        left, top, width, height = self._page.script(
            "const box = document.querySelector('.paper').getBoundingClientRect();"
            "return [box.left, box.top, box.width, box.height]"
        )
        scale = min(width / WIDTH, height / HEIGHT)
        return (
            left + (width - scale * WIDTH) / 2 + (x + 0.5) * scale,
            top + (height - scale * HEIGHT) / 2 + (y + 0.5) * scale,
        )

    def drag(self, *points: tuple[float, float], pen: bool = False) -> None:
        kinds = ["mousePressed", *["mouseMoved"] * (len(points) - 1), "mouseReleased"]
        pointer = "pen" if pen else "mouse"
        for kind, (x, y) in zip(kinds, (*points, points[-1]), strict=True):
            left, top = self.at(x, y)
            event = {"type": kind, "x": left, "y": top, "button": "left", "buttons": 1, "clickCount": 1}
            self._page.driver.execute_cdp_cmd("Input.dispatchMouseEvent", {**event, "pointerType": pointer})

    def touch(self, *points: tuple[float, float]) -> None:
        kinds = ["touchStart", *["touchMove"] * (len(points) - 1), "touchEnd"]
        for kind, (x, y) in zip(kinds, (*points, points[-1]), strict=True):
            left, top = self.at(x, y)
            touched = [] if kind == "touchEnd" else [{"x": left, "y": top}]
            self._page.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touched})

    @property
    def strokes(self) -> list[dict[str, Any]]:
        """Those that the tab remembers."""
        text = self._page.script("return sessionStorage.getItem(arguments[0])", f"intrasplat-strokes-{self._scene}")
        strokes: list[dict[str, Any]] = json.loads(text) if text else []
        return strokes

    @property
    def changed(self) -> list[int]:
        """The frames that are marked as changed."""
        marked = "return [...document.querySelectorAll('.strip [data-changed]')].map((each) => +each.dataset.frame)"
        frames: list[int] = self._page.script(marked)
        return frames


def painted(mask: Mask, strokes: list[dict[str, Any]]) -> Mask:
    """A mask [H, W] with strokes: all pixels no farther from their lines than their radius."""
    mask = mask.copy()
    rows, columns = np.indices(mask.shape)
    for stroke in strokes:
        points = np.array(stroke["points"]).reshape(-1, 2)
        for first, last in zip(points, np.concatenate([points[1:], points[-1:]]), strict=True):
            step = last - first
            length2 = step @ step
            along = (columns - first[0]) * step[0] + (rows - first[1]) * step[1]
            share = np.clip(along / length2, 0, 1) if length2 > 0 else np.zeros(mask.shape)
            x, y = columns - first[0] - share * step[0], rows - first[1] - share * step[1]
            mask[x * x + y * y <= stroke["radius"] ** 2] = stroke["isTool"]
    return mask


def decoded(png: bytes) -> Mask:
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)) > 0


def test_strokes_over_found_masks_are_in_the_masks_of_the_next_job(site: Site, page: Page) -> None:
    scene = scene_of(site, page, FOUND)
    content = zipped_masks(FOUND)
    assert content is not None
    found = zipfile.ZipFile(io.BytesIO(content))
    as_found = [found.read(name) for name in found.namelist()]
    page.show("report-drawer")
    asked = f"{ASKED}.filter((name) => name.includes('/masks/')).length"
    page.until_text("#report", say("brush.title"))
    assert page.script(asked) == 0  # the first visit is no heavier
    page.click(f'#report button[aria-label="{say("brush.title")}"]')
    brush, places = Brush(page, scene), recorded_places()
    page.until_text(".brush .message", say("problem.http_404"))
    (site.store.scene_folder(scene, 1) / MASKS).write_bytes(content)
    asked_for_masks = f"{ASKED}.filter((name) => name.endsWith('/{scene}/masks')).length"
    loads = page.script(asked_for_masks)
    page.script("for (const n of [2, 1, 0]) document.querySelectorAll('.strip button')[n].click()")
    brush.until_frame(0)
    assert page.script(asked_for_masks) == loads + 1  # once for all frames
    assert page.text(".brush .message") == ""
    assert page.text(".brush .state").endswith(say("brush.nearest"))
    assert page.script(asked) > 0
    pixels = site.store.newest_report(scene, 1).recorded.pixels.model_dump()  # type: ignore[union-attr]
    computed = page.driver.execute_async_script(PLACES, WIDTH, HEIGHT, pixels)  # type: ignore[no-untyped-call]
    np.testing.assert_allclose(np.reshape(computed, places.shape), places, atol=1e-3)
    assert np.abs(places - np.stack(np.indices((HEIGHT, WIDTH))[::-1], axis=-1)).max() > 5

    brush.drag((30, 30), (60, 34), (90, 60))  # instrument, in frame 0
    assert brush.changed == [0]
    brush.press(".", "e", "]")
    brush.until_frame(1)
    brush.touch((45, 120), (52, 130))  # tissue, over the instrument
    assert brush.changed == [0, 1]
    brush.press(".")
    brush.until_frame(2)
    brush.drag((100, 20), (120, 20), pen=True)
    assert brush.changed == [0, 1, 2]
    ActionChains(page.driver).key_down(Keys.CONTROL).send_keys("z").key_up(Keys.CONTROL).perform()
    page.until(lambda: brush.changed == [0, 1])
    brush.until_frame(2)
    page.script("document.querySelector('.paper').focus()")
    brush.press("b", "[", Keys.ARROW_LEFT, Keys.ENTER)  # by keys alone
    assert brush.changed == [0, 1, 2]
    assert [(each["isTool"], each["frame"]) for each in brush.strokes] == [(True, 0), (False, 1), (True, 2)]

    brush.press(Keys.ESCAPE)
    page.until(lambda: page.find(".leaving").is_displayed())
    page.click(f'.leaving button[aria-label="{say("brush.stay")}"]')
    strokes = brush.strokes
    brush.click("brush.send")
    page.until(lambda: not page.script("return document.querySelector('.brush') !== null"))
    chosen = {name: page.script(f"return document.querySelector('#upload [name={name}]').value") for name in OPTIONS}
    assert chosen == OPTIONS
    page.script("sessionStorage.setItem('intrasplat-strokes-another', '[]')")  # of a scene that nothing is sent of
    page.script(HOLD, "/reconstruct")
    page.click("#upload [type=submit]")
    page.until(lambda: page.script("return document.querySelector('#upload-progress').value") == 1)
    assert brush.strokes == strokes
    page.open()  # which makes the job, without the brush's modules
    page.until(lambda: [each.clip_of for each in site.queue.records() if each.job_id != scene] == [scene])
    page.until(lambda: brush.strokes == [])
    assert page.script("return sessionStorage.getItem('intrasplat-strokes-another')") == "[]"
    assert page.script(asked) == 0
    (record,) = (each for each in site.queue.records() if each.job_id != scene)
    assert {name: getattr(record.options, name) for name in OPTIONS} == OPTIONS

    path = site.store.spool_folder(record.job_id) / "masks.zip"
    with zipfile.ZipFile(path) as sent:
        assert sent.testzip() is None
        assert sent.namelist() == found.namelist()
        masks = [sent.read(name) for name in sent.namelist()]
    assert masks[UNSEEN + 1 :] == as_found[UNSEEN + 1 :]
    for frame, stroke in enumerate([*strokes, strokes[UNSEEN - 1]]):
        assert (decoded(masks[frame]) == painted(decoded(as_found[frame]), [stroke])).all()
        assert masks[frame] != as_found[frame]
    for frame, (x, y), is_tool in ((0, (60, 34), True), (0, (75, 47), True), (1, (50, 127), False)):
        column, row = np.rint(places[y, x]).astype(int)
        assert decoded(masks[frame])[row, column] == is_tool != decoded(as_found[frame])[row, column]
    tissue = tissue_from_masks(open_masks(path, ClipLimits()), (FRAMES, HEIGHT, WIDTH), "tool").tissue
    assert (tissue == ~np.stack([decoded(each) for each in masks])).all()


def test_a_stroke_to_all_frames_is_in_every_given_mask_and_strokes_can_be_discarded(site: Site, page: Page) -> None:
    scene = scene_of(site, page, GIVEN)
    page.click(f'#report button[aria-label="{say("brush.title")}"]')
    brush = Brush(page, scene)
    brush.until_frame(0)
    recorded = site.store.scene_folder(scene, 1) / RECORDED
    away = recorded.rename(recorded.with_suffix(".away"))
    brush.press(".")
    page.until(lambda: page.text(".brush .message"))
    hidden = "return getComputedStyle(document.querySelector('.paper canvas')).visibility"
    page.until(lambda: page.script(hidden) == "hidden")  # not frame 0 under another's number
    away.rename(recorded)
    brush.press(",")
    brush.until_frame(0)
    assert page.script(hidden) == "visible"
    brush.click("brush.all")
    brush.drag((150, 10), (170, 10))
    assert brush.changed == list(range(FRAMES))
    name = f"intrasplat-strokes-{scene}"
    page.script("sessionStorage.setItem('copy', sessionStorage.getItem(arguments[0]))", name)
    brush.press(Keys.ESCAPE)
    page.click(f'.leaving button[aria-label="{say("brush.discard")}"]')
    page.until(lambda: not page.script("return document.querySelector('.brush') !== null"))
    assert brush.strokes == []
    page.script("sessionStorage.setItem(arguments[0], sessionStorage.getItem('copy'))", name)  # as after a reload
    page.script(HOLD, "/uploads")
    page.send(CLIP)  # another clip, which is on its way while masks are painted
    page.until(lambda: page.script("return !document.querySelector('#upload-progress').hidden"))
    page.script(f"{LABEL}.value = 'next'; {LABEL}.dispatchEvent(new Event('input', {{ bubbles: true }}))")
    page.click(f'#report button[aria-label="{say("brush.title")}"]')
    brush.until_frame(0)
    strokes = brush.strokes
    assert len(strokes) == 1
    brush.click("brush.send")
    page.until_text(".brush .message", say("upload.one_at_a_time"))
    page.script("window.release()")
    page.until(lambda: len(site.queue.records()) == 2)
    page.until(lambda: page.script("return document.querySelector('#upload-progress').hidden"))
    assert brush.strokes == strokes  # they are another clip's
    assert page.script(f"return {LABEL}.value") == "next"
    press = "for (const name of arguments) document.querySelector(`.brush button[aria-label='${name}']`).click()"
    page.script(press, say("brush.send"), say("page.close"))  # which waits for the masks
    assert not page.script("return document.querySelector('.leaving') !== null")
    page.until(lambda: not page.script("return document.querySelector('.brush') !== null"))
    page.click("#upload [type=submit]")
    page.until(lambda: scene in [each.clip_of for each in site.queue.records()])
    page.until(lambda: brush.strokes == [])
    (record,) = (each for each in site.queue.records() if each.clip_of == scene)
    with zipfile.ZipFile(site.store.spool_folder(record.job_id) / "masks.zip") as sent:
        assert len(sent.namelist()) == FRAMES
        for name, tissue in zip(sent.namelist(), GIVEN.tissue, strict=True):
            assert (decoded(sent.read(name)) == painted(~tissue, strokes)).all()


@pytest.mark.parametrize("why", ["the report is of before", "given masks of rectified frames", "no recorded frames"])
def test_the_brush_is_not_offered_where_masks_would_not_lie_over_the_recording(
    site: Site, page: Page, why: str
) -> None:
    _, kept = recorded_files(masked_clip(Masks(source="given", share=0.07), MOVED), ("left",), ())
    recorded = {
        "the report is of before": kept.model_copy(update={"pixels": None}),
        "given masks of rectified frames": kept,
        "no recorded frames": None,
    }[why]
    scene = site.scene()
    update = {"masks": Masks(source="given", share=0.07), "recorded": recorded}
    site.store.add_scores("worker-1", scene, 1, REPORT_OF_THE_PAGE.model_copy(update=update))
    page.press(scene, "View")
    page.until_text("#report", say("report.send_better_masks"))
    assert say("brush.title") not in page.text("#report")
