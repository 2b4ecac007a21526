"""A page whose browser draws scenes by itself, on the processor."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray
from selenium import webdriver

from tests.client.page import Page, Site
from tests.client.player import TIE_LEVELS
from tests.client.test_player import LEAST_DB, scattered

PIXELS = """
const { width, height } = document.querySelector("#picture");
const pixels = document.querySelector("#picture").getContext("2d").getImageData(0, 0, width, height).data;
let text = "";
for (let i = 0; i < pixels.length; i += 8192) text += String.fromCharCode(...pixels.subarray(i, i + 8192));
return [width, height, btoa(text)];
"""
VIEWER = "const done = arguments[arguments.length - 1]; import(document.scripts[0].src).then(({ viewer }) => { %s })"
LOOK = VIEWER % "viewer.look(arguments[0]); done()"
SHOWN = VIEWER % "done(viewer.shown)"


class Drawn(Page):
    """A page whose browser draws on the processor."""

    @property
    def way(self) -> tuple[str, str]:
        """Who draws, and why it is the service."""
        found = self.script("const { way, why } = document.querySelector('#way').dataset; return [way, why]")
        return found[0], found[1]

    @property
    def decided_ms(self) -> float:
        """How soon after the scene was chosen it was settled who draws."""
        return float(self.script("return document.querySelector('#way').dataset.decidedMs"))

    def until_way(self, *way: str) -> None:
        self.until(lambda: self.way == way)

    def choose_way(self, choice: str) -> None:
        self.script("for (const each of ['more', 'way']) document.getElementById(each).open = true")
        self.script(
            "const choice = document.querySelector('#way select'); choice.value = arguments[0];"
            "choice.dispatchEvent(new Event('change', { bubbles: true }))",
            choice,
        )

    def look(self, **wish: object) -> None:
        self.driver.execute_async_script(LOOK, wish)

    @property
    def shown(self) -> dict[str, Any]:
        """What the viewer tells of the picture; empty: there is none."""
        found: dict[str, Any] | None = self.driver.execute_async_script(SHOWN)
        return found or {}


@contextmanager
def opened(url: str, driver: webdriver.Chrome) -> Iterator[Drawn]:
    """The page, in a browser that remembers nothing."""
    page = Drawn(driver, url)
    page.open()
    page.script("localStorage.clear()")
    page.open()
    yield page
    assert page.faults() == []
    driver.get("about:blank")  # or its connections keep the service from ending


def view_here(site: Site, page: Drawn) -> str:
    """A scene that the page draws by itself."""
    scene = site.scene(model=scattered(14, moves=True))
    page.press(scene, "View")
    page.choose_way("always")
    page.until_way("memory", "")
    page.until(lambda: page.shown.get("way") == "memory")
    page.until_state("live")
    return scene


def picture_of(page: Page) -> NDArray[np.uint8]:
    """[H, W, 3] of what the page shows."""
    width, height, text = page.script(PIXELS)
    pixels = np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)
    return np.asarray(pixels[..., :3])


def render_of(url: str, shown: dict[str, Any]) -> NDArray[np.uint8]:
    """[H, W, 3] of what the service draws of the same view, without the loss of JPEG."""
    size = {name: shown["camera"][name] for name in ("width", "height")}
    names = ("scene", "t", "pose", "layer", "unseen", "highlights", "light")
    asked = {name: shown[name] for name in names if shown[name]}
    answer = httpx.get(f"{url}/render", params={**asked, **size, "format": "npy"}, timeout=60)
    found: NDArray[np.uint8] = np.load(io.BytesIO(answer.raise_for_status().content))
    return found


def beside_the_service(site: Site, page: Drawn) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """What the page has drawn by itself, and by how many levels it differs from what the service draws of that view."""
    site.announce()  # else the worker counts as gone after a while
    page.until(lambda: page.shown.get("isMoving") is False)  # else sorted for the view before
    drawn, rendered = picture_of(page), render_of(site.url, page.shown)
    assert page.shown.get("way") == "memory"
    assert drawn.shape == rendered.shape
    levels = np.abs(drawn.astype(np.int64) - rendered)
    assert 10 * np.log10(255**2 / max((levels**2).mean(), 1e-9)) >= LEAST_DB, page.shown
    return drawn, levels


def same_as_the_service(site: Site, page: Drawn) -> NDArray[np.uint8]:
    """What the page has drawn by itself, which is what the service draws of that view."""
    drawn, levels = beside_the_service(site, page)
    assert levels.max() <= TIE_LEVELS, page.shown
    return drawn
