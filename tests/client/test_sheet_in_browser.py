"""Measurements, scale, names and tools leave the picture free and stay readable, on phones and larger screens."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from tests.client.page import Page, Site
from tests.client.test_compare_in_browser import choose, recorded_scene
from tests.client.test_controls_in_browser import five, press_key
from tests.client.test_fit_in_browser import CLOSE_PX, is_free_of, picture_box
from tests.client.test_measure_in_browser import click_at
from tests.client.test_theatre_in_browser import box_of, is_on_screen, screen_of
from tests.client.words import say

PHONE, PHONE_ACROSS, LAPTOP, NARROW = (390, 844), (844, 390), (1280, 800), (1024, 700)
LENS = "60,48,80,80,30,24"
LONG_NAME = "Rim of the lesion, left edge"
MEASURED = {
    "A": ("distance", "15,24;30,24"),
    "B": ("distance", "16,25;31,25"),
    LONG_NAME: ("line", "12,14;24,14;24,28"),
    "D": ("area", "12,14;36,14;36,28;12,28"),
    "E": ("angle", "12,14;36,14;36,28"),
}
FOLLOW = """
const [scene, texts] = arguments;
location.hash = `#/scene/${scene}?${texts.map((each) => `m=${encodeURIComponent(each)}`).join("&")}`;
"""
BOXES = """
return [...document.querySelectorAll(arguments[0])].map((each) => {
  const { left, top, right, bottom } = each.getBoundingClientRect();
  return [left, top, right, bottom];
});
"""
CUT_NAMES = """
return [...document.querySelectorAll("#measuring .list input")]
  .filter(({ scrollWidth, clientWidth }) => scrollWidth > clientWidth).map(({ value }) => value);
"""
CUT_RINGS = """
const cut = [];
const all = ".status button, #stage, .tools button, .controls :is(button, select, input)";
for (const each of document.querySelectorAll(all)) {
  if (!each.checkVisibility()) continue;
  each.focus({ focusVisible: true });
  const style = getComputedStyle(each);
  if (document.activeElement !== each) continue; // what is disabled takes no focus
  if (style.outlineStyle === "none") {
    cut.push(`${each.id || each.textContent} has no ring`);
    continue;
  }
  const out = parseFloat(style.outlineOffset) + parseFloat(style.outlineWidth);
  const { left, top, right, bottom } = each.getBoundingClientRect();
  const isWithin = (box) =>
    Math.min(left - box.left, top - box.top, box.right - right, box.bottom - bottom) >= out - 1;
  let isCut = !isWithin({ left: 0, top: 0, right: innerWidth, bottom: innerHeight });
  for (let over = each.parentElement; over !== document.body; over = over.parentElement) {
    isCut ||= getComputedStyle(over).overflow !== "visible" && !isWithin(over.getBoundingClientRect());
  }
  if (isCut) cut.push(each.id || each.textContent);
}
document.activeElement.blur();
return cut;
"""
MOVE_SEAM = "document.querySelector('#seam').dispatchEvent(new KeyboardEvent('keydown', { key: arguments[0] }))"
FOCUS_FIELD = """
const fields = [...document.querySelectorAll(`#${arguments[0]} :is(input:not([type=file]), select)`)];
const field = fields.find((each) => each.checkVisibility() && !each.disabled);
field?.focus();
return field !== undefined && document.activeElement === field;
"""
HAS_MORE = "return document.querySelector('#measuring').hasAttribute('data-more')"
DROP = """
const files = new DataTransfer();
files.items.add(new File(["x"], arguments[0]));
const how = { bubbles: true, cancelable: true, dataTransfer: files };
document.querySelector("#stage").dispatchEvent(new DragEvent("drop", how));
"""

Box = tuple[float, float, float, float]


def drop(page: Page, name: str) -> None:
    """A file of this name, on the picture."""
    page.script(DROP, name)


def follow_measured(site: Site, page: Page, scene: str) -> None:
    """Go to the link of a scene with MEASURED."""
    texts = [f"{name}~{kind}~0~{LENS}~~{points}" for name, (kind, points) in MEASURED.items()]
    site.announce()
    page.script(FOLLOW, scene, texts)
    page.until(lambda: len(page.driver.find_elements(By.CSS_SELECTOR, ".measured text")) == len(MEASURED))


def viewed(site: Site, page: Page) -> str:
    scene = recorded_scene(site)
    page.press(scene, "View")
    page.until_state("live")
    page.until(lambda: page.script("return !document.querySelector('#verdict').hidden"))  # its report is known
    return scene


def is_within(inner: Box, outer: Box) -> bool:
    return all(inner[i] >= outer[i] - CLOSE_PX and inner[i + 2] <= outer[i + 2] + CLOSE_PX for i in (0, 1))


def are_apart(one: Box, other: Box) -> bool:
    return min(min(one[i + 2], other[i + 2]) - max(one[i], other[i]) for i in (0, 1)) < CLOSE_PX


def boxes(page: Page, css: str) -> list[Any]:
    found: list[Any] = page.script(BOXES, css)
    return found


@pytest.mark.parametrize("size", [PHONE, PHONE_ACROSS, LAPTOP])
def test_measurements_leave_the_picture_in_view_and_can_all_be_read(
    site: Site, page: Page, size: tuple[int, int]
) -> None:
    with screen_of(page, *size):
        scene = viewed(site, page)
        follow_measured(site, page, scene)
        page.until(lambda: is_free_of(page, "#measuring"))
        page.until(lambda: all(is_within(each, picture_box(page)) for each in boxes(page, ".measured path")))
        texts = boxes(page, ".measured text")
        assert [pair for pair in itertools.combinations(texts, 2) if not are_apart(*pair)] == []
        points = boxes(page, ".measured path.point")
        if size != PHONE_ACROSS:  # there is too little space
            assert [pair for pair in itertools.product(texts, points) if not are_apart(*pair)] == []
        assert page.script(CUT_NAMES) == []
        page.until(lambda: page.script(HAS_MORE))  # and says that there is more below
        assert is_on_screen(page, "#measuring .end")
        if size == PHONE:
            _, top, _, bottom = box_of(page, "#measuring")
            assert bottom - top <= size[1] / 3
            assert bottom >= box_of(page, "#controls")[1] - 10
            small = picture_box(page)
            page.click("#measuring .fold")
            page.until(lambda: picture_box(page)[3] - picture_box(page)[1] > 1.03 * (small[3] - small[1]))
            assert page.find("#measuring .fold").get_attribute("aria-expanded") == "false"
            assert not page.find("#measuring .list").is_displayed()
            page.click("#measuring .fold")
        name = page.find("#measuring li:nth-child(1) input")
        name.send_keys(Keys.CONTROL + "a", Keys.NULL, Keys.DELETE, Keys.TAB)
        assert page.find("#measuring .told").is_displayed()
        assert page.text("#measuring .told") == say("measure.unnamed", name="A")
        assert name.get_attribute("value") == "A"
        buttons = page.driver.find_elements(By.CSS_SELECTOR, "#controls button, #tools button")
        assert {each.text for each in buttons} & set(MEASURED) == set()


@pytest.mark.parametrize("size", [PHONE, PHONE_ACROSS, NARROW])
def test_a_drawer_that_is_closed_while_measuring_gives_all_back(site: Site, page: Page, size: tuple[int, int]) -> None:
    with screen_of(page, *size):
        scene = viewed(site, page)
        follow_measured(site, page, scene)
        page.until(lambda: is_free_of(page, "#measuring"))
        parts = ("#tools", "#measuring", "#controls", "#picture")
        before = [box_of(page, css) for css in parts]
        for drawer in ("library", "drawer", "report-drawer"):
            page.find(f"#tools [data-drawer={drawer}]").click()
            page.until(lambda drawer=drawer: page.find(f"#{drawer}").is_displayed())  # type: ignore[misc]
            if size == NARROW:
                page.until(lambda drawer=drawer: is_free_of(page, f"#{drawer}"))  # type: ignore[misc]
            assert page.script(FOCUS_FIELD, drawer) or drawer == "report-drawer"
            press_key(page, Keys.ESCAPE)  # it closes what is in front first, from its fields too
            assert not page.find(f"#{drawer}").is_displayed()
            page.until(lambda: [box_of(page, css) for css in parts] == before)
            assert len(page.driver.find_elements(By.CSS_SELECTOR, ".measured text")) == len(MEASURED)
        press_key(page, Keys.ESCAPE)
        assert not page.find("#measuring").is_displayed()


@pytest.mark.parametrize("size", [PHONE, PHONE_ACROSS, LAPTOP, (1920, 1080)])
def test_scale_and_names_of_both_sides_lie_in_the_picture_and_no_ring_is_cut(
    site: Site, page: Page, size: tuple[int, int]
) -> None:
    with screen_of(page, *size):
        viewed(site, page)
        site.announce()
        page.until(lambda: page.find("#scale").is_displayed())
        page.until(lambda: is_within(box_of(page, "#scale"), picture_box(page)))
        for mode in ("wipe", "side"):
            choose(page, mode)
            page.until_text("#of-recorded", say("compare.recorded", frame=1))
            page.script("document.querySelector('#more').open = false")
            page.until(lambda: is_within(box_of(page, "#of-model"), picture_box(page)))
            page.until(lambda: is_within(box_of(page, "#scale"), picture_box(page)))
            left, top, right, bottom = picture_box(page)
            model = box_of(page, "#picture")
            recorded = box_of(page, "#recorded")
            moved = (recorded[0] - model[0], recorded[1] - model[1])
            assert is_within(
                box_of(page, "#of-recorded"),
                (left + moved[0], top + moved[1], right + moved[0], bottom + moved[1]),
            )
        choose(page, "wipe")
        for key, side in (("Home", "#of-recorded"), ("End", "#of-model")):  # a side that is gone has no name
            page.script(MOVE_SEAM, key)
            left, _, right, _ = box_of(page, side)
            assert right - left <= 1
        choose(page, "off")
        press_key(page, Keys.TAB)
        assert page.script(CUT_RINGS) == []


def test_across_a_phone_the_theatre_has_its_slider_and_takes_files(site: Site, page: Page) -> None:
    with screen_of(page, *PHONE_ACROSS):
        viewed(site, page)
        press_key(page, "t")
        page.until(lambda: is_on_screen(page, "#time"))
        left, top, right, bottom = box_of(page, "#time")
        assert right - left > 0.5 * PHONE_ACROSS[0]
        assert bottom - top >= 44
        before = page.text("#time-value")
        ActionChains(page.driver).click(page.find("#time")).perform()
        page.until(lambda: page.text("#time-value") != before)
        assert picture_box(page)[3] - picture_box(page)[1] > 0.4 * PHONE_ACROSS[1]
        five(page, say("live.measure"))
        click_at(page, 0.25, 0.5)
        page.click("#measuring .end")
        drop(page, "clip.mp4")
        page.until(lambda: page.find("#drawer").is_displayed())
        assert page.script("return document.querySelector('#upload [name=clip]').files[0].name") == "clip.mp4"
        page.script("localStorage.clear()")
