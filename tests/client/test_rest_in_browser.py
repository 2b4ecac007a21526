"""A page at rest in a real browser: what it asks for while nobody uses it, and what it notices all the same."""

from __future__ import annotations

import time
from pathlib import Path

from selenium import webdriver

from tests.client.page import WORKER, Page, Site, site_at
from tests.client.words import say

REST_S = 9.0
"""Longer than three times after which the page asks whether its scene is there."""
ASKED = "return performance.getEntriesByType('resource').map(({ name }) => new URL(name).pathname)"
SLOW_S = 7.0
"""Longer than the page waits for an answer that costs no picture."""
CONFIRM = """
const [scene, done] = arguments;
import(document.scripts[0].src).then(({ viewer: { pictures } }) => {
  pictures.ask({ scene, t: 0.7, layer: "rgb", unseen: "mark", highlights: "on", format: "jpeg" }).catch(() => {});
  pictures.giveUp();
  pictures.confirm(scene).then(() => done("there"), (error) => done(error.message));
});
"""
CONFIRMED = "return import(document.scripts[0].src).then(({ viewer }) => viewer.screen.confirmedAt / 1000)"


def test_a_page_at_rest_hears_over_the_stream_that_its_scene_is_there(site: Site, page: Page) -> None:
    scene = site.scene("a0")
    page.press(scene, "View")
    page.until_state("live")
    page.until_text("#time-value", "of 40")
    time.sleep(2.5)  # what was under way has come
    site.announce()  # its worker lives
    page.script("performance.clearResourceTimings()")
    began_s = page.script(CONFIRMED)
    time.sleep(REST_S)
    assert page.script(ASKED) in ([], ["/readyz"])
    assert page.state == "live"
    assert page.script(CONFIRMED) > began_s + REST_S - 4
    page.script("dispatchEvent(new Event('focus'))")
    page.until(lambda: "/jobs" in page.script(ASKED))
    site.announce()
    page.until_text("#connection", say("page.ready"))
    site.queue.withdraw(WORKER)
    page.script("return import(document.scripts[0].src).then(({ jobs }) => void (jobs.ticks = 15))")
    page.until_text("#connection", say("problem.http_503:worker"))  # long before the list is asked for
    site.queue.forget(scene)
    site.store.purge(scene)
    page.until(lambda: page.shade == -1)
    assert page.faults() == []


def test_a_scene_is_there_while_the_service_still_draws_a_view_that_was_given_up(
    driver: webdriver.Chrome, tmp_path: Path
) -> None:
    with site_at(tmp_path / "data", render_timeout_s=20.0) as site:
        page = Page(driver, site.url)
        page.open()
        scene = site.scene()
        page.press(scene, "View")
        page.until_state("live")
        page.until_text("#readout", "stream")
        site.painter.pause_s = SLOW_S
        assert page.driver.execute_async_script(CONFIRM, scene) == "there"
        assert page.state == "live"
        driver.get("about:blank")
