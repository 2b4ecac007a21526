"""What a page shows before anybody has chosen anything."""

from __future__ import annotations

import pytest

from client.page import DASHBOARD
from tests.client.page import WORKER, Page, Site, grey_of
from tests.client.test_theatre_in_browser import SIZES, is_on_screen, screen_of
from tests.client.words import say

DROP = """
const transfer = new DataTransfer();
for (const name of ["stereo.mp4", "calibration.json"]) transfer.items.add(new File(["x"], name));
document.querySelector("#stage").dispatchEvent(
  new DragEvent("drop", { dataTransfer: transfer, bubbles: true, cancelable: true }));
const { clip, calibration } = document.querySelector("#upload").elements;
return [clip.files[0].name, calibration.files[0].name];
"""

CHOOSE_GERMAN = """
const choice = document.querySelector("#empty-language");
choice.value = "de";
choice.dispatchEvent(new Event("change", { bubbles: true }));
"""
PILL = "return [document.querySelector('#connection').className, document.querySelector('#connection').textContent]"
LATER = "const now = performance.now.bind(performance); performance.now = () => now() + 61_000"


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_an_empty_page_says_what_it_is_and_how_to_begin(site: Site, page: Page, width: int, height: int) -> None:
    with screen_of(page, width, height):
        page.until(lambda: page.find("#empty").is_displayed())
        assert "intrasplat" in page.text("#empty")
        assert is_on_screen(page, "#empty-example")
        assert is_on_screen(page, "#empty .to-live")
        assert is_on_screen(page, "#tools [data-drawer=drawer]")
        for css in ("#controls", "#measure", "#share", "#tools [data-drawer=report-drawer]"):
            assert not page.find(css).is_displayed(), css
        assert is_on_screen(page, "#empty-language")
        page.script(CHOOSE_GERMAN)
        page.until_text("#empty", say("empty.what", "de"))
        assert page.script("return document.querySelector('#language').value") == "de"
        page.script("localStorage.clear()")
        page.click("#empty-clip")
        assert page.find("#drawer").is_displayed()


def test_one_click_sends_the_example_with_calibration_and_masks(site: Site, page: Page) -> None:
    page.click("#empty-example")
    page.until(lambda: site.queue.records())
    (record,) = site.queue.records()
    folder = site.store.spool_folder(record.job_id)
    for sent, name in ((record.files.clip, "stereo.webm"), (record.files.calibration, "calibration.json")):
        assert (folder / sent).read_bytes() == (DASHBOARD / "example" / name).read_bytes()
    assert record.files.masks is not None
    assert record.labels.label == say("empty.name")
    page.until(lambda: page.text("#badge") == say("screen.example_clip"))
    assert not page.find("#empty").is_displayed()
    assert sum(each.stat().st_size for each in (DASHBOARD / "example").iterdir()) < 1_000_000


def test_a_worker_that_was_never_there_is_starting_for_a_minute_and_one_that_left_is_missed_at_once(
    site: Site, page: Page
) -> None:
    missing = ["pill bad", say("problem.http_503:worker")]
    site.queue.withdraw(WORKER)
    page.open()
    page.until(lambda: page.script(PILL) == ["pill starting", say("page.starting")])
    page.script(LATER)
    page.until(lambda: page.script(PILL) == missing)
    site.announce()
    page.until(lambda: page.script(PILL) == ["pill good", say("page.ready")])
    page.open()
    page.until(lambda: page.script(PILL) == ["pill good", say("page.ready")])
    site.queue.withdraw(WORKER)
    page.until(lambda: page.script(PILL) == missing)


def test_files_may_be_dropped_anywhere(page: Page) -> None:
    assert page.script(DROP) == ["stereo.mp4", "calibration.json"]
    assert page.find("#drawer").is_displayed()


def test_a_page_with_scenes_opens_the_newest(site: Site, page: Page) -> None:
    site.scene()
    newest = site.scene()
    page.open()
    page.until_state("live")
    assert page.shade == pytest.approx(grey_of(newest), abs=2)
    assert not page.find("#library").is_displayed()
    page.press(newest, "Delete")
    page.click("#confirm [value=yes]")
    page.until_text("#stage-message", say("page.deleted"))


def test_a_second_visit_asks_for_ten_things_at_most(site: Site, page: Page) -> None:
    site.scene()
    page.open()
    page.until_state("live")
    page.open()
    page.until_state("live")
    sent = page.script(
        "return performance.getEntriesByType('resource').filter((each) => each.transferSize > 0)"
        ".map((each) => new URL(each.name).pathname)"
    )
    assert len([each for each in sent if each.endswith((".js", ".css", ".svg"))]) == 0
    assert len(sent) <= 10
