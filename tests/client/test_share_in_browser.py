"""What is handed on of a scene: a link that opens at once, playing and rocking, and one file; in a real browser."""

from __future__ import annotations

from tests.client.page import Page, Site, grey_of
from tests.client.words import say

FIRST = """
const canvas = document.querySelector("#first");
if (!canvas || canvas.hidden || canvas.width === 0) return -1;
return canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data[0];
"""
HOLD_MODULES = "*/main.js"
STAY = "const later = setTimeout; window.setTimeout = (work, ms) => later(work, ms === 5000 ? 600000 : ms);"
"""What first.js removes after 5 s stays, on a slow machine too."""


def test_a_shared_link_shows_its_picture_before_the_modules_and_plays_and_rocks(site: Site, page: Page) -> None:
    scene = site.scene("a0")
    page.press(scene, "View")
    page.until_state("live")
    page.find("#share").click()
    link = page.find("#sharing .link").get_attribute("value") or ""
    assert link.endswith(f"#/scene/{scene}?play=1&rock=1")
    page.find("#sharing .moves").click()
    assert (page.find("#sharing .link").get_attribute("value") or "").endswith(f"#/scene/{scene}")
    assert page.find("#sharing .file").text == say("share.file")
    asked = "return performance.getEntriesByType('resource').map(({ name }) => name).join().match(/export.*/)?.[0]"
    assert page.find("#sharing .frames").is_selected()
    page.find("#sharing .frames").click()
    page.find("#sharing .file").click()
    page.until(lambda: (page.script(asked) or "").startswith("export?format=html&recorded=off"))
    page.find("#sharing .copy").click()
    page.until(lambda: page.text("#sharing .message") in (say("share.copied"), say("share.by_hand")))

    page.driver.get("about:blank")
    page.driver.execute_cdp_cmd("Network.enable", {})
    page.driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": [HOLD_MODULES]})
    stay = page.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": STAY})
    page.driver.get(link)
    page.until(lambda: abs(page.script(FIRST) - grey_of(scene)) <= 2)
    assert page.shade == -1
    page.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", stay)

    page.driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": []})
    page.driver.get("about:blank")
    page.driver.get(link)
    page.until(lambda: page.shade == grey_of(scene))
    page.until(lambda: page.script("return document.querySelector('#first') === null"))
    pressed = "return ['play', 'rock'].every((id) => document.getElementById(id).ariaPressed === 'true')"
    page.until(lambda: page.script(pressed))
    page.find("#rock").click()  # it goes back to where it began, and plays on
    page.until(lambda: say("view.endoscope") in page.view)
    page.find("#play").click()
    page.until(lambda: "play=1" not in page.driver.current_url and "rock=1" not in page.driver.current_url)


def test_the_early_picture_goes_as_soon_as_another_scene_is_opened(site: Site, page: Page) -> None:
    scene, other = site.scene("a0"), site.scene("40")
    page.driver.get("about:blank")
    page.driver.execute_cdp_cmd("Network.enable", {})
    page.driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": [HOLD_MODULES]})
    page.driver.get(f"{site.url}/#/scene/{scene}")
    page.until(lambda: abs(page.script(FIRST) - grey_of(scene)) <= 2)
    site.painter.pause_s = 0.8
    load = """
        history.replaceState(null, "", arguments[0]);
        const [main] = [...document.scripts].filter(({ src }) => src.endsWith("/main.js"));
        const again = Object.assign(document.createElement("script"), { type: "module", src: `${main.src}?again` });
        document.head.append(again);
    """
    page.driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": []})
    page.script(load, f"#/scene/{other}")
    page.until(lambda: page.script("return document.querySelector('#scene-id').dataset.scene") == other)
    assert page.script("return document.querySelector('#first') === null")
    assert page.shade == -1
    site.painter.pause_s = 0
    page.until(lambda: page.shade == grey_of(other))


def test_a_link_that_rocks_does_not_end_the_rocking_that_was_begun_by_hand(site: Site, page: Page) -> None:
    scene = site.scene("a0")
    hold = """
        const ask = window.fetch;
        window.fetch = async (path, how) => {
          if (String(path).endsWith("/cameras")) await new Promise((go) => (window.letGo = go));
          return ask(path, how);
        };
    """
    held = page.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": hold})
    page.driver.get("about:blank")
    page.driver.get(f"{site.url}/#/scene/{scene}?rock=1")
    page.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", held)
    page.until(lambda: page.shade == grey_of(scene))
    page.find("#rock").click()
    page.until(lambda: page.script("return window.letGo !== undefined"))
    page.script("letGo()")
    page.until_text("#time-value", "of 40")  # its cameras are known
    assert page.find("#rock").get_attribute("aria-pressed") == "true"
