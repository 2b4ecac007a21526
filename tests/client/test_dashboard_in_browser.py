"""The page in a real browser, on a real service whose worker paints: what somebody at an operating table would see."""
# long: one real service and page, and every part of the page is looked at on them

from __future__ import annotations

import time
from pathlib import Path

import pytest
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select

from contract.access.keys import KeyFile, KeyScope
from contract.wire.job import JobError, JobState
from intrasplat.errors import ErrorCode
from intrasplat.picture import Highlights, Unseen
from tests.client.local_service import CLIP
from tests.client.page import (
    CALIBRATION,
    CAMERA,
    REPORT_OF_THE_PAGE,
    Page,
    Site,
    grey_of,
    site_at,
)
from tests.client.words import say
from worker.pace import MAX_SAVED_S, SHARE

SLOW_S = 7.0
"""Longer than a silence that makes a picture stale."""
POINTS = "return document.querySelector(`#curve polyline.${arguments[0]}`)?.points ?? []"
ACTIONS = "return [...document.querySelectorAll(`[data-job='${arguments[0]}'] button`)].map((b) => b.dataset.action)"


@pytest.fixture
def large_clip(tmp_path: Path) -> Path:
    """A clip of several pieces: padded with a box that readers pass over."""
    path, padding = tmp_path / "patient name.mp4", bytes(2_000_000)
    path.write_bytes(CLIP.read_bytes() + (8 + len(padding)).to_bytes(4, "big") + b"free" + padding)
    return path


def test_a_clip_is_sent_and_its_job_watched_to_the_scene(site: Site, page: Page) -> None:
    page.send(CLIP)
    page.until_text("#jobs", "waiting")
    page.until_text("#jobs", "next")
    claim = site.claim()
    site.train(claim, 20, 24.0)
    page.until_text("#jobs", "training · 24.0 dB · about 20 s left")
    page.until_state("training")  # it opened by itself
    assert "iteration 40" in page.text("#readout")
    for iteration, psnr_db, psnr_right_db in ((40, 27.5, 24.0), (60, 28.5, 26.5)):
        site.train(claim, iteration, psnr_db, psnr_right_db)
        page.until_text("#jobs", f"{psnr_db} dB")
    page.until(lambda: len(page.script(POINTS, "score")) == 3)
    assert len(page.script(POINTS, "beside")) == 2  # of the right eye; the first report had none
    assert "28.5 dB, right eye 26.5 dB" in page.find("#curve").get_attribute("aria-label")
    site.finish(claim, scored=False)
    page.until_state("live")
    page.until_text("#report", "still being measured")
    site.store.add_scores("worker-1", claim.job_id, claim.attempt, REPORT_OF_THE_PAGE)
    page.show("report-drawer")
    page.until_text("#report", "With care")
    assert "dB" not in page.text("#report")  # the first layer is for everybody
    page.click("#report .figures summary")
    page.until_text("#report", "32.40 dB on frames it never saw; copying neighbouring frames reaches 29.50 dB.")
    assert "The clip is short." in page.text("#report")
    assert say("figure.without_detail", db="31.20 dB") in page.text("#report")
    assert "29.60 dB on frames it never saw, where the left eye sees the tissue, too." in page.text("#report")
    assert say("figure.without_detail", db="28.40 dB") in page.text("#report")
    assert "Without wet highlights 30.10 dB, left eye 33.00 dB." in page.text("#report")
    page.until(lambda: page.script("return document.querySelectorAll('#curve .baseline').length") == 2)
    assert (len(page.script(POINTS, "score")), len(page.script(POINTS, "beside"))) == (3, 2)
    assert "31.2 dB, right eye 28.4 dB" in page.find("#curve").get_attribute("aria-label")


def test_what_is_dropped_finds_its_place(page: Page) -> None:
    chosen = page.script(
        """
        const transfer = new DataTransfer();
        const names = ["tool_masks.zip", "left.mp4", "right.mp4", "calibration.json", "poses.json", "fov_mask.png"];
        for (const name of names) transfer.items.add(new File(["x"], name));
        const target = document.querySelector("#upload");
        target.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true, cancelable: true }));
        const parts = ["clip", "right", "masks", "calibration", "poses_file", "fov_mask"];
        return parts.map((name) => target.elements[name].files[0]?.name);
        """
    )
    assert chosen == ["left.mp4", "right.mp4", "tool_masks.zip", "calibration.json", "poses.json", "fov_mask.png"]


def test_a_stereo_clip_may_be_trained_on_its_left_eye_alone(site: Site, page: Page) -> None:
    page.choose("clip", CLIP)
    page.click("#upload > details > summary")
    eyes = Select(page.find("#upload [name=eyes]"))
    assert eyes.first_selected_option.text == "both eyes"
    eyes.select_by_value("left")
    Select(page.find("#upload [name=poses]")).select_by_value("fixed")
    page.choose("calibration", CALIBRATION)
    page.click("#upload [type=submit]")
    page.until(lambda: site.queue.records())
    options = site.queue.records()[0].options
    assert (options.eyes, options.poses, options.mask_source) == ("left", "fixed", "auto")


def test_a_clip_that_cannot_be_used_is_refused_in_words(page: Page, tmp_path: Path) -> None:
    path = tmp_path / "cut short.mp4"
    path.write_bytes(b"\0\0\0\x18ftypisom" + bytes(64))
    page.send(path)
    page.until_text("#upload-message", say("problem.input:clip"))
    assert page.find("#upload [type=submit]").is_enabled()


def test_an_upload_goes_on_where_it_was_when_the_connection_is_back(site: Site, page: Page, large_clip: Path) -> None:
    slow = {"latency": 0, "download_throughput": 10_000_000, "upload_throughput": 1_000_000}
    page.driver.set_network_conditions(offline=False, **slow)
    page.send(large_clip)
    page.until(lambda: page.script("return document.querySelector('#upload-progress').value") > 0.2)
    page.driver.set_network_conditions(offline=True, **slow)
    page.until_text("#upload-message", say("upload.kept"))
    page.driver.delete_network_conditions()
    page.until(lambda: site.queue.records())
    (record,) = site.queue.records()
    assert (site.store.spool_folder(record.job_id) / record.files.clip).read_bytes() == large_clip.read_bytes()
    names = page.script("return performance.getEntriesByType('resource').map((entry) => new URL(entry.name).pathname)")
    assert names.count("/uploads") == 2  # clip and calibration, once each
    assert not any("patient" in name for name in names)


def test_time_is_scrubbed_and_played(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")
    page.until_text("#readout", "stream")  # the WebSocket passes the page's policy
    slider = page.find("#time")
    slider.send_keys(Keys.END)
    page.until(lambda: "1.95 s" in page.view)
    slider.send_keys(Keys.HOME)
    page.until(lambda: "0.00 s" in page.view)
    page.click("#play")
    page.until(lambda: "0.00 s" not in page.view)
    assert page.text("#play") == "Pause"
    page.click("#play")


def test_the_view_turns_by_mouse_and_keys_and_goes_back_to_the_endoscope(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")
    stage = page.find("#stage")
    ActionChains(page.driver).click_and_hold(stage).move_by_offset(-60, 10).release().perform()
    page.until(lambda: "turned +9°" in page.view)
    stage.send_keys(Keys.ARROW_UP, "+")
    page.until(lambda: "1.10×" in page.view)
    stage.send_keys(*[Keys.ARROW_RIGHT] * 8)
    page.until_state("extrapolated")
    assert page.text("#picture-warning").startswith(say("notice.pose_far"))
    assert "EXTRAPOLATED" in page.text("#badge")
    page.click("#home")
    page.until_state("live")
    assert "endoscope's view" in page.view


@pytest.mark.parametrize("way", ["stream", "single"])
def test_a_view_that_is_shown_is_told_with_its_camera_and_others_can_look_elsewhere(
    site: Site, page: Page, way: str
) -> None:
    if way != "stream":
        page.script("window.WebSocket = class { static OPEN = 1; readyState = 3; addEventListener() {} close() {} };")
    scene = site.scene()
    page.press(scene, "View")
    page.until_text("#readout", way)
    pose = "1 0 0 4 0 1 0 0 0 0 1 0"
    shown = page.driver.execute_async_script(LOOK, {"t": 0.25, "pose": pose, "layer": "depth"})
    assert shown == {
        "scene": scene,
        "t": 0.25,
        "pose": pose,
        "eye": "left",
        "layer": "depth",
        "unseen": "mark",
        "highlights": "on",
        "light": "steady",
        "state": "done",
        "way": way,
        "camera": CAMERA.model_dump(mode="json"),
        "depthRangeMm": [45, 78],
        "isMoving": False,
        "hasDetail": False,
    }
    page.find("#stage").send_keys("+")  # a turn or an approach goes on from the endoscope
    page.until(lambda: "1.10×" in page.view)
    assert page.driver.execute_async_script(LOOK, {"pose": "orbit:10,-5,2"})["pose"] == "orbit:10.00,-5.00,2.000"
    assert page.driver.execute_async_script(LOOK, {"pose": None})["pose"] is None


LOOK = """
const [wish, done] = arguments;
import(document.scripts[0].src).then(({ viewer }) => {
  viewer.look(wish);
  const take = ({ detail: { ...detail } }) => {
    const isOrbit = wish.pose?.startsWith("orbit");
    if (isOrbit ? !detail.pose.startsWith("orbit:10") : detail.pose !== wish.pose) return; // of an earlier wish
    viewer.removeEventListener("shown", take);
    done(detail);
  };
  viewer.addEventListener("shown", take);
});
"""


@pytest.mark.parametrize("way", ["stream", "single pictures"])
def test_what_was_never_seen_is_hatched_or_guessed_and_the_badge_knows(site: Site, page: Page, way: str) -> None:
    if way != "stream":
        page.script("window.WebSocket = class { static OPEN = 1; readyState = 3; addEventListener() {} close() {} };")
    page.press(site.scene(), "View")
    page.until_text("#readout", way)
    assert "unseen" not in page.text("#readout")
    page.find("#stage").send_keys("-", "-")
    page.until_text("#readout", "12 % unseen")
    assert (site.painter.shown_unseen, page.state) == (Unseen.MARK, "live")
    assert page.text("#picture-warning").startswith(say("notice.unseen"))
    page.click("#guess")
    page.until_state("extrapolated")
    assert site.painter.shown_unseen is Unseen.GUESS
    assert "guesses shown" in page.view
    page.click("#guess")
    page.until_state("live")


def test_a_picture_that_takes_long_is_not_stale_while_the_service_answers_otherwise(
    driver: webdriver.Chrome, tmp_path: Path
) -> None:
    with site_at(tmp_path / "data", render_timeout_s=20.0) as site:
        page = Page(driver, site.url)
        page.open()
        site.queued_job()
        claim = site.claim()
        site.train(claim, 10, 21.0)
        page.press(claim.job_id, "Watch")
        page.until_state("training")
        site.painter.pause_s = SLOW_S
        site.finish(claim, scored=False)
        until_s, states = time.monotonic() + SLOW_S, set()
        while time.monotonic() < until_s:
            states.add(page.state)
            time.sleep(0.1)
        assert states == {"training"}
        assert page.shade > 0
        page.until_state("live")
        driver.get("about:blank")


def test_colours_are_shown_without_highlights_and_that_is_no_guess(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")
    assert site.painter.shown_highlights is Highlights.ON
    page.click("#highlights")
    page.until_text("#readout", "without highlights")
    assert (site.painter.shown_highlights, page.state) == (Highlights.OFF, "live")
    assert page.text("#picture-warning").startswith(say("notice.highlights_unknown"))
    page.script(
        "const layer = document.querySelector('#layer'); layer.value = 'depth';layer.dispatchEvent(new Event('change'))"
    )
    page.until_text("#readout", "depth")
    assert site.painter.shown_highlights is Highlights.ON
    assert not page.find("#highlights").is_enabled()


def test_a_picture_is_stale_while_the_service_is_away_and_live_when_it_is_back(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")
    site.stop()
    try:
        page.until_state("stale")
        assert "STALE" in page.text("#badge")
        assert "Last picture" in page.text("#stage-message")
        assert "grayscale" in page.script("return getComputedStyle(document.querySelector('#picture')).filter")
        page.until_text("#connection", "no connection")
    finally:
        site.start()
    page.until_state("live")
    page.until_text("#connection", "ready")
    page.until_text("#readout", "stream")


def test_a_running_job_is_told_of_again_after_the_service_was_away(site: Site, page: Page) -> None:
    site.queued_job()
    claim = site.claim()
    site.train(claim, 10, 21.0)
    page.until_text("#jobs", "21.0 dB")
    site.stop()
    site.train(claim, 30, 25.0)
    site.start()
    page.until_text("#jobs", "25.0 dB")


def test_no_picture_of_another_scene_is_ever_shown(site: Site, page: Page) -> None:
    site.painter.pause_s = 0.03
    scenes = [site.scene(mark) for mark in ("00", "7f", "ff")]
    page.until(lambda: page.script("return document.querySelectorAll('#jobs .done').length") == 3)
    seen = page.driver.execute_async_script(SWITCHING, scenes)
    shades = {scene: {shade for at, shade in seen if at == scene and shade >= 0} for scene in scenes}
    assert all(shades.values()), "every scene was seen"
    for scene, found in shades.items():
        assert all(abs(shade - grey_of(scene)) <= 2 for shade in found), (scene, found)


SWITCHING = """
const [scenes, done] = arguments;
const picture = document.querySelector("#picture");
const seen = [];
let frame = 0;
const shade = () => picture.hidden || picture.width === 0 ? -1
  : picture.getContext("2d").getImageData(picture.width / 2, picture.height / 2, 1, 1).data[0];
const step = () => {
  seen.push([document.querySelector("#scene-id").dataset.scene, shade()]);
  if (frame % 7 === 0) document.querySelector(`[data-job="${scenes[(frame / 7) % 3]}"] button`).click();
  if (++frame < 150) requestAnimationFrame(step);
  else done(seen);
};
step();
"""


def test_a_deleted_scene_leaves_a_receipt_and_no_picture(site: Site, page: Page) -> None:
    scene = site.scene()
    page.press(scene, "View")
    page.until_state("live")
    page.script("sessionStorage.setItem(arguments[0], '[1]')", f"intrasplat-strokes-{scene}")
    page.press(scene, "Delete")
    page.until(lambda: page.find("#confirm").is_displayed())
    page.click("#confirm [value=yes]")
    page.until_text("#jobs-message", "are deleted for good")
    assert page.script("return sessionStorage.getItem(arguments[0])", f"intrasplat-strokes-{scene}") is None
    assert "nothing is left" in page.text("#jobs-message")
    page.until_state("none")
    assert page.shade == -1
    assert page.text("#jobs") == ""


def test_a_scene_that_somebody_else_deletes_leaves_the_screen(site: Site, page: Page) -> None:
    scene = site.scene()
    page.press(scene, "View")
    page.until_state("live")
    site.queue.forget(scene)
    site.store.purge(scene)
    page.until(lambda: page.shade == -1)
    page.until_text("#stage-message", say("problem.http_404:scene"))


def test_a_job_is_cancelled_and_a_failed_one_tried_again_by_keyboard(site: Site, page: Page) -> None:
    page.send(CLIP)
    page.until_text("#jobs", "waiting")
    claim = site.claim()
    assert site.queue.fail(claim, JobError(code=ErrorCode.FAULT, problem="Division by zero.", remedy="See the log."))
    page.until_text("#jobs", say("problem.fault"))
    page.show("library")
    assert "Division" not in page.text("#jobs")
    page.click("#jobs .api-words summary")
    page.until_text("#jobs", "Division by zero. See the log.")
    job = f'[data-job="{claim.job_id}"]'
    page.show("library")
    page.until(lambda: page.find(f'{job} button[aria-label^="Try again"]').is_displayed())
    page.find(f'{job} button[aria-label^="Try again"]').send_keys(Keys.ENTER)
    page.until_text("#jobs", "next")
    page.find(f'{job} button[aria-label^="Cancel"]').send_keys(Keys.SPACE)
    page.until(lambda: page.find("#confirm").is_displayed())
    page.find("#confirm [value=yes]").send_keys(Keys.SPACE)
    page.until_text("#jobs", "cancelled")
    record = site.queue.get(claim.job_id)
    assert record is not None
    assert record.state is JobState.CANCELLED


def test_a_key_that_expires_while_it_is_used_and_one_that_has_are_told_so(
    tmp_path: Path, driver: webdriver.Chrome
) -> None:
    with site_at(tmp_path / "data", hosts=("127.0.0.1",)) as site:
        keys = KeyFile(tmp_path / "data")
        key, text = keys.create("local", {KeyScope.VIEW}, "page")
        scene = site.scene()
        page = Page(driver, site.url)
        page.open()
        page.find("#key-text").send_keys(text, Keys.ENTER)
        page.press(scene, "View")
        page.until_state("live")
        keys.rotate(key.key_id, keys.successor(key.key_id)[0], time.time())
        page.until_text("#key-message", "This key has expired. Ask for a new one.")
        page.click("#forget-key")
        page.until_text("#key-message", "A key is needed.")
        page.find("#key-text").send_keys(text, Keys.ENTER)
        page.until_text("#key-message", "This key has expired. Ask for a new one.")
        _, successor = keys.create("local", {KeyScope.VIEW}, "page")
        page.find("#key-text").send_keys(successor, Keys.ENTER)
        page.until_state("live")
        assert page.faults() == []
        driver.get("about:blank")


def test_a_key_is_asked_for_used_everywhere_and_forgotten(tmp_path: Path, driver: webdriver.Chrome) -> None:
    with site_at(tmp_path / "data", hosts=("127.0.0.1",)) as site:
        _, key = KeyFile(tmp_path / "data").create("local", {KeyScope.VIEW}, "page")
        scene = site.scene()
        page = Page(driver, site.url)
        page.open()
        page.until_text("#key-message", "A key is needed.")
        page.find("#key-text").send_keys("isp_wrong", Keys.ENTER)
        page.until_text("#key-message", "This key is not known.")
        page.find("#key-text").send_keys(key, Keys.ENTER)
        page.press(scene, "View")
        page.until_state("live")
        page.until_text("#readout", "stream")
        assert page.script(ACTIONS, scene) == ["view", "save"]  # no Delete: the key may not
        assert key not in page.script("return document.cookie + JSON.stringify(localStorage) + location.href")
        page.click("#forget-key")
        page.until_text("#key-message", "A key is needed.")
        assert page.shade == -1
        assert page.text("#jobs") == ""
        assert page.faults() == []
        driver.get("about:blank")


@pytest.mark.parametrize("width", [1280, 800])
def test_the_viewer_fits_the_screen(site: Site, page: Page, width: int) -> None:
    page.driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride", {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    )
    page.press(site.scene(), "View")
    page.until_state("live")
    page.until_text("#report", "With care")
    bottom, right = page.script(
        "const box = document.querySelector('#theatre').getBoundingClientRect(); return [box.bottom, box.right]"
    )
    assert bottom <= 800
    assert right <= width
    assert page.script("return document.documentElement.scrollWidth") <= width
    assert page.find(".notice").is_displayed()
    page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_while_the_worker_has_no_time_left_the_last_picture_stays_and_is_not_stale(site: Site, page: Page) -> None:
    site.queued_job()
    claim = site.claim()
    site.train(claim, 20, 24.0)
    page.press(claim.job_id, "Watch")
    page.until_state("training")
    with site.pace.training():
        site.pace.charge(MAX_SAVED_S + 9.0 * SHARE)
        until_s, states = time.monotonic() + 7.0, set[str]()  # a picture is stale after 5 s
        while time.monotonic() < until_s:
            states.add(page.state)
            time.sleep(0.1)
        assert states == {"training"}
    shown = page.text("#readout")
    page.until(lambda: page.text("#readout") != shown)
