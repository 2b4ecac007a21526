"""The upload drawer in a real browser: wrong files are told before they are sent, and a reload loses nothing."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from selenium import webdriver
from selenium.webdriver.common.keys import Keys

from contract.access.keys import KeyFile, KeyScope
from contract.wire.job import JobError
from intrasplat.errors import ErrorCode
from intrasplat.report import Masks
from tests.client.local_service import CLIP
from tests.client.page import CALIBRATION, REPORT_OF_THE_PAGE, Page, Site, site_at
from tests.client.test_sheet_in_browser import drop
from tests.client.test_theatre_in_browser import is_on_screen, screen_of
from tests.client.test_waiting_in_browser import BAR
from tests.client.words import say
from tests.service.test_check import RECTIFIED

SLOW = {"latency": 0, "download_throughput": 10_000_000, "upload_throughput": 250_000}
SHARE = "return document.querySelector('#upload-progress').value"
FINDINGS = """
return [...document.querySelectorAll("#upload .finding")].map((each) => {
  const label = each.previousElementSibling;
  return [label.querySelector("input, select")?.name, each.dataset.code];
});
"""


@pytest.fixture
def large_clip(tmp_path: Path) -> Path:
    """A clip of several pieces: padded with a box that readers pass over."""
    path, padding = tmp_path / "patient name.mp4", bytes(2_000_000)
    path.write_bytes(CLIP.read_bytes() + (8 + len(padding)).to_bytes(4, "big") + b"free" + padding)
    return path


def calibration_at(path: Path, **changes: object) -> Path:
    path.write_text(json.dumps(RECTIFIED | changes))
    return path


@contextmanager
def slow_line(page: Page) -> Iterator[None]:
    page.driver.set_network_conditions(offline=False, **SLOW)
    try:
        yield
    finally:
        page.driver.delete_network_conditions()


def until_half_is_sent(page: Page, clip: Path) -> None:
    page.send(clip)
    page.until(lambda: page.script(SHARE) > 0.3)


def test_wrong_files_are_told_beside_their_fields_before_anything_is_sent(
    site: Site, page: Page, tmp_path: Path
) -> None:
    notes = tmp_path / "notes.mp4"
    notes.write_text("no film at all")
    page.choose("clip", notes)
    page.until(lambda: ["clip", "kind"] in page.script(FINDINGS))
    assert page.script(FINDINGS) == [["clip", "kind"]]  # what is no clip needs no calibration
    assert say("check.kind") in page.text("#upload")
    page.click("#upload [type=submit]")
    page.until_text("#upload-message", say("upload.look"))
    page.choose("clip", CLIP)
    page.until(lambda: page.script(FINDINGS) == [["calibration", "calibration_missing"]])
    page.script("document.querySelector('#upload-message').textContent = ''")
    page.click("#upload [type=submit]")
    page.until_text("#upload-message", say("upload.look"))
    assert page.script("return document.activeElement.name") == "calibration"
    page.choose("calibration", calibration_at(tmp_path / "double.json", width=192, height=160))
    page.until(lambda: page.script(FINDINGS) == [["calibration", "calibration_scaled"]])
    assert page.find(".finding").get_attribute("class") == "finding care"
    page.choose("calibration", calibration_at(tmp_path / "other.json", width=100, height=700))
    page.until(
        lambda: page.script(FINDINGS) == [["calibration", "calibration_size"]]
    )  # the browser read the clip's size
    page.choose("calibration", calibration_at(tmp_path / "metres.json", baseline_mm=0.0045))
    page.until(lambda: page.script(FINDINGS) == [["calibration", "calibration_unreadable"]])
    assert page.find(".finding").get_attribute("class") == "finding bad"  # it would be refused
    page.choose("masks", notes)
    page.until(lambda: ["masks", "kind"] in page.script(FINDINGS))
    names = page.script("return performance.getEntriesByType('resource').map((entry) => new URL(entry.name).pathname)")
    assert "/uploads" not in names
    assert site.queue.records() == []


def test_a_clip_that_failed_for_its_calibration_gets_another_without_being_sent_again(site: Site, page: Page) -> None:
    page.send(CLIP)
    page.until(lambda: site.queue.records())
    claim = site.claim()
    error = JobError(code=ErrorCode.INPUT, problem="No depth within 10 to 300 mm.", field="calibration")
    site.queue.fail(claim, error)
    page.press(claim.job_id, say("job.calibrate"))
    page.until_text("#upload-again", "calibration")
    assert not page.find("#upload [name=clip]").is_displayed()
    page.choose("calibration", CALIBRATION)
    page.click("#upload [type=submit]")
    page.until(lambda: len(site.queue.records()) == 2)
    assert site.queue.get(claim.job_id) is not None
    again = next(each for each in site.queue.records() if each.job_id != claim.job_id)
    assert again.clip_of == claim.job_id
    assert (site.store.spool_folder(again.job_id) / again.files.calibration).read_bytes() == CALIBRATION.read_bytes()


def test_two_eyes_that_differ_are_told_and_doubts_do_not_stop_a_clip(site: Site, page: Page, tmp_path: Path) -> None:
    page.choose("clip", CLIP)
    page.choose("right", CLIP.parent / "stereo_sbs_trimmed.mp4")
    page.until(lambda: ["right", "eyes_differ"] in page.script(FINDINGS))
    page.choose("calibration", calibration_at(tmp_path / "eyes.json", width=192, height=80))
    page.find("#upload [name=label]").send_keys("liver, left lobe")
    page.click("#upload [type=submit]")
    page.until(lambda: site.queue.records())
    (record,) = site.queue.records()
    assert record.labels.label == "liver, left lobe"
    assert record.files.right == "right.mp4"


def test_poses_and_a_field_of_view_are_sent_with_the_clip(site: Site, page: Page, tmp_path: Path) -> None:
    poses, notes, field = (tmp_path / name for name in ("path.tum", "notes.png", "field.png"))
    poses.write_text("0 0 0 0 0 0 0 1\n")
    notes.write_text("no picture")
    assert cv2.imwrite(str(field), np.full((80, 96), 255, np.uint8))
    page.show("drawer")
    page.script("document.querySelector('#upload details').open = true")
    assert say("form.poses_file") in page.text("#upload")
    assert say("form.fov_mask") in page.text("#upload")
    page.choose("clip", CLIP)
    page.choose("calibration", calibration_at(tmp_path / "eyes.json", width=192, height=80))
    page.choose("poses_file", poses)
    page.choose("fov_mask", notes)
    page.until(lambda: ["fov_mask", "kind"] in page.script(FINDINGS))
    page.choose("fov_mask", field)
    page.until(lambda: ["fov_mask", "kind"] not in page.script(FINDINGS))
    page.click("#upload [type=submit]")
    page.until(lambda: site.queue.records())
    (record,) = site.queue.records()
    assert (record.files.poses_file, record.files.fov_mask) == ("poses_file.tum", "fov_mask.png")


def test_a_file_that_changes_after_it_was_chosen_is_told(site: Site, page: Page, large_clip: Path) -> None:
    page.choose("clip", large_clip)
    large_clip.write_bytes(CLIP.read_bytes())
    page.choose("calibration", CALIBRATION)
    page.click("#upload [type=submit]")
    page.until_text("#upload-message", say("upload.changed"))
    page.until(lambda: page.find("#upload [type=submit]").is_enabled())


def test_row_2_what_is_wrong_is_in_view_with_the_options_open(site: Site, page: Page, tmp_path: Path) -> None:
    notes = tmp_path / "notes.mp4"
    notes.write_text("no film at all")
    with screen_of(page, 1280, 800):
        page.show("drawer")
        assert is_on_screen(page, "#upload [name=masks]")  # masks need no options
        page.script("document.querySelector('#upload details').open = true")
        page.send(notes)
        page.until_text("#upload-message", say("upload.look"))
        assert is_on_screen(page, "#upload-message")
        page.until(lambda: is_on_screen(page, "#upload [name=clip]"))  # it has the focus


def test_row_10_an_upload_goes_on_after_a_reload_at_half(site: Site, page: Page, large_clip: Path) -> None:
    with slow_line(page):
        page.show("drawer")
        page.find("#upload [name=label]").send_keys("kidney")
        until_half_is_sent(page, large_clip)
        page.until(lambda: page.script("return document.title").endswith("% · intrasplat"))
        page.driver.refresh()
    page.until_text("#upload-message", say("upload.interrupted"))
    page.until(lambda: is_on_screen(page, "#upload-message"))
    page.until_text("#upload-again", large_clip.name)
    assert not page.find("#upload [type=submit]").is_displayed()
    assert not page.find("#upload [name=masks]").is_displayed()
    other = large_clip.with_name("other.mp4")
    other.write_bytes(CLIP.read_bytes())
    page.choose("clip", other)
    page.until_text("#upload", say("upload.other_file", name=large_clip.name))
    page.choose("clip", large_clip)
    page.choose("calibration", CALIBRATION)
    page.until(lambda: site.queue.records())
    (record,) = site.queue.records()
    assert record.labels.label == "kidney"
    assert (site.store.spool_folder(record.job_id) / record.files.clip).read_bytes() == large_clip.read_bytes()
    entries = page.script(
        "return performance.getEntriesByType('resource').map((entry) => [new URL(entry.name).pathname, "
        "entry.requestStart])"
    )
    names = [name for name, _ in entries]
    assert names.count("/uploads") == 1  # the calibration: the clip went on with the upload that there was
    assert not any("patient" in name for name in names)
    page.show("drawer")
    page.until(lambda: page.find("#upload [type=submit]").is_displayed())


def test_an_upload_survives_a_restart_of_the_service_during_the_reload(
    site: Site, page: Page, large_clip: Path
) -> None:
    with slow_line(page):
        until_half_is_sent(page, large_clip)
        page.driver.refresh()
    page.until_text("#upload-message", say("upload.interrupted"))
    site.stop()
    site.start()
    page.choose("clip", large_clip)
    page.choose("calibration", CALIBRATION)
    page.until(lambda: site.queue.records())
    (record,) = site.queue.records()
    assert (site.store.spool_folder(record.job_id) / record.files.clip).read_bytes() == large_clip.read_bytes()


def test_an_interrupted_clip_may_be_given_up(site: Site, page: Page, large_clip: Path) -> None:
    with slow_line(page):
        until_half_is_sent(page, large_clip)
        page.driver.refresh()
    page.until_text("#upload-again button", say("upload.give_up"))
    page.click("#upload-again button")
    page.until(lambda: page.find("#upload [type=submit]").is_displayed())
    page.until(lambda: not list((site.store.data_dir / "incoming").iterdir()))
    site.announce()  # the last time may be long ago
    page.open()
    page.until_text("#connection", "ready")
    assert page.text("#upload-message") == ""


def test_two_tabs_send_two_clips_and_know_nothing_of_each_other(site: Site, page: Page, large_clip: Path) -> None:
    driver, first = page.driver, page.driver.current_window_handle
    with slow_line(page):
        until_half_is_sent(page, large_clip)
        driver.switch_to.new_window("tab")
        try:
            page.open()
            page.until_text("#connection", "ready")
            assert page.text("#upload-message") == ""
            page.send(CLIP)
            page.until(lambda: page.script("return sessionStorage.getItem('intrasplat-sent')"))
            driver.get("about:blank")
            driver.close()
        finally:
            driver.switch_to.window(first)
    page.until(lambda: len(site.queue.records()) == 2)


def test_a_job_that_was_watched_is_found_again_after_a_reload(site: Site, page: Page) -> None:
    page.send(CLIP)
    page.until_text("#jobs", "waiting")
    page.driver.refresh()
    page.until_text("#stage-message", "The scene opens here")
    claim = site.claim()
    site.train(claim, 20, 24.0)
    page.until_state("training")  # it opened by itself
    page.until(lambda: page.script("return document.title") == f"{round(100 * page.script(BAR))} % · intrasplat")
    site.finish(claim)
    page.until_state("live")
    page.until(lambda: page.script("return document.title") == "intrasplat")


def test_a_job_that_somebody_else_deletes_is_forgotten(site: Site, page: Page) -> None:
    page.send(CLIP)
    page.until(lambda: page.script("return sessionStorage.getItem('intrasplat-sent')"))
    page.driver.get("about:blank")
    claim = site.claim()
    site.queue.fail(claim, JobError(code=ErrorCode.FAULT, problem="It broke."))
    site.store.purge(claim.job_id)  # else the sweep would queue its clip again
    site.queue.forget(claim.job_id)
    page.open()
    page.until(lambda: page.script("return sessionStorage.getItem('intrasplat-sent')") is None)
    page.until_text("#stage-message", say("page.deleted"))


def test_progress_and_failure_are_in_view_while_another_scene_is_looked_at(site: Site, page: Page) -> None:
    scene = site.scene()
    page.send(CLIP)
    page.until_text("#jobs", "waiting")
    page.press(scene, "View")
    page.until_state("live")
    page.until(lambda: is_on_screen(page, "#sent"))
    claim = site.claim()
    site.train(claim, 20, 24.0)
    page.until_text("#sent", "training · 24.0 dB")
    site.queue.fail(claim, JobError(code=ErrorCode.TRAINING_DIVERGED, problem="NaN."))
    page.until_text("#sent", say("problem.training_diverged"))
    page.click("#sent button")
    page.until(lambda: page.text("#sent") == "")


def test_the_browser_tells_when_a_scene_is_ready_if_the_user_has_clicked_for_it(site: Site, page: Page) -> None:
    record = """
    window.told = [];
    window.Notification = new Proxy(window.Notification, {
      construct(target, given) { told.push(given[0]); return new target(...given); },
    });
    """
    page.driver.execute_cdp_cmd("Page.enable", {})
    added = page.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": record})
    try:
        for permission, told in (("granted", [say("announce.done")]), ("prompt", [])):
            setting = {"permission": {"name": "notifications"}, "setting": permission, "origin": site.url}
            page.driver.execute_cdp_cmd("Browser.setPermission", setting)
            page.open()
            page.script("localStorage.clear()")
            page.open()
            if permission == "granted":
                page.show("drawer")
                page.click("#notify")
                page.until(lambda: page.find("#notify").get_attribute("aria-pressed") == "true")
            page.send(CLIP)
            page.until(lambda: page.text("#sent") or page.state != "none")
            site.finish(site.claim())
            page.until_state("live")
            page.until(lambda told=told: page.script("return told") == told)
    finally:
        page.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)
        page.script("localStorage.clear()")


def test_a_key_that_may_not_send_is_told_so_and_asks_for_nothing_that_is_refused(
    tmp_path: Path, driver: webdriver.Chrome
) -> None:
    with site_at(tmp_path / "data", hosts=("127.0.0.1",)) as site:
        keys = KeyFile(tmp_path / "data")
        _, viewing = keys.create("local", {KeyScope.VIEW}, "page")
        _, sending = keys.create("local", {KeyScope.VIEW, KeyScope.RECONSTRUCT}, "page")
        page = Page(driver, site.url)
        page.open()
        page.until(lambda: page.find("#key-text").is_displayed())
        page.until(lambda: page.text("#no-jobs") == say("label.no_key"))
        page.find("#key-text").send_keys(viewing, Keys.ENTER)
        page.until(lambda: page.text("#no-jobs") == say("label.none"))
        page.show("drawer")
        page.until(lambda: page.text("#upload") == say("upload.not_allowed"))  # nothing else is offered
        assert page.text("#upload-message") == ""
        drop(page, CLIP.name)
        assert page.text("#upload-message") == say("upload.not_allowed")
        page.show("library")
        page.click("#forget-key")
        page.until(lambda: page.find("#key-text").is_displayed())
        page.find("#key-text").send_keys(sending, Keys.ENTER)
        page.show("drawer")
        page.until(lambda: page.find("#upload [type=submit]").is_enabled())
        high = "return document.querySelector('#upload [name=priority] [value=high]').disabled"
        page.until(lambda: page.script(high))
        scene = site.scene()
        masked = REPORT_OF_THE_PAGE.model_copy(update={"masks": Masks(source="given", share=0.07)})
        site.store.add_scores("worker-1", scene, 1, masked)
        page.press(scene, "View")
        page.until_text("#report", say("report.send_better_masks"))
        page.click("#forget-key")
        page.until(lambda: page.find("#key-text").is_displayed())
        page.find("#key-text").send_keys(viewing, Keys.ENTER)
        page.press(scene, "View")
        page.until_text("#report", say("report.trusted"))
        assert say("report.send_better_masks") not in page.text("#report")
        assert page.faults() == []
        driver.get("about:blank")
