"""The page judged by axe-core in every state and size, and its layout: nothing overlaps, all can be touched.

npm installs axe-core, which is no part of the package; without npm these tests are skipped.
"""

from __future__ import annotations

import shutil
import subprocess
from typing import Any

import pytest

from tests.client.page import Page, Site
from tests.client.test_compare_in_browser import choose, recorded_scene
from tests.client.test_theatre_in_browser import SIZES, screen_of
from tests.client.words import LANGUAGES, say

AXE = "axe-core@4.14.1"
INSTALL_S = 300.0
RUN = """
const [source, done] = arguments;
if (!window.axe) (0, eval)(source);
const told = ({ id, nodes }) => [id, ...nodes.map(({ html }) => html.slice(0, 120))];
axe.run(document, { resultTypes: ["violations"] })
  .then(({ violations }) => done(violations.map(told)), (error) => done([String(error)]));
"""
MIN_TOUCH_PX = 44
MIN_LETTER_PX = 12
MIN_BORDER = 3.0


@pytest.fixture(scope="module")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Its source."""
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed; it installs axe-core")
    folder = tmp_path_factory.mktemp("axe")
    command = ["npm", "install", "--no-audit", "--no-fund", "--prefer-offline", "--ignore-scripts", AXE]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=INSTALL_S, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip(f"npm has not answered within {INSTALL_S:g} s")
    if done.returncode != 0:
        pytest.skip(f"npm cannot install {AXE}: {done.stderr[-200:]}")
    return (folder / "node_modules" / "axe-core" / "axe.js").read_text(encoding="utf-8")


def violations(page: Page, axe: str) -> list[Any]:
    page.script("document.dispatchEvent(new PointerEvent('pointermove'))")  # nothing has stepped back
    page.until(lambda: page.script("return document.getAnimations().length") == 0)
    found: list[Any] = page.driver.execute_async_script(RUN, axe)  # type: ignore[no-untyped-call]
    return found


def test_axe_tells_of_a_button_without_a_name(site: Site, page: Page, axe: str) -> None:
    page.driver.execute_cdp_cmd("Page.setBypassCSP", {"enabled": True})
    page.driver.refresh()
    page.script("document.querySelector('#show-help').textContent = ''")
    page.until(lambda: [rule for rule, *_ in violations(page, axe)] == ["button-name"])


@pytest.mark.parametrize(("width", "height", "language"), [(*size, LANGUAGES[n % 2]) for n, size in enumerate(SIZES)])
def test_axe_finds_nothing_in_any_state_of_the_page(
    site: Site, page: Page, axe: str, width: int, height: int, language: str
) -> None:
    page.driver.execute_cdp_cmd("Page.setBypassCSP", {"enabled": True})
    page.script("localStorage.setItem('intrasplat-language', arguments[0])", language)
    page.driver.refresh()
    found = {}
    with screen_of(page, width, height):
        page.until_text("#connection", say("page.ready", language))
        found["empty"] = violations(page, axe)
        scene = recorded_scene(site)
        page.until(lambda: page.script("return document.querySelectorAll('#jobs .done').length") == 1)
        found["library"] = violations(page, axe)
        page.press(scene, say("job.view", language))
        page.until_state("live")
        page.until_text("#time-value", "40")
        page.script("document.querySelector('#loop-start').click()")
        found["scene"] = violations(page, axe)
        page.until_text("#report", "dB")
        page.script("for (const id of ['more', 'way']) document.getElementById(id).open = true")
        page.until(lambda: page.text("#way .panel"))
        found["way"] = violations(page, axe)
        page.script("for (const id of ['more', 'way']) document.getElementById(id).open = false")
        for mode in ("wipe", "side", "off"):
            choose(page, mode)
            found[mode] = violations(page, axe)
        for drawer in ("drawer", "report-drawer"):
            page.show(drawer)
            page.until(lambda drawer=drawer: page.find(f"#{drawer}").is_displayed())  # type: ignore[misc]
            found[drawer] = violations(page, axe)
        page.click(f'#report button[aria-label="{say("brush.title", language)}"]')
        page.until(lambda: page.script("return document.querySelector('.brush')?.dataset.shown") == "0")
        found["brush"] = violations(page, axe)
        assert page.script(LAYOUT_OF_BRUSH, MIN_TOUCH_PX) == {"off": [], "small": [], "isLarge": True}
        page.click(".brush header button")
        page.click("#report-drawer [data-close]")
        page.click("#show-help")
        page.until(lambda: page.find("#help").is_displayed())
        found["help"] = violations(page, axe)
        page.click("#help [data-close]")
        page.click("#measure")
        page.until(lambda: page.find("#measuring").is_displayed())
        found["measuring"] = violations(page, axe)
        page.click("#measuring .end")
        page.press(scene, say("job.save", language))
        page.until(lambda: page.find("#download .kinds button").is_displayed())
        found["download"] = violations(page, axe)
        page.click("#download header button")
        page.press(scene, say("job.delete", language))
        page.until(lambda: page.find("#confirm").is_displayed())
        found["question"] = violations(page, axe)
    page.script("localStorage.clear()")
    assert {state: each for state, each in found.items() if each} == {}


LAYOUT_OF_BRUSH = """
const used = [...document.querySelectorAll(".brush button, .brush input")];
const box = (each) => each.getBoundingClientRect();
const isOff = ({ left, right, bottom }) => left < 0 || right > innerWidth + 1 || bottom > innerHeight + 1;
const named = (some, is) => some.filter((each) => is(box(each))).map((each) => each.ariaLabel);
return {
  off: named(used.filter((each) => !each.closest(".strip")), isOff), // the strip scrolls
  small: named(used, ({ width, height }) => Math.min(width, height) < arguments[0]),
  isLarge: box(document.querySelector(".brush .paper")).height > 0.4 * innerHeight,
};
"""
LAYOUT = """
const all = "button, select, input, summary, #time-value, #readout, #badge, .notice, #connection";
const seen = { opacityProperty: true, visibilityProperty: true };
const isShown = (each) => each.checkVisibility(seen) && !each.closest("dialog");
const shown = [...document.querySelectorAll(all)].filter(isShown);
const target = (each) => (each.type === "checkbox" ? each.closest("label") : each);
const clip = (each, { left, top, right, bottom }) => {
  const panel = each.closest(".moving")?.getBoundingClientRect(); // on a phone it scrolls
  if (!panel) return { left, top, right, bottom };
  return { left, top: Math.max(top, panel.top), right, bottom: Math.min(bottom, panel.bottom) };
};
const full = (each) => target(each).getBoundingClientRect();
const box = (each) => clip(each, full(each));
const name = (each) => each.id || each.textContent.trim() || each.name;
const common = (from, to, a, b) => Math.min(a[to], b[to]) - Math.max(a[from], b[from]);
const over = [];
for (const [i, first] of shown.entries()) for (const second of shown.slice(i + 1)) {
  const [a, b] = [box(first), box(second)];
  const isOver = common("left", "right", a, b) > 1 && common("top", "bottom", a, b) > 1;
  if (isOver && !first.contains(second)) over.push([name(first), name(second)]);
}
const isOff = ({ left, right, bottom }) => left < 0 || right > innerWidth + 1 || bottom > innerHeight + 1;
const isSmall = ({ width, height }) => Math.min(width, height) < arguments[0];
const isFaint = (each) => parseFloat(getComputedStyle(each).fontSize) < arguments[1];
const used = shown.filter((each) => each.matches("button, select, input, summary"));
const named = (some, is) => some.filter(is).map(name);
return {
  over,
  off: named(shown, (each) => isOff(box(each))),
  small: named(used, (each) => isSmall(full(each))),
  faint: named(shown, isFaint),
};
"""


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_nothing_overlaps_or_lies_off_the_screen_and_all_can_be_touched(
    site: Site, page: Page, width: int, height: int, language: str
) -> None:
    page.script("localStorage.setItem('intrasplat-language', arguments[0])", language)
    page.driver.refresh()
    with screen_of(page, width, height):
        page.press(recorded_scene(site), say("job.view", language))
        page.until_state("live")
        page.until_text("#time-value", "40")
        page.until_text("#report", "dB")
        choose(page, "wipe")
        page.script("for (const id of ['step-on', 'step-on', 'loop-start']) document.getElementById(id).click()")
        page.find("#stage")
        page.until(lambda: page.find("#loop-all").is_displayed())
        for is_open in (True, False):  # wide screens show all in either case
            page.script("document.querySelector('#more').open = arguments[0]", is_open)
            assert page.script(LAYOUT, MIN_TOUCH_PX, MIN_LETTER_PX) == {"over": [], "off": [], "small": [], "faint": []}
        letters = float(page.script("return parseFloat(getComputedStyle(document.querySelector('#badge')).fontSize)"))
        assert letters >= (48 if height == 1080 else 20)
    page.script("localStorage.clear()")


BORDERS = """
const channels = (text) => text.match(/[\\d.]+/g).map(Number);
const linear = (each) => (each <= 0.04045 ? each / 12.92 : ((each + 0.055) / 1.055) ** 2.4);
const light = (text) => {
  const [r, g, b] = channels(text).map((each) => linear(each / 255));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const ground = (each) => {
  for (let at = each.parentElement; at; at = at.parentElement) {
    const colour = getComputedStyle(at).backgroundColor;
    if (channels(colour)[3] !== 0) return colour;
  }
  return "rgb(0 0 0)";
};
const low = [];
for (const each of document.querySelectorAll("button, select, input:not([type=range], [type=checkbox])")) {
  const { borderTopColor, borderTopWidth } = getComputedStyle(each);
  if (!each.checkVisibility() || parseFloat(borderTopWidth) === 0) continue;
  const [a, b] = [light(borderTopColor), light(ground(each))].sort((x, y) => y - x);
  const ratio = (a + 0.05) / (b + 0.05);
  if (ratio < arguments[0]) low.push([each.id || each.name || each.textContent, ratio]);
}
return low;
"""


def test_borders_of_what_is_used_stand_out(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")
    for drawer in ("library", "drawer", "report-drawer"):
        page.show(drawer)
        assert page.script(BORDERS, MIN_BORDER) == [], drawer
