"""Addresses of views, help, full screen and a screen that stays lit, in a real browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from selenium import webdriver
from selenium.webdriver.common.keys import Keys

from contract.access.keys import KeyFile, KeyScope
from tests.client.page import Page, Site, site_at
from tests.client.test_camera_in_browser import scene, shown
from tests.client.words import say

__all__ = ["scene"]
POSE = "orbit:12.00,-4.00,1.500,3.00,-2.00,55.00"


def test_the_address_follows_the_view_and_a_reload_brings_it_back(page: Page, scene: str) -> None:
    entries = page.script("return history.length")
    page.find("#stage").send_keys(Keys.ARROW_LEFT, "+", *["."] * 10)
    page.script("const l = document.querySelector('#layer'); l.value = 'depth'; l.dispatchEvent(new Event('change'))")
    page.until(lambda: f"#/scene/{scene}?t=0.25&pose=orbit:-3.00,0.00,1.100&layer=depth" in page.driver.current_url)
    assert page.script("return history.length") == entries  # one press of Back leaves the page
    page.driver.refresh()
    page.until(lambda: page.state == "live")
    page.until_text("#time-value", "frame 11 of 40")
    view = shown(page)
    assert (view["scene"], view["pose"], view["layer"]) == (scene, "orbit:-3.00,0.00,1.100", "depth")
    assert view["t"] == pytest.approx(0.25)
    assert page.script("return document.querySelector('#layer').value") == "depth"


def test_an_address_that_somebody_sent_opens_its_view(site: Site, page: Page) -> None:
    scene = site.scene()
    page.driver.get(f"{site.url}/#/scene/{scene}?t=0.5&pose={POSE}")
    page.until(lambda: page.state == "live" and shown(page)["pose"] == POSE)
    assert shown(page)["t"] == pytest.approx(0.5)
    other = site.scene()
    page.script("location.hash = arguments[0]", f"#/scene/{other}?pose=right")
    page.until(lambda: (shown(page) or {}).get("scene") == other)
    page.until(lambda: say("view.right_eye") in page.view)


@pytest.mark.parametrize(
    ("tail", "place"),
    [
        ("#/nonsense", "address.unknown"),
        ("#/scene/0123", "address.scene"),
        ("#/scene/{scene}?t=early", "address.t"),
        ("#/scene/{scene}?t=2", "address.t"),
        ("#/scene/{scene}?pose=above", "address.pose"),
        ("#/scene/{scene}?pose=orbit:120,0,1", "address.pose"),
        ("#/scene/{scene}?layer=xray", "address.layer"),
    ],
)
def test_a_wrong_address_is_told_in_plain_words(site: Site, page: Page, tail: str, place: str) -> None:
    scene = site.scene()
    page.driver.get("about:blank")
    page.driver.get(f"{site.url}/{tail.format(scene=scene)}")
    page.until_text("#address-message", say(place))
    if "{scene}" in tail:  # what can be read of it is shown
        page.until_state("live")
        assert (shown(page)["pose"], shown(page)["layer"]) == (None, "rgb")
    else:
        page.until(lambda: page.find("#library").is_displayed())


def test_an_address_of_a_scene_that_is_gone_says_so(site: Site, page: Page) -> None:
    strokes = f"intrasplat-strokes-{'0' * 32}"
    page.script("sessionStorage.setItem(arguments[0], '[1]')", strokes)
    page.driver.get(f"{site.url}/#/scene/{'0' * 32}")
    page.until_text("#stage-message", say("problem.http_404:scene"))
    gone = "return import(document.scripts[0].src).then(({ jobs }) => jobs.gone.size)"
    page.until(lambda: page.script(gone) == 1)
    assert page.script("return sessionStorage.getItem(arguments[0])", strokes) == "[1]"  # it may be another key's


def test_an_address_waits_for_the_key_and_never_holds_it(tmp_path: Path, driver: webdriver.Chrome) -> None:
    with site_at(tmp_path / "data", hosts=("127.0.0.1",)) as site:
        _, key = KeyFile(tmp_path / "data").create("local", {KeyScope.VIEW}, "page")
        scene = site.scene()
        page = Page(driver, f"{site.url}/#/scene/{scene}?t=0.5")
        page.open()
        page.until_text("#key-message", "A key is needed.")
        page.find("#key-text").send_keys(key, Keys.ENTER)
        page.until_state("live")
        assert shown(page)["t"] == pytest.approx(0.5)
        page.until_text("#time-value", "frame")  # the cameras, which were refused before, are asked for again
        page.find("#stage").send_keys("+")
        page.until(lambda: "pose=" in driver.current_url)
        assert key not in driver.current_url
        driver.get("about:blank")


def test_the_link_is_copied(page: Page, scene: str) -> None:
    page.driver.execute_cdp_cmd(
        "Browser.grantPermissions", {"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]}
    )
    page.find("#stage").send_keys("l")
    page.until_text("#address-message", say("address.copied"))
    read = "navigator.clipboard.readText().then(arguments[0], (error) => arguments[0](String(error)))"
    assert page.driver.execute_async_script(read) == page.driver.current_url  # type: ignore[no-untyped-call]
    assert f"#/scene/{scene}" in page.driver.current_url
    page.driver.execute_cdp_cmd("Browser.resetPermissions", {})


KEYS = """
const done = arguments[0];
const address = new URL("base/keys.js", document.scripts[0].src);
import(address).then(({ keyRows }) => done(keyRows().flatMap(({ keys }) => Object.keys(keys))));
"""


@pytest.mark.parametrize("language", ["en", "de"])
def test_the_help_tells_every_key_and_gesture_in_both_languages(site: Site, page: Page, language: str) -> None:
    page.script("localStorage.setItem('intrasplat-language', arguments[0])", language)
    page.driver.refresh()
    page.until(lambda: page.script("return document.documentElement.lang") == language)
    page.find("body").send_keys("?")
    page.until(lambda: page.find("#help").is_displayed())
    keys = page.driver.execute_async_script(KEYS)  # type: ignore[no-untyped-call]
    told = page.script("return [...document.querySelectorAll('#help kbd')].map((each) => each.textContent)")
    names = {"ArrowLeft": "←", "ArrowRight": "→", "ArrowUp": "↑", "ArrowDown": "↓"}
    names |= {key: say(f"key.{key}", language) for key in (" ", "Home", "PageUp", "PageDown")}
    assert {names.get(key, key) for key in keys} <= set(told)
    assert "undefined" not in page.text("#help")
    assert "help." not in page.text("#help")
    for place in ("help.turn", "gesture.pinch", "help.focus", "help.loop_start"):
        assert say(place, language) in page.text("#help")
    page.find("#help").send_keys(Keys.ESCAPE)
    page.until(lambda: not page.find("#help").is_displayed())
    page.script("localStorage.clear()")


def test_keys_are_left_to_what_is_typed_into(site: Site, page: Page) -> None:
    page.show("library")
    page.find("#search").send_keys("f?a ,")
    assert page.find("#search").get_attribute("value") == "f?a ,"
    assert not page.find("#help").is_displayed()


def test_the_page_takes_the_whole_screen_and_gives_it_back(page: Page, scene: str) -> None:
    page.find("#stage").send_keys("f")
    page.until(lambda: page.script("return document.fullscreenElement === document.documentElement"))
    assert page.find("#full-screen").get_attribute("aria-pressed") == "true"
    page.find("#full-screen").click()
    page.until(lambda: page.script("return document.fullscreenElement === null"))


def test_the_screen_stays_lit_while_a_scene_plays_or_a_job_trains(site: Site, page: Page) -> None:
    page.script(
        """
        window.locks = new Set();
        const request = navigator.wakeLock.request.bind(navigator.wakeLock);
        navigator.wakeLock.request = async (kind) => {
          const lock = await request(kind);
          locks.add(lock);
          lock.addEventListener("release", () => locks.delete(lock));
          return lock;
        };
        """
    )
    lit = "return window.locks.size"
    page.press(site.scene(), "View")
    page.until_state("live")
    assert page.script(lit) == 0
    page.find("#stage").send_keys(" ")
    page.until(lambda: page.script(lit) == 1)
    page.find("#stage").send_keys(" ")
    page.until(lambda: page.script(lit) == 0)
    site.queued_job()
    claim = site.claim()
    site.train(claim, 20, 24.0)
    page.press(claim.job_id, "Watch")
    page.until_state("training")
    page.until(lambda: page.script(lit) == 1)
    site.finish(claim)
    page.until(lambda: page.script(lit) == 0)
