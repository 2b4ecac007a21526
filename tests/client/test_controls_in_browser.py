"""Two sets of controls, rocking, and what keys, popups and drawers do in a real browser."""

from __future__ import annotations

import re
import time

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from intrasplat.notices import NoticeCode
from tests.client.page import Page, Site
from tests.client.test_accessible_in_browser import LAYOUT, MIN_LETTER_PX, MIN_TOUCH_PX, violations
from tests.client.test_accessible_in_browser import axe as axe
from tests.client.test_compare_in_browser import recorded_scene
from tests.client.test_measure_in_browser import click_at
from tests.client.test_theatre_in_browser import is_on_screen, screen_of
from tests.client.words import say
from tests.reports import a_warning

THEATRE_SIZES = [(1920, 1080), (1280, 800), (820, 1180), (390, 844), (844, 390)]
MIN_BUTTON_PX = 64
MIN_FAR_PX = 28
"""Of letters that are read at 3 m from a screen of 1080 lines."""
BADGE_PX = 48
ROCK_DEG = 8
TAUGHT_DEG = 20
IDLE_S = 5.5
HIDDEN = ("#tools button", "#controls button", "#controls select", "[data-action=delete]", "[data-action=rename]")
FIVE = "return [...document.querySelectorAll('#five button')].map((each) => each.getBoundingClientRect().height)"
FONT = "return parseFloat(getComputedStyle(document.querySelector(arguments[0])).fontSize)"
SHOWN = "return [...document.querySelectorAll(arguments[0])].filter((each) => each.checkVisibility()).length"
WATCH = """
const done = arguments[0];
import(document.scripts[0].src).then(({ viewer }) => {
  window.yaws = [];
  const yaw = (pose) => Number(pose.split(/[:,]/)[1]);
  viewer.addEventListener("shown", ({ detail }) => detail.pose && window.yaws.push(yaw(detail.pose)));
  done();
});
"""
MEASURED = """
const panel = document.querySelector("#measuring");
const edge = (each, name) => each.getBoundingClientRect()[name];
const covered = [...panel.querySelectorAll("li")]
  .filter((each) => edge(each.querySelector(".figure"), "right") > edge(each.lastChild, "left")).length;
const [across, below] = [panel.scrollWidth - panel.clientWidth, panel.scrollHeight - panel.clientHeight];
return { covered, across, below };
"""
"""Figures under a button, and what of the panel is to be scrolled to, px."""
PLACE = "return (async () => (await import(document.scripts[0].src)).viewer.orbit.place)()"
IS_PLAYING = "return document.querySelector('#play').getAttribute('aria-pressed') === 'true'"


def press_key(page: Page, key: str) -> None:
    ActionChains(page.driver).send_keys(key).perform()


def viewed(site: Site, page: Page) -> None:
    page.press(recorded_scene(site), "View")
    page.until_state("live")
    page.until_text("#time-value", "40")


def five(page: Page, words: str) -> None:
    """Press one of the theatre's buttons."""
    page.find("#five")
    for button in page.driver.find_elements(By.CSS_SELECTOR, "#five button"):
        if button.text == words:
            return button.click()
    raise AssertionError(words)


def test_the_theatre_has_five_large_buttons_letters_for_3_m_and_nothing_that_deletes(site: Site, page: Page) -> None:
    site.painter.warnings = [a_warning("Of the scene.", NoticeCode.POSES_UNSURE)]
    with screen_of(page, 1920, 1080):
        viewed(site, page)
        assert not page.find("#five").is_displayed()
        page.find("#tools [data-switch-controls]").click()
        assert len(page.script(FIVE)) == 5
        assert min(page.script(FIVE)) >= MIN_BUTTON_PX
        page.driver.execute_async_script(WATCH)  # type: ignore[no-untyped-call]
        five(page, say("live.look"))
        page.until(lambda: page.script("return Math.min(...yaws) < -6 && Math.max(...yaws) > 6"))
        assert page.script("return Math.max(...yaws.map(Math.abs))") <= ROCK_DEG + 0.01
        page.until_text("#status-text", say("live.rocking"))
        press_key(page, Keys.PAGE_UP)  # a presenter's other button
        page.until(lambda: page.script(PLACE) is None)
        press_key(page, Keys.PAGE_DOWN)
        page.until(lambda: page.script(IS_PLAYING))
        five(page, say("live.freeze"))
        page.until(lambda: not page.script(IS_PLAYING))
        five(page, say("live.measure"))
        site.announce()
        for x in (0.25, 0.5):
            click_at(page, x, 0.5)
            page.until(lambda: page.script("return document.querySelectorAll('.measured path').length") >= 2)
        page.until(lambda: page.text("#measuring .figure"))
        page.click("#measuring .again")
        for x in (0.3, 0.6):
            click_at(page, x, 0.7)
        page.until(lambda: len(page.driver.find_elements(By.CSS_SELECTOR, "#measuring .figure")) == 2)
        page.until(lambda: page.script(MEASURED) == {"covered": 0, "across": 0, "below": 0})
        far = ("#picture-warning", "#scale .about", "#time-value", ".measured text", "#measuring .figure")
        assert {css: page.script(FONT, css) for css in far if page.script(FONT, css) < MIN_FAR_PX} == {}
        assert page.script(FONT, "#badge") >= BADGE_PX
        five(page, say("tool.scenes_more"))
        page.until(lambda: page.find("#library").is_displayed())
        assert page.script(SHOWN, "[data-action=view]") == 1
        assert page.find("#library [data-does='#snapshot']").text == say("snapshot.take")
        assert {css: page.script(SHOWN, css) for css in HIDDEN} == dict.fromkeys(HIDDEN, 0)
        page.driver.refresh()
        page.until_state("live")
        assert page.find("#five").is_displayed()
        five(page, say("tool.scenes_more"))
        page.find("#library [data-switch-controls]").click()
        assert page.find("#tools").is_displayed()
        assert not page.find("#five").is_displayed()


@pytest.mark.parametrize(("width", "height"), THEATRE_SIZES)
def test_the_theatre_is_accessible_and_nothing_overlaps(
    site: Site, page: Page, axe: str, width: int, height: int
) -> None:
    page.driver.execute_cdp_cmd("Page.setBypassCSP", {"enabled": True})
    page.driver.refresh()
    with screen_of(page, width, height):
        viewed(site, page)
        press_key(page, "t")
        found = {"scene": violations(page, axe)}
        assert page.script(LAYOUT, MIN_TOUCH_PX, MIN_LETTER_PX) == {"over": [], "off": [], "small": [], "faint": []}
        assert min(page.script(FIVE)) >= MIN_BUTTON_PX
        five(page, say("live.measure"))
        found["measuring"] = violations(page, axe)
        assert is_on_screen(page, "#measuring .end")
        page.click("#measuring .end")
        five(page, say("tool.scenes_more"))
        found["library"] = violations(page, axe)
        page.script("localStorage.clear()")
    assert {state: each for state, each in found.items() if each} == {}


def test_it_rocks_within_what_the_clip_taught_and_goes_back_to_where_it_began(site: Site, page: Page) -> None:
    viewed(site, page)
    page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.look({ pose: 'orbit:18,0,1' }))")
    page.until_text("#status-text", "+18")
    page.driver.execute_async_script(WATCH)  # type: ignore[no-untyped-call]
    press_key(page, "r")
    page.until(lambda: page.script("return yaws.length > 5 && Math.max(...yaws) > 18 && yaws.at(-1) < 6"))
    assert page.script("return Math.max(...yaws)") <= TAUGHT_DEG + 0.01
    assert page.script("return Math.max(...yaws) - Math.min(...yaws)") <= 2 * ROCK_DEG + 0.01
    press_key(page, "r")
    page.until_text("#status-text", "+18")
    press_key(page, "r")
    page.until_text("#status-text", say("live.rocking"))
    press_key(page, Keys.ARROW_LEFT)  # a hand
    page.until(lambda: page.find("#rock").get_attribute("aria-pressed") == "false")


def test_after_a_click_space_plays_and_for_keyboards_it_works_what_has_the_focus(site: Site, page: Page) -> None:
    with screen_of(page, 1280, 800):
        viewed(site, page)
        for css in ("#way summary", "#speed"):
            page.find(css).click()
            if css == "#speed":
                press_key(page, Keys.ESCAPE)  # its list
            press_key(page, Keys.SPACE)
            page.until(lambda: page.script(IS_PLAYING))
            press_key(page, Keys.SPACE)
            page.until(lambda: not page.script(IS_PLAYING))
        assert page.script("return document.querySelector('#way').open")
        time.sleep(IDLE_S)
        assert not page.script(
            "return document.querySelector('#theatre').hasAttribute('data-idle')"
        )  # it is being read
        page.script("document.querySelector('#highlights').focus()")
        press_key(page, Keys.TAB)
        assert page.script("return document.activeElement.closest('#way') !== null")
        press_key(page, Keys.SPACE)
        assert not page.script("return document.querySelector('#way').open")
        assert not page.script(IS_PLAYING)


def test_time_stands_while_the_picture_does(site: Site, page: Page) -> None:
    viewed(site, page)
    press_key(page, Keys.SPACE)
    page.until(lambda: page.script(IS_PLAYING))
    site.stop()
    page.until_state("stale")
    stood = page.text("#time-value")
    time.sleep(2)
    assert (page.state, page.text("#time-value")) == ("stale", stood)
    site.start()
    site.announce()
    page.until_state("live")
    page.until(lambda: page.text("#time-value") != stood)


def test_a_long_status_is_read_whole_and_a_drawer_tells_that_there_is_more_below(site: Site, page: Page) -> None:
    with screen_of(page, 1280, 800):
        for _ in range(4):
            site.scene()
        viewed(site, page)
        height = page.script("return document.querySelector('#status').offsetHeight")
        page.script(
            "import(document.scripts[0].src).then(({ viewer }) => viewer.look({ t: 0.5, pose: 'orbit:24,-8,1.2' }))"
        )
        page.until_text("#status-text", say("view.beyond"))
        page.script("document.querySelector('#guess').click()")
        page.until_text("#status-text", say("picture.guesses"))
        cut = "const { scrollWidth, clientWidth, scrollHeight, clientHeight } = document.querySelector(arguments[0]);"
        cut += "return [scrollWidth - clientWidth, scrollHeight - clientHeight]"
        assert max(page.script(cut, ".status-line")[:1] + page.script(cut, "#status-text")) <= 1
        assert page.script("return document.querySelector('#status').offsetHeight") == height
        page.show("library")
        page.until(lambda: page.script("return document.querySelector('#library').hasAttribute('data-more')"))
        assert re.search(r"\d\u00a0s\u00a0long", page.text("#jobs"))
        page.script("const library = document.querySelector('#library'); library.scrollTop = library.scrollHeight")
        page.until(lambda: not page.script("return document.querySelector('#library').hasAttribute('data-more')"))
