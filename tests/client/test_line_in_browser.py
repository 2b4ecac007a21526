"""Slow lines in a real browser: pictures of a view that moves are small enough to come, and full when it rests."""

from __future__ import annotations

import time
from pathlib import Path

from selenium import webdriver

from tests.client.page import Page, site_at
from tests.client.slow_line import slow_line
from tests.client.tissue import BIT_PER_S, LATENCY_S, WATCH, WIDTH, TissuePainter

WATCHED_S = 8.0
MIN_RATE_HZ = 2.0


def test_a_slow_line_shows_a_moving_picture_and_a_full_one_at_rest(tmp_path: Path, driver: webdriver.Chrome) -> None:
    with (
        site_at(tmp_path / "data", TissuePainter().answer) as site,
        slow_line(int(site.url.rpartition(":")[2]), BIT_PER_S, LATENCY_S) as port,
    ):
        site.scene()
        page = Page(driver, f"http://127.0.0.1:{port}")
        page.open()
        page.until_state("live")
        page.until(lambda: page.script("return document.querySelector('#picture').width") == WIDTH)
        page.script(WATCH)
        page.until(lambda: not page.script("return document.querySelector('#play').disabled"))
        site.announce()  # its worker lives
        page.click("#play")
        time.sleep(WATCHED_S)
        site.announce()
        pictures = page.script("return pictures")
        page.click("#play")
        began_s, ended_s = pictures[0][0], pictures[-1][0]
        print(f"{(len(pictures) - 1) / (ended_s - began_s):.1f} pictures a second, {pictures[-1][1]} pixels wide")
        assert (len(pictures) - 1) / (ended_s - began_s) >= MIN_RATE_HZ
        assert ended_s - began_s > WATCHED_S / 2
        assert pictures[-1][1] < WIDTH
        page.until(lambda: page.script("return document.querySelector('#picture').width") == WIDTH)
        assert page.faults() == []
        driver.get("about:blank")
