"""A browser's capture device as the source of a feed: Chromium's own test picture, pushed as JPEG."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from selenium import webdriver

from intrasplat.live.spec import PICTURE_HEADER
from tests.client.live_feed import CALIBRATION, LivePage, live_painter
from tests.client.page import Site, browser, site_at
from tests.client.words import say

MAX_PER_S = 15.0
FAKE_DEVICE = ("--disable-gpu", "--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")


@pytest.fixture(scope="module")
def driver() -> Iterator[webdriver.Chrome]:
    with browser(FAKE_DEVICE) as driver:
        yield driver


def pictures_of(pushed: bytes) -> list[tuple[float, bytes]]:
    """Times, s, and files of the whole pictures in a stream of bytes."""
    found = []
    while len(pushed) >= PICTURE_HEADER.size:
        at_s, length = PICTURE_HEADER.unpack(pushed[: PICTURE_HEADER.size])
        if len(pushed) < PICTURE_HEADER.size + length:
            break
        found.append((at_s, pushed[PICTURE_HEADER.size : PICTURE_HEADER.size + length]))
        pushed = pushed[PICTURE_HEADER.size + length :]
    return found


def test_a_capture_device_of_the_browser_becomes_a_feed(site: Site, driver: webdriver.Chrome, tmp_path: Path) -> None:
    calibration = tmp_path / "calibration.json"
    calibration.write_text(CALIBRATION)
    page = LivePage(driver, site.url)
    with live_painter(site, tmp_path) as painter:
        driver.get(f"{site.url}/live.html")
        page.until(lambda: page.script("return !document.getElementById('open-feed').hidden"))
        page.click("#open-feed [value=capture]")
        page.script("document.querySelector('#open-feed [name=layout]').value = 'sbs'")
        page.find("#open-feed [name=calibration]").send_keys(str(calibration))
        page.click("#open-feed [type=submit]")
        page.until_text("#word", say("live.word_live"))
        page.until(lambda: any(len(pictures_of(each)) > 20 for each in painter.pushed.values()))
        page.script("document.getElementById('health').open = true")
        page.until_text("#health-list", say("live.sent"))
        (feed,) = site.queue.feeds()
        assert feed.options.source is None
        assert feed.options.layout == "sbs"
        ((push_id, pushed),) = painter.pushed.items()
        pictures = pictures_of(pushed)
        times_s = [at_s for at_s, _ in pictures]
        assert np.all(np.diff(times_s) > 0)
        assert (len(times_s) - 1) / (times_s[-1] - times_s[0]) <= MAX_PER_S + 0.5
        shapes = {cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR).shape for _, file in pictures}
        assert len(shapes) == 1
        painter.replaced.add(push_id)  # another one pushes: this browser stops, and does not fight for the feed
        page.until(lambda: say("live.sent") not in page.text("#health-list"))
        time.sleep(1.5)
        assert list(painter.pushed) == [push_id]
    assert page.faults() == []
    driver.get("about:blank")


@pytest.fixture
def site(tmp_path: Path, driver: webdriver.Chrome) -> Iterator[Site]:
    with site_at(tmp_path / "data") as site:
        yield site
