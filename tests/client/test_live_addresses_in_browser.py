"""Addresses of the live screen: of a feed, of a moment of it, and of what is not there."""

from __future__ import annotations

import pytest

from tests.client.live_feed import LivePage, LivePainter, opened_feed
from tests.client.page import Site
from tests.client.test_live_in_browser import page as page
from tests.client.test_live_in_browser import painter as painter
from tests.client.words import say


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
