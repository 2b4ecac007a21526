"""The form that opens a feed: what it says of a source, and that the service has the same rules."""

from __future__ import annotations

from pathlib import Path

import pytest

from intrasplat.errors import InputError
from intrasplat.live.spec import parsed
from tests.client.live_feed import LivePage
from tests.client.page import Site
from tests.client.test_live_in_browser import page as page
from tests.client.test_live_in_browser import painter as painter
from tests.client.words import say

TYPE = """
const { source } = document.querySelector("#open-feed").elements;
source.value = arguments[0];
source.dispatchEvent(new Event("change", { bubbles: true }));
"""
FAULTS = """
const [texts, done] = arguments;
import("/live/sources.js").then(({ faultOf }) => done(texts.map((text) => [text, faultOf("url", text)])));
"""
EXAMPLES_FAULTS = """
return import("/live/sources.js").then(
  ({ EXAMPLES, faultOf }) => Object.entries(EXAMPLES).map(([from, text]) => faultOf(from, text)));
"""
GOOD_ADDRESSES = [
    "rtsp://camera.example.org/1",
    "RTSPS://me:secret@camera:322",
    "rtsp://me:s@cret@[::1]:8554/1?a=b",
    "rtsp://camera:/1",
    "rtsp://camera:0/1",
    "http://camera?a=b",
    "https://@camera/#",
    "tcp://10.0.0.7:5000",
    "udp://[ff02::1]:65535",
    "rtsp://camera/" + "a" * 1986,
]
BAD_ADDRESSES = [
    "srt://camera:9",
    "rtsp://",
    "rtsp://:554/1",
    "rtsp://me@/1",
    "rtsp://camera:65536/1",
    "rtsp://camera:x/1",
    "rtsp://camera/#1",
    "http://camera#x",
    "rtsp://kamera-süd/1",
    "rtsp://camera/a b",
    "http://me:secret@camera/",
    "tcp://camera",
    "udp://camera:",
    "tcp://camera:0",
    "rtsp://[::1/1",
    "rtsp://camera/" + "a" * 1987,
]


def test_a_feed_that_cannot_be_opened_says_why(site: Site, page: LivePage, tmp_path: Path) -> None:
    page.driver.get("about:blank")
    page.driver.get(f"{site.url}/live.html")
    page.until_text("#no-feeds", say("live.none_open"))
    assert say("page.notice") in page.text("#opening")
    assert page.script(EXAMPLES_FAULTS) == ["", ""]
    assert str(page.find("#open-feed [name=source]").get_attribute("placeholder")).startswith("rtsp://")
    calibration = tmp_path / "calibration.json"
    calibration.write_text('{"model": "rectified"}')
    page.until(lambda: page.find("#open-feed [name=calibration]").is_displayed())
    page.find("#open-feed [name=calibration]").send_keys(str(calibration))
    page.find("#open-feed [name=source]").send_keys("rtsp://nowhere.example.org/1")
    page.click("#open-feed [type=submit]")
    page.until_text("#open-message", say("problem.not_listed"))

    def fault(kind: str, text: str) -> str:
        page.click(f"#open-feed [name=from][value={kind}]")
        page.script(TYPE, text)
        return page.text("#source-fault")

    for kind, text, place in (
        ("url", "/data/stereo.mp4", "source_is_path"),
        ("url", "camera", "source_no_url"),
        ("url", "https://me:secret@camera/1", "source_user"),
        ("url", "tcp://camera", "source_port"),
        ("url", "rtsp://camera:99999/1", "source_unfit"),
        ("file", "rtsp://camera/1", "source_is_url"),
        ("file", "stereo.mp4", "source_no_path"),
    ):
        assert fault(kind, text) == say(f"live.{place}"), text
        assert page.find("#open-feed [name=source]").get_attribute("aria-invalid") == "true"
    for kind, text in (
        ("url", "rtsp://me:secret@[::1]:8554/1?a=b"),
        ("url", "udp://camera:5000"),
        ("file", "v4l2:///dev/video0"),
    ):
        assert fault(kind, text) == "", text
        assert page.find("#open-feed [name=source]").get_attribute("aria-invalid") == "false"
    faults = page.driver.execute_async_script(FAULTS, [*GOOD_ADDRESSES, *BAD_ADDRESSES])  # type: ignore[no-untyped-call]
    assert [text for text, fault in faults if not fault] == GOOD_ADDRESSES
    assert page.text("#source-note") == say("live.source_note_file")
    page.click("#open-feed [type=submit]")
    page.until_text("#open-message", say("problem.not_listed"))


def test_pickers_of_files_speak_the_language_of_the_page(site: Site, page: LivePage, tmp_path: Path) -> None:
    page.script("localStorage.setItem('intrasplat-language', 'de')")
    file = tmp_path / "endoskop.json"
    file.write_text("{}")
    for path, form in (("live.html", "#open-feed"), ("", "#upload")):
        page.driver.get("about:blank")
        page.driver.get(f"{site.url}/{path}")
        page.until(lambda: page.find("html").get_attribute("lang") == "de")
        shown = f"return document.querySelector('{form} label:has([name=calibration]) .picked').textContent"
        page.until(lambda shown=shown: page.script(shown) == say("form.pick", "de") + say("form.picked_none", "de"))  # type: ignore[misc]
        page.find(f"{form} [name=calibration]").send_keys(str(file))
        page.until(lambda shown=shown: page.script(shown) == say("form.pick", "de") + file.name)  # type: ignore[misc]
        page.script(f"document.querySelector('{form}').reset()")
        page.until(lambda shown=shown: page.script(shown).endswith(say("form.picked_none", "de")))  # type: ignore[misc]
        own = f"return getComputedStyle(document.querySelector('{form} [name=calibration]')).color"
        assert page.script(own) == "rgba(0, 0, 0, 0)"


@pytest.mark.parametrize("url", GOOD_ADDRESSES)
def test_the_service_takes_what_the_form_lets_pass(url: str) -> None:
    assert parsed(url).host


@pytest.mark.parametrize("url", BAD_ADDRESSES)
def test_the_service_takes_no_address_that_the_form_refuses(url: str) -> None:
    with pytest.raises(InputError):
        parsed(url)
