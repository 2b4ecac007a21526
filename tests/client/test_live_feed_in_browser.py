"""The live screen before a feed that is really followed: `intrasplat up`, and a phantom pushed in real time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium import webdriver

from intrasplat_client import NotFound
from lab.demo import started_service
from tests.client.live_feed import LivePage
from tests.client.page import browser
from tests.client.test_live_in_browser import CLICK, DRAG_TAPE
from tests.client.words import say
from tests.live.senders import PhantomSender
from tests.test_live_end_to_end import Push, eventually, past_s
from tests.test_live_end_to_end import sender as sender


@pytest.fixture(scope="module")
def driver() -> Iterator[webdriver.Chrome]:
    with browser() as driver:
        yield driver


def test_a_feed_is_watched_frozen_measured_kept_and_ended(
    tmp_path: Path, sender: PhantomSender, driver: webdriver.Chrome
) -> None:
    calibration = tmp_path / "calibration.json"
    calibration.write_text(sender.calibration.model_dump_json())
    with started_service(tmp_path / "data", tmp_path / "service.log") as client:
        page = LivePage(driver, client.url)
        driver.get(client.url)
        page.script("localStorage.setItem('intrasplat-language', 'en')")
        feed = client.open_feed(calibration, layout="sbs", width=128, label="room 4")
        page.watch(feed.id)
        page.until_text("#word", say("live.word_connecting"))
        push = Push(f"{client.url}{feed.links['video']}", sender)
        push.start()
        eventually(lambda: past_s(client, feed.id) > 4, lambda: client.feed(feed.id))
        for name in ("live", "model"):
            page.until(lambda name=name: not page.script(f"return document.getElementById('{name}-picture').hidden"))  # type: ignore[misc]
        page.until(lambda: page.script("return !document.getElementById('tape').disabled"))

        page.click("#freeze")
        page.until(lambda: page.state == "frozen")
        page.click("#measure")
        page.script(CLICK, 0.4, 0.5)
        page.until(lambda: page.text("#measured") not in ("", say("live.measure_first"), say("live.measure_asking")))
        page.script(CLICK, 0.6, 0.5)
        page.until(lambda: "±" in page.text("#measured") or "Not measured" in page.text("#measured"))
        page.click("#live")
        page.script(DRAG_TAPE, -3)
        page.until(lambda: page.state == "back")
        page.until_text("#model-age", "of ")
        page.click("#live")

        page.click("#keep")
        page.until_text("#kept", say("live.kept_open"))
        page.click("#pause")
        page.until_text("#word", say("live.word_paused"))
        page.until(lambda: page.script("return !document.getElementById('pause').disabled"))
        page.click("#pause")
        page.until(lambda: page.state not in ("paused", "connecting"))
        page.click("#end")
        page.click("#confirm [value=yes]")
        page.until_text("#word", say("live.word_ended"))
        push.end()
        with pytest.raises(NotFound):
            client.feed(feed.id)
        (job,) = client.jobs()
        client.cancel(job.id)
        assert page.faults() == []
        driver.get("about:blank")
        time.sleep(0.2)
