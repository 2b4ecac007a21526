"""A scene from a file, opened by the page in a real browser."""

from __future__ import annotations

import base64
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.common.keys import Keys

from contract.access.keys import KeyFile, KeyScope
from intrasplat.scene.archive import archive_parts
from tests.archives import ORIGIN, archived, small_scene, stored
from tests.client.page import Page, Site, site_at
from tests.client.words import say

DROP = """
const bytes = Uint8Array.from(atob(arguments[0]), (letter) => letter.charCodeAt(0));
const transfer = new DataTransfer();
transfer.items.add(new File([bytes], "liver (1).scene.zip"));
const target = document.querySelector("#stage");
target.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true, cancelable: true }));
"""
ASKS = "return !document.querySelector('#import').hidden"


def test_a_scene_is_taken_in_from_a_file_and_opens_by_itself(site: Site, page: Page, tmp_path: Path) -> None:
    file = tmp_path / "patient name.scene.zip"
    file.write_bytes(archived(tmp_path, small_scene()))
    page.until(lambda: page.script(ASKS))
    page.find("#import-file").send_keys(str(file))
    claim = site.claim()
    record = site.queue.get(claim.job_id)
    assert record is not None
    assert record.imported is not None
    assert "patient" not in record.model_dump_json()
    site.finish(claim)
    page.until_state("live")
    page.until(lambda: claim.job_id in page.script("return location.hash"))


def test_a_scene_that_is_dropped_on_the_picture_is_taken_in_under_its_name(
    site: Site, page: Page, tmp_path: Path
) -> None:
    content = b"".join(archive_parts(stored(tmp_path, small_scene()), ORIGIN, "liver, left"))
    page.until(lambda: page.script(ASKS))
    page.script(DROP, base64.b64encode(content).decode())
    record = site.queue.get(site.claim().job_id)
    assert record is not None
    assert record.imported is not None
    assert record.labels.label == "liver, left"
    assert page.script("return document.querySelector('#drawer').hidden")


def test_a_file_that_is_no_scene_is_told_in_plain_words_and_may_be_chosen_again(
    site: Site, page: Page, tmp_path: Path
) -> None:
    file = tmp_path / "scene.zip"
    file.write_bytes(b"no scene")
    for _ in range(2):
        page.until(lambda: page.script(ASKS))
        page.find("#import-file").send_keys(str(file))
        page.until_text("#jobs-message", say("problem.input:scene"))
        page.click("#jobs-message ~ [data-close]")
        page.until(lambda: page.text("#jobs-message") == "")
    assert site.queue.records() == []


def test_a_key_that_may_only_look_is_not_offered_an_import(tmp_path: Path, driver: webdriver.Chrome) -> None:
    with site_at(tmp_path / "data", hosts=("127.0.0.1",)) as site:
        _, key = KeyFile(tmp_path / "data").create("local", {KeyScope.VIEW}, "page")
        page = Page(driver, site.url)
        page.open()
        page.until_text("#key-message", "A key is needed.")
        page.find("#key-text").send_keys(key, Keys.ENTER)
        page.until_text("#no-jobs", say("label.none"))
        assert page.script(ASKS) is False
        driver.get("about:blank")
