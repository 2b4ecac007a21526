"""Two scenes of the library beside one another, in a real browser."""

from __future__ import annotations

import pytest
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from contract.wire.labels import LabelChange
from tests.cameras import CAMERAS
from tests.client.page import REPORT_OF_THE_PAGE, WORKER, Page, Site, grey_of
from tests.client.test_camera_in_browser import SHORTER_CAMERAS, SHORTER_FRAMES
from tests.client.test_compare_in_browser import choose, shade_at, view
from tests.client.words import say


def until_halves(page: Page, left: int, right: int) -> None:
    """The shades of both scenes' pictures."""
    page.until(lambda: abs(shade_at(page, 0.5) - left) <= 2 and abs(page.shade - right) <= 2)


def test_another_scene_follows_beside_until_it_is_deleted(site: Site, page: Page) -> None:
    site.queued_job("10")
    other, scene = site.finish(site.claim(), scored=False), site.scene("e0")
    for job_id, label in ((other, "fast"), (scene, "quality")):
        site.queue.relabel(job_id, LabelChange(label=label))
    view(page, scene)
    page.until(
        lambda: other in page.script("return [...document.querySelector('#beside').options].map((o) => o.value)")
    )
    page.until_text("#time-value", "of 40")
    site.painter.cameras = SHORTER_CAMERAS  # of the other clip
    page.script("document.querySelector('#more').open = true")
    first = "return document.querySelector('#beside option').textContent"
    assert page.script(first) == say("compare.with_another")
    Select(page.find("#beside")).select_by_value(other)  # begins with a seam
    assert page.script(first) == say("compare.with_recording")
    until_halves(page, grey_of(other), grey_of(scene))
    assert page.find("#seam").is_displayed()
    for css, name in (("#of-recorded", "fast"), ("#of-model", "quality")):
        page.until_text(css, name)
        page.until_text(css, "0.00 s")
    page.until_text("#of-recorded", say("light.pending"))
    site.store.add_scores(WORKER, other, 1, REPORT_OF_THE_PAGE)
    for css in ("#of-recorded", "#of-model"):
        page.until_text(css, say("light.care"))
    page.until_text("#of-recorded", page.text("#picture-warning"))  # of the same report

    page.find("#stage").send_keys(Keys.ARROW_LEFT)  # both turn, and the comparison goes on
    page.until(lambda: "turned" in page.view)
    for _ in range(10):
        page.find("#step-on").click()
    same_second = pytest.approx(10 / SHORTER_FRAMES, abs=1e-3)
    page.until(lambda: (asked := site.painter.asked) and asked.scene_id == other and asked.t == same_second)
    assert site.painter.asked is not None
    assert site.painter.asked.pose is not None
    moments = ("#of-recorded", "#of-model")
    page.until(lambda: len({page.text(css).split(" · ")[1] for css in moments}) == 1)  # the same second
    assert "0.00 s" not in page.text("#of-recorded")

    page.script("const time = document.querySelector('#time'); time.value = 35; time.dispatchEvent(new Event('input'))")
    page.until_text("#of-recorded", say("compare.over"))
    site.painter.cameras = CAMERAS

    site.painter.not_recorded = other
    Select(page.find("#layer")).select_by_value("recorded")
    page.until_text("#of-recorded", say("compare.no_frames"))
    assert shade_at(page, 0.5) == 0
    Select(page.find("#layer")).select_by_value("rgb")
    until_halves(page, grey_of(other), grey_of(scene))

    page.script("document.querySelector('#beside').value = ''")  # as before the other scene is listed
    choose(page, "side")
    page.until(lambda: f"compare=side,{other}" in page.driver.current_url)
    address = page.driver.current_url
    page.driver.get("about:blank")
    page.driver.get(address)
    until_halves(page, grey_of(other), grey_of(scene))
    assert page.find("#compare").get_attribute("value") == "side"
    assert page.find("#beside").get_attribute("value") == other

    site.store.purge(other)
    site.queue.forget(other)
    page.until_text("#compare-message", "fast")
    assert page.find("#compare").get_attribute("value") == "off"
    assert shade_at(page, 0.5) == -1
    assert page.state == "live"
    page.until(lambda: "compare=" not in page.driver.current_url)
    assert not page.find("#of-recorded").get_attribute("title")
