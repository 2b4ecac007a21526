"""What light and smoke did over the clip: a strip under the time line, and sentences in the report."""

from __future__ import annotations

import pytest

from intrasplat.report import LightChanges
from tests.cameras import CAMERAS
from tests.client.page import REPORT_OF_THE_PAGE, WORKER, Page, Site
from tests.client.test_theatre_in_browser import box_of, screen_of
from tests.client.words import LANGUAGES, say

FRAMES = len(CAMERAS.frame_times_s)
STOPS = tuple(round(0.2 * frame - 1.5, 3) for frame in range(FRAMES))
SMOKE = tuple(0.1 if frame < FRAMES / 2 else 0.4 for frame in range(FRAMES))
LIGHT = LightChanges(
    reference=7, stops=STOPS, red=(1.1,) * FRAMES, blue=(0.9,) * FRAMES, smoke_share=SMOKE, vignetting=0.62
)
THUMB_PX = 16
PLACES = """
const line = document.querySelector("#light-strip polyline");
const { a, e, d, f } = line.getScreenCTM();
return [...line.points].map(({ x, y }) => [a * x + e, d * y + f]);
"""
LINES = "return [...document.querySelectorAll('#report .lit li')].map((each) => each.textContent)"


def view(site: Site, page: Page, light: LightChanges | None) -> None:
    """Open a scene of a clip in this light, and wait for its report."""
    scene = site.scene()
    site.store.add_scores(WORKER, scene, 1, REPORT_OF_THE_PAGE.model_copy(update={"light": light}))
    page.press(scene, "View")
    page.until_state("live")
    page.until_text("#time-value", "40")
    page.show("report-drawer")
    page.until_text("#report", say("report.trusted"))
    page.click("#report-drawer [data-close]")


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_the_strip_has_a_place_for_each_of_the_sliders_and_takes_none_from_others(
    site: Site, page: Page, width: int, height: int
) -> None:
    with screen_of(page, width, height):
        view(site, page, None)
        assert not page.find("#light-strip").is_displayed()
        without = [box_of(page, css) for css in ("#controls", "#time", "#time-value")]
        view(site, page, LIGHT)
        assert page.find("#light-strip").is_displayed()
        assert [box_of(page, css) for css in ("#controls", "#time", "#time-value")] == without
        left, top, right, bottom = box_of(page, "#time")
        places = page.script(PLACES)
        assert len(places) == FRAMES == int(page.find("#time").get_attribute("max") or 0) + 1
        first, last = left + THUMB_PX / 2, right - THUMB_PX / 2
        wanted = [first + (last - first) * frame / (FRAMES - 1) for frame in range(FRAMES)]
        assert [x for x, _ in places] == pytest.approx(wanted, abs=1)
        assert all((top + bottom + THUMB_PX) / 2 <= y <= bottom for _, y in places)  # below the thumb
        assert [y for _, y in places] == sorted((y for _, y in places), reverse=True)  # it becomes brighter


@pytest.mark.parametrize("language", LANGUAGES)
def test_the_strip_and_the_report_say_in_words_what_light_and_smoke_did(site: Site, page: Page, language: str) -> None:
    page.script("localStorage.setItem('intrasplat-language', 'en')")
    page.open()
    view(site, page, LIGHT)
    page.speak(language)
    point = "." if language == "en" else ","
    low, high = f"-1{point}5", f"{STOPS[-1]:.1f}".replace(".", point)
    stops = say("strip.stops", language, low=low, high=high, frame=8)
    smoke = say("strip.smoke", language, low="10 %", high="40 %", mean="25 %")
    name = " ".join([say("strip.name", language), stops, smoke])
    page.until(lambda: page.find("#light-strip").get_attribute("aria-label") == name)
    gains = [
        say(f"strip.{channel}", language, low=gain.replace(".", point), high=gain.replace(".", point), frame=8)
        for channel, gain in (("red", "1.10"), ("blue", "0.90"))
    ]
    border = say("strip.border", language, share="62 %")
    assert page.script(LINES) == [stops, *gains, smoke, border]
    page.script("localStorage.clear()")


def test_smoke_alone_is_an_area_and_the_next_scene_has_its_own(site: Site, page: Page) -> None:
    view(site, page, LightChanges(smoke_share=SMOKE))
    drawn = "return [...document.querySelectorAll('#light-strip *')].map((each) => each.tagName)"
    assert page.script(drawn) == ["polygon"]
    view(site, page, LightChanges(vignetting=0.5))
    assert not page.find("#light-strip").is_displayed()
    assert page.script(LINES) == [say("strip.border", share="50 %")]
