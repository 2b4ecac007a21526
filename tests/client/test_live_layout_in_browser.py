"""The live screen judged by axe-core in every state and size, and its layout: nothing overlaps, all can be touched."""

from __future__ import annotations

import time

import pytest

from intrasplat.live.state import FeedReason, FeedState
from tests.client.live_feed import LivePage, LivePainter
from tests.client.page import Site
from tests.client.test_accessible_in_browser import LAYOUT, MIN_LETTER_PX, MIN_TOUCH_PX, violations
from tests.client.test_accessible_in_browser import axe as axe
from tests.client.test_live_in_browser import DRAG_TAPE, watched
from tests.client.test_live_in_browser import page as page
from tests.client.test_live_in_browser import painter as painter
from tests.client.test_theatre_in_browser import SIZES, box_of, screen_of
from tests.client.words import LANGUAGES, say

LIVE_SIZES = (*SIZES, (844, 390))
ACTIONS = ("freeze", "look", "measure", "keep", "live")
MIN_ACTION_PX = 64
FAR_HEIGHT, MIN_FAR_PX = 1080, 32
NOTES = ("why", "kept", "message", "live-age", "model-age", "trust", "trust-why")
LETTERS = """
const sizeOf = (id) => parseFloat(getComputedStyle(document.getElementById(id)).fontSize);
return Object.fromEntries(arguments[0].map((id) => [id, sizeOf(id)]));
"""
"""Sizes of the letters that say age, trust and reason, px."""
CUT_NOTES = """
const notes = document.querySelector(".notes");
const { bottom } = notes.getBoundingClientRect();
const isCut = (each) => each.getBoundingClientRect().bottom > bottom + 1 || each.scrollWidth > each.clientWidth;
const said = [...notes.children].filter((each) => each.checkVisibility() && each.textContent);
return said.filter(isCut).map(({ id }) => id);
"""
"""Notes beside the word that are not to be seen whole."""


@pytest.mark.parametrize(
    ("width", "height", "language"), [(*size, LANGUAGES[n % 2]) for n, size in enumerate(LIVE_SIZES)]
)
def test_it_is_accessible_and_fits_in_every_state(
    site: Site, page: LivePage, painter: LivePainter, axe: str, width: int, height: int, language: str
) -> None:
    page.driver.execute_cdp_cmd("Page.setBypassCSP", {"enabled": True})
    page.script("localStorage.setItem('intrasplat-language', arguments[0])", language)
    found, layout = {}, {}
    with screen_of(page, width, height):
        page.driver.get("about:blank")
        page.driver.get(f"{site.url}/live.html")
        page.until_text("#no-feeds", say("live.none_open", language))
        found["opening"] = violations(page, axe)
        watched(site, page, "theatre 2")

        def judge(state: str) -> None:
            found[state] = violations(page, axe)
            layout[state] = page.script(LAYOUT, MIN_TOUCH_PX, MIN_LETTER_PX)

        judge("live")
        assert box_of(page, ".below > a")[2] <= width
        assert page.text(".below > a") == say("live.all_feeds", language)
        sizes = page.script(
            "return arguments[0].map((id) => document.getElementById(id).getBoundingClientRect().height)", ACTIONS
        )
        assert min(sizes) >= MIN_ACTION_PX
        page.click("#screen [data-switch-controls]")
        judge("theatre")
        if height == FAR_HEIGHT:
            for controls in ("theatre", "desk"):
                page.script("document.documentElement.dataset.controls = arguments[0]", controls)
                letters = page.script(LETTERS, NOTES)
                assert min(letters.values()) >= MIN_FAR_PX, (controls, letters)
            page.script("document.documentElement.dataset.controls = 'theatre'")
        assert not page.find("#end").is_displayed()
        page.click("#screen [data-switch-controls]")
        page.click("#measure")
        page.until(lambda: page.state == "frozen")
        judge("frozen")
        page.click("#live")
        page.script(DRAG_TAPE, -12)
        page.until(lambda: page.state == "back")
        judge("back")
        page.click("#live")
        page.click("#keep")
        page.until_text("#kept", say("live.kept_open", language))
        painter.stops_s, painter.state, painter.reason = time.time(), FeedState.STALLED, FeedReason.SILENT
        page.until(lambda: page.state == "lost")
        page.until_text("#why", say("live.reason_silent", language)[:10])
        judge("lost")
        assert page.script(CUT_NOTES) == []
        painter.reason = FeedReason.UNDECODABLE  # a longer word, and a longer reason
        page.until_text("#word", say("live.word_unusable", language))
        assert "kept" not in page.script(CUT_NOTES)
        painter.state, painter.reason = FeedState.NO_TISSUE, None
        page.until(lambda: page.state == "empty")
        judge("empty")
        page.script("document.getElementById('health').open = true")
        found["health"] = violations(page, axe)
        page.click("#end")
        page.until(lambda: page.find("#confirm").is_displayed())
        found["question"] = violations(page, axe)
    assert [(state, *each) for state, some in found.items() for each in some] == []
    fine = {"over": [], "off": [], "small": [], "faint": []}
    assert [(state, each) for state, each in layout.items() if each != fine] == []
