"""A page at rest in a real browser: what it asks for while nobody uses it, and what it notices all the same."""

from __future__ import annotations

import time

from tests.client.page import Page, Site

REST_S = 9.0
"""Longer than three times after which the page asks whether its scene is there."""
ASKED = "return performance.getEntriesByType('resource').map(({ name }) => new URL(name).pathname)"
CONFIRMED = "return import(document.scripts[0].src).then(({ viewer }) => viewer.screen.confirmedAt / 1000)"


def test_a_page_at_rest_hears_over_the_stream_that_its_scene_is_there(site: Site, page: Page) -> None:
    scene = site.scene("a0")
    page.press(scene, "View")
    page.until_state("live")
    page.until_text("#time-value", "of 40")
    time.sleep(2.5)  # what was under way has come
    page.script("performance.clearResourceTimings()")
    began_s = page.script(CONFIRMED)
    time.sleep(REST_S)
    assert page.script(ASKED) == []
    assert page.state == "live"
    assert page.script(CONFIRMED) > began_s + REST_S - 4
    page.script("dispatchEvent(new Event('focus'))")
    page.until(lambda: "/jobs" in page.script(ASKED))
    site.queue.forget(scene)
    site.store.purge(scene)
    page.until(lambda: page.shade == -1)
    assert page.faults() == []
