"""Measuring in a real browser: under the pointer, between two points, over time, by mouse and by keyboard."""

from __future__ import annotations

import csv
import io
import math
import re

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from intrasplat.colours import COLOUR_TABLE, ERROR_COLOURS
from intrasplat.picture import BRIGHTEST_ERROR, Layer
from intrasplat.report import Recorded
from tests.cameras import FRAMES
from tests.client.page import CAMERA, REPORT_OF_THE_PAGE, Page, Site
from tests.client.words import say
from tests.measurements import DEPTH_MM, RANGE_MM, UNCERTAINTY_MM, stretch

MM_A_PIXEL = DEPTH_MM / CAMERA.fx
RECORDED = Recorded(frames=(0, 4), eyes=("left",), width=60, height=48, masks=False, size_bytes=9)
CAUGHT = """
URL.createObjectURL = (blob) => {
  blob.text().then((text) => Object.assign((window.caught ??= {}), { text }));
  return "";
};
HTMLAnchorElement.prototype.click = function () { (window.caught ??= {}).name = this.download; };
"""
PLACES = """
const { placeInPicture } = await import(new URL("measure/pointer.js", document.scripts[0].src));
const { viewer } = await import(document.scripts[0].src);
const { u, v, scale } = placeInPicture(document.querySelector("#picture"), viewer.shown.camera, 0, 0);
return [u, v, scale, viewer.shown.camera.width, viewer.shown.camera.height];
"""


def viewed(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")


def on_screen(page: Page, x: float, y: float) -> tuple[int, int]:
    """Where a point of the picture, in shares of it, is on the screen."""
    u, v, scale, width, height = page.script(f"return (async () => {{ {PLACES} }})()")
    return round(scale * (x * width - u)), round(scale * (y * height - v))


def point(page: Page, x: float, y: float) -> ActionChains:
    """The mouse at a point of the picture, in shares of it."""
    actions = ActionChains(page.driver, duration=0)
    actions.w3c_actions.pointer_action.move_to_location(*on_screen(page, x, y))
    return actions


def click_at(page: Page, x: float, y: float) -> None:
    point(page, x, y).click().perform()


def start(site: Site, page: Page) -> None:
    viewed(site, page)
    page.click("#measure")
    page.until_text("#measuring .told", say("measure.first"))


def distance_of(page: Page) -> float:
    """As the page says it, in mm."""
    return float(page.text("#measuring .figure").split()[0])


def test_the_pages_colours_are_the_workers(page: Page) -> None:
    found = page.script("return (async () => [...(await import('/stage/colours.js')).COLOURS])()")
    assert bytes(found) == COLOUR_TABLE


def test_depth_and_trust_are_told_where_the_pointer_rests_and_go_when_it_moves(site: Site, page: Page) -> None:
    viewed(site, page)
    point(page, 0.4, 0.4).perform()
    page.until_text(".probe", say("measure.depth", depth=f"{DEPTH_MM:.1f}", sigma=f"{UNCERTAINTY_MM}", trust="90"))
    point(page, 0.9, 0.4).perform()
    page.until_text(".probe", say("measure.low_confidence"))
    point(page, 0.4, 0.1).perform()
    page.until_text(".probe", say("measure.unseen"))
    page.script("document.querySelector('#stage').dispatchEvent(new PointerEvent('pointerleave'))")
    assert page.text(".probe") == ""


def test_two_clicks_measure_and_the_distance_follows_the_time(site: Site, page: Page) -> None:
    start(site, page)
    assert say("measure.research") in page.text("#measuring")
    click_at(page, 0.25, 0.5)
    page.until(lambda: "2" not in page.text("#measuring .figure") and "±" in page.text("#measuring .told"))
    click_at(page, 0.5, 0.5)
    page.until(lambda: page.text("#measuring .figure"))
    began = distance_of(page)
    assert began == pytest.approx(0.25 * CAMERA.width * MM_A_PIXEL, abs=0.4)
    assert f"± {UNCERTAINTY_MM}" in page.text("#measuring .figure")
    assert page.script("return document.querySelectorAll('.measured polyline').length") == 2
    label = page.find("#measuring svg").get_attribute("aria-label") or ""
    assert any(f"{began * 0.9 + off:.1f}" in label for off in (-0.1, 0.0, 0.1))  # both are rounded
    ends = "return [...document.querySelector('.measured .line').points].map(({ x }) => x)"
    left, right = page.script(ends)
    page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.look({ t: 0.25 }))")
    page.until(lambda: distance_of(page) == pytest.approx(began * stretch(0.25), abs=0.15))
    wider = page.script(ends)
    assert (wider[1] - wider[0]) / (right - left) == pytest.approx(stretch(0.25), rel=0.02)
    page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.timeline.play(true))")
    page.until(lambda: not math.isclose(distance_of(page), began * stretch(0.25), abs_tol=0.3))
    page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.timeline.goTo(1e9))")
    page.until_text("#measuring .figure", say("measure.away"))  # it is lost in the last frame


def measure(page: Page, kind: str, *points: tuple[float, float]) -> None:
    Select(page.find("#measuring .kind")).select_by_value(kind)
    for number, at in enumerate(points, 1):
        click_at(page, *at)
        page.until_text("#measuring .told", say("measure.next", count=number, reading="").split(":")[0])


def test_measurements_stay_are_named_deleted_saved_and_found_again_by_their_link(site: Site, page: Page) -> None:
    start(site, page)
    measure(page, "distance", (0.25, 0.5), (0.5, 0.5))
    measure(page, "line", (0.2, 0.3), (0.4, 0.3), (0.4, 0.6))
    measure(page, "area", (0.2, 0.3), (0.6, 0.3), (0.6, 0.6), (0.2, 0.6))
    measure(page, "angle", (0.2, 0.3), (0.6, 0.3), (0.6, 0.6))
    width, height = CAMERA.width * MM_A_PIXEL, CAMERA.height * MM_A_PIXEL

    def values() -> list[tuple[float, str]]:
        found = re.findall(r"([\d.,]+) ± [\d.]+ ?(mm²|mm|°)$", page.text("#measuring .list"), re.MULTILINE)
        return [(float(value.replace(",", "")), unit) for value, unit in found]

    page.until(lambda: len(values()) == 4)
    assert [unit for _, unit in values()] == ["mm", "mm", "mm²", "°"]
    line, area = values()[1][0], values()[2][0]
    assert line == pytest.approx(0.2 * width + 0.3 * height, abs=0.5)
    assert area == pytest.approx(0.4 * width * 0.3 * height, rel=0.05)
    assert say("measure.pieces", pieces="").strip(", ") in page.text("#measuring .pieces:not(:empty)")
    names = "return [...document.querySelectorAll('#measuring .list input')].map(({ value }) => value)"
    assert page.script(names) == ["A", "B", "C", "D"]
    assert page.script("return document.querySelectorAll('.measured text').length") == 4

    page.click("#measuring li:nth-child(1) button")
    page.until(lambda: len(values()) == 3)
    name = page.find("#measuring li:nth-child(1) input")
    name.send_keys(Keys.CONTROL + "a", Keys.NULL, "Rim, left~", Keys.TAB)
    page.script(CAUGHT)
    page.click("#measuring .csv")
    page.until(lambda: page.script("return window.caught?.text"))
    caught = page.script("return window.caught")
    assert caught["name"].endswith("-measurements.csv")
    rows = list(csv.DictReader(io.StringIO(caught["text"])))
    assert len(rows) == 3 * FRAMES
    assert {row["name"] for row in rows} == {"Rim, left", "C", "D"}
    first, last = rows[0], rows[FRAMES - 1]
    assert float(first["value"]) == pytest.approx(line, abs=0.1)
    assert float(first["high"]) - float(first["low"]) == pytest.approx(2 * UNCERTAINTY_MM, abs=1e-3)
    assert (last["value"], last["low"], last["high"], last["trust"]) == ("", "", "", "0.1")

    page.until(lambda: "m=Rim" in page.script("return location.hash"))
    before, link = values(), page.script("return location.href")
    page.driver.get("about:blank")
    page.driver.get(link)
    page.until(lambda: values() == before)
    assert page.script(names) == ["Rim, left", "C", "D"]
    page.until(lambda: page.script("return document.querySelectorAll('.measured .line').length") == 3)
    page.find("#stage").send_keys(Keys.ESCAPE)
    assert page.script("return document.querySelectorAll('.measured *').length") == 0
    page.click("#measure")
    page.until(lambda: page.script("return document.querySelectorAll('.measured .line').length") == 3)
    page.script("location.hash = location.hash.replace(/m=[^&]*/, 'm=A~circle~0')")
    page.until_text("#address-message", say("address.measures"))
    page.until(lambda: len(values()) == 2)


def test_the_range_of_depths_is_set_in_the_legend_stays_in_the_link_and_goes_back(site: Site, page: Page) -> None:
    viewed(site, page)
    Select(page.find("#layer")).select_by_value("depth")
    page.until(lambda: page.find("#legend .near").get_attribute("value") == f"{RANGE_MM[0]:.0f}")
    assert not page.find("#legend .auto").is_enabled()
    far = page.find("#legend .far")
    far.send_keys(Keys.CONTROL + "a", Keys.NULL, "30", Keys.TAB)  # set the other way round, they are swapped
    near = page.find("#legend .near")
    page.until(lambda: (near.get_attribute("value"), far.get_attribute("value")) == ("30", f"{RANGE_MM[0]:.0f}"))
    far.send_keys(Keys.CONTROL + "a", Keys.NULL, "90", Keys.TAB)
    page.until_text("#legend .high", say("legend.farthest", mm="90"))
    near.send_keys(Keys.CONTROL + "a", Keys.NULL, f"{RANGE_MM[0]:.0f}", Keys.TAB)
    page.until_text("#legend .low", say("legend.nearest", mm=f"{RANGE_MM[0]:.0f}"))
    asked = site.painter.asked
    assert asked is not None
    assert (asked.near_mm, asked.far_mm) == (RANGE_MM[0], 90)
    page.until(lambda: "range=45,90" in page.script("return location.hash"))
    link = page.script("return location.href")
    page.driver.get("about:blank")
    page.driver.get(link)
    page.until_text("#legend .high", say("legend.farthest", mm="90"))
    page.click("#legend .auto")
    page.until_text("#legend .high", say("legend.farthest", mm=f"{RANGE_MM[1]:.0f}"))
    assert site.painter.asked is not None
    assert site.painter.asked.near_mm is None


def test_the_error_against_the_recording_is_offered_where_frames_are_kept_and_has_a_legend(
    site: Site, page: Page
) -> None:
    viewed(site, page)
    page.until(lambda: page.script("return !document.querySelector('#verdict').hidden"))  # its report is known
    assert page.script("return document.querySelector('#layer [value=error]').disabled")
    site.queued_job()
    with_frames = site.finish(site.claim(), report=REPORT_OF_THE_PAGE.model_copy(update={"recorded": RECORDED}))
    page.press(with_frames, "View")
    page.until(lambda: not page.script("return document.querySelector('#layer [value=error]').disabled"))
    page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.look({ pose: 'orbit:5,0,1' }))")
    page.until(lambda: "+5" in page.view)
    Select(page.find("#layer")).select_by_value("error")
    page.until_text("#legend", say("legend.error"))
    assert page.text("#legend .low") == say("legend.darker", levels=BRIGHTEST_ERROR)
    assert page.text("#legend .high") == say("legend.brighter", levels=BRIGHTEST_ERROR)
    colours = page.script("return getComputedStyle(document.querySelector('#legend .colours')).backgroundImage")
    ends = [f"rgb({', '.join(map(str, ERROR_COLOURS[i : i + 3]))})" for i in (0, 3, 6)]
    assert colours == f"linear-gradient(to right, {', '.join(ends)})"
    assert site.painter.asked is not None
    assert (site.painter.asked.layer, site.painter.asked.pose) == (Layer.ERROR, None)  # as recorded
    assert not page.find("#legend .range").is_displayed()
    assert page.state == "live"
    site.painter.lacks_frames = True  # they turn out to be damaged
    page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.look({ t: 0.5 }))")
    page.until_text("#address-message", say("problem.input:layer"))
    page.until(lambda: page.state == "live" and page.script("return document.querySelector('#layer').value") == "rgb")


def test_a_distance_follows_the_tissue_when_the_view_turns(site: Site, page: Page) -> None:
    start(site, page)
    click_at(page, 0.25, 0.5)
    page.until(lambda: "±" in page.text("#measuring .told"))
    click_at(page, 0.5, 0.5)
    page.until(lambda: page.text("#measuring .figure"))
    before = page.text("#measuring .figure")
    page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.look({ pose: 'orbit:5,0,1' }))")
    page.until(lambda: "+5" in page.view)
    assert page.text("#measuring .figure") == before


def test_an_unsure_point_is_refused_in_plain_words_and_the_first_one_stays(site: Site, page: Page) -> None:
    start(site, page)
    click_at(page, 0.9, 0.5)
    page.until_text("#measuring .told", say("measure.refused_first", why=say("measure.low_confidence")))
    click_at(page, 0.25, 0.5)
    page.until(lambda: "±" in page.text("#measuring .told"))
    click_at(page, 0.25, 0.1)
    page.until_text("#measuring .told", say("measure.refused_next", why=say("measure.unseen")))
    assert page.text("#measuring .figure") == ""
    click_at(page, 0.5, 0.5)
    page.until(lambda: page.text("#measuring .figure"))


def test_a_first_point_does_not_outlive_the_view_in_which_it_was_chosen(site: Site, page: Page) -> None:
    start(site, page)
    click_at(page, 0.25, 0.5)
    page.until(lambda: "±" in page.text("#measuring .told"))
    page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.look({ t: 0.5 }))")
    page.until_text("#measuring .told", say("measure.moved"))


def test_keys_alone_measure_and_escape_ends(site: Site, page: Page) -> None:
    viewed(site, page)
    stage = page.find("#stage")
    stage.send_keys("m")
    page.until_text("#measuring .told", say("measure.first"))
    stage.send_keys(Keys.ARROW_LEFT, Keys.ENTER)
    page.until(lambda: "±" in page.text("#measuring .told"))
    assert "+" not in page.view  # arrows move the cross, and do not turn the view
    stage.send_keys(Keys.ARROW_RIGHT, Keys.ENTER)
    page.until(lambda: page.text("#measuring .figure"))
    assert distance_of(page) == pytest.approx(10 * MM_A_PIXEL, abs=0.1)
    stage.send_keys(Keys.ESCAPE)
    assert not page.find("#measuring").is_displayed()
    assert page.find("#measure").get_attribute("aria-pressed") == "false"
    assert page.script("return document.querySelectorAll('.measured *').length") == 0


def test_a_click_that_measures_turns_nothing_and_a_drag_still_turns(site: Site, page: Page) -> None:
    start(site, page)
    point(page, 0.3, 0.3).click_and_hold().move_by_offset(2, 1).release().perform()
    page.until(lambda: "±" in page.text("#measuring .told"))
    assert page.script("return import(document.scripts[0].src).then(({ viewer }) => viewer.orbit.isHome)")
    point(page, 0.3, 0.3).click_and_hold().move_by_offset(60, 0).move_by_offset(40, 0).release().perform()
    is_home = "return import(document.scripts[0].src).then(({ viewer }) => viewer.orbit.isHome)"
    page.until(lambda: not page.script(is_home))


def test_a_job_that_trains_is_not_measured(site: Site, page: Page) -> None:
    job_id = site.queued_job()
    claim = site.claim()
    site.train(claim, 40, 30.0)
    page.press(job_id, "Watch")
    page.until_state("training")
    page.click("#measure")
    page.until_text("#measuring .told", say("measure.not_here"))
    assert not page.find("#scale").is_displayed()


def test_the_scale_bar_says_at_which_depth_it_holds_and_is_as_long_as_it_says(site: Site, page: Page) -> None:
    viewed(site, page)
    page.until(lambda: page.find("#scale").is_displayed())
    length = int(page.text("#scale .about").split()[0])
    assert f"{DEPTH_MM:.0f} mm" in page.text("#scale .about")
    scale = page.script(f"return (async () => {{ {PLACES} }})()")[2]
    shown = page.script("return document.querySelector('#scale .bar').getBoundingClientRect().width")
    assert shown == pytest.approx(length * scale / MM_A_PIXEL, rel=0.03)


def test_nothing_of_a_scene_that_leaves_the_screen_stays_on_it(site: Site, page: Page) -> None:
    start(site, page)
    click_at(page, 0.3, 0.4)
    page.until(lambda: "±" in page.text("#measuring .told"))
    click_at(page, 0.6, 0.4)
    page.until(lambda: page.text("#measuring .figure") and page.find("#scale").is_displayed())
    page.script("return import(document.scripts[0].src).then(({ viewer }) => viewer.open(null))")
    assert page.shade == -1
    assert not page.find("#measuring").is_displayed()
    assert not page.find("#scale").is_displayed()
    assert page.script("return document.querySelectorAll('.measured *').length") == 0


def test_depth_and_confidence_have_legends_and_colours_have_none(site: Site, page: Page) -> None:
    viewed(site, page)
    assert not page.find("#legend").is_displayed()
    Select(page.find("#layer")).select_by_value("depth")
    page.until_text("#legend", say("legend.depth"))
    assert [page.text(f"#legend {part}") for part in (".low", ".high")] == [
        say(f"legend.{end}", mm=f"{each:.0f}") for end, each in zip(("nearest", "farthest"), RANGE_MM, strict=True)
    ]
    colours = page.script("return document.querySelector('#legend .colours').style.backgroundImage")
    assert f"rgb({', '.join(map(str, COLOUR_TABLE[:3]))})" in colours
    Select(page.find("#layer")).select_by_value("confidence")
    page.until_text("#legend", say("legend.confidence"))
    Select(page.find("#layer")).select_by_value("rgb")
    page.until(lambda: not page.find("#legend").is_displayed())
