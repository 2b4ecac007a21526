"""Addresses of the live screen: of a feed, of a moment of it, and of what is not there."""

from __future__ import annotations

import time
from datetime import UTC, datetime

import pytest

from intrasplat.live.looking import FUTURE_S
from tests.client.live_feed import LivePage, LivePainter, opened_feed
from tests.client.page import Site
from tests.client.test_live_in_browser import page as page
from tests.client.test_live_in_browser import painter as painter
from tests.client.words import say

CLOCK_TIME = "return import('/base/element.js').then(({ clockTime }) => clockTime(1000 * arguments[0]))"


def test_the_page_leads_to_open_feeds(site: Site, page: LivePage, painter: LivePainter) -> None:
    feed_id = opened_feed(site, "theatre 2")
    page.driver.get(site.url)
    page.until(lambda: page.script("return document.querySelector('#tools [data-drawer=library]') !== null"))
    page.show("library")
    page.until_text("#open-feeds", "theatre 2")
    page.driver.get("about:blank")
    page.driver.get(f"{site.url}/#/live/{feed_id}")
    page.until(lambda: page.driver.current_url == f"{site.url}/live.html#/{feed_id}")
    page.until_text("#word", say("live.word_live"))


@pytest.mark.parametrize("path", [f"live.html#/{32 * '0'}", "live.html#/cut0ff", "#/live/nonexistent"])
def test_an_address_of_no_open_feed_leads_to_those_that_are_open(
    site: Site, page: LivePage, painter: LivePainter, path: str
) -> None:
    feed_id = opened_feed(site, "theatre 2")
    page.driver.get("about:blank")
    page.driver.get(f"{site.url}/{path}")
    page.until_text("#unknown-feed", say("live.unknown"))
    page.until_text("#feeds", "theatre 2")
    assert not page.find("#screen").is_displayed()
    page.click("#feeds a")
    page.until(lambda: page.driver.current_url == f"{site.url}/live.html#/{feed_id}")
    page.until_text("#word", say("live.word_live"))


def test_an_address_of_a_moment_that_is_not_stored_says_so_and_how_to_come_to_live(
    site: Site, page: LivePage, painter: LivePainter
) -> None:
    feed_id = opened_feed(site)

    def open_at(at_s: float) -> None:
        page.watch(f"{feed_id}?at={datetime.fromtimestamp(at_s, UTC).isoformat(timespec='milliseconds')}")

    begin, middle, end = say("live.moment_gone", **{"from": "|", "to": "|"}).split("|")
    for at_s in (painter.began_s - 3600, time.time() + 3600):
        open_at(at_s)
        page.until_text("#model-message", begin)
        text = page.text("#model-message").removeprefix(begin)
        assert text.endswith(end)
        stored_from, stored_to = text.removesuffix(end).split(middle)
        assert stored_from == page.script(CLOCK_TIME, painter.began_s)
        assert stored_to != stored_from
        assert page.script("return document.getElementById('live').classList.contains('wanted')")
        page.click("#live")
        page.until(lambda: page.state == "live" and page.text("#model-message") == "")
    open_at(time.time() + FUTURE_S / 2)
    page.until_text("#model-age", "of ")
    assert page.text("#word") == say("live.word_frozen", time=page.text("#model-age").removeprefix("of "))
