"""The picture fits into what is free of drawers, tools and controls, and all that lies over it follows."""

from __future__ import annotations

import time

import pytest

from tests.client.page import Page, Site
from tests.client.test_compare_in_browser import choose, recorded_scene
from tests.client.test_measure_in_browser import MM_A_PIXEL, PLACES, click_at, on_screen
from tests.client.test_theatre_in_browser import box_of, screen_of

LAID_OUT = [(1280, 800), (820, 1180), (390, 844), (844, 390)]
PHONE_PX = 480
"""An open drawer covers all of smaller screens."""
ENDS = """
const line = document.querySelector(".measured .line");
const { left, top } = document.querySelector("#over").getBoundingClientRect();
return [...line.points].flatMap(({ x, y }) => [left + x, top + y]);
"""
MESSAGE_LEFT = """
const message = document.querySelector("#stage-message");
Object.assign(message, { hidden: false, textContent: "Why." });
return message.getBoundingClientRect().left;
"""
CLOSE_PX = 2.5
SETTLED_S = 0.5


def picture_box(page: Page) -> tuple[float, float, float, float]:
    """Left, top, right, bottom of the picture itself on the screen, in pixels."""
    u, v, scale, width, height = page.script(f"return (async () => {{ {PLACES} }})()")
    return -scale * u, -scale * v, scale * (width - u), scale * (height - v)


def is_free_of(page: Page, css: str) -> bool:
    """Whether the picture lies beside an element."""
    left, top, right, bottom = picture_box(page)
    other = box_of(page, css)
    over = min(right, other[2]) - max(left, other[0]), min(bottom, other[3]) - max(top, other[1])
    return min(over) < CLOSE_PX


def until_still(page: Page) -> None:
    """Wait until the picture stays where it is, longer than a press puts off its next place."""

    def is_still() -> bool:
        before = picture_box(page)
        time.sleep(SETTLED_S)
        return picture_box(page) == before

    page.until(is_still)


@pytest.mark.parametrize(("width", "height"), LAID_OUT)
def test_the_picture_is_free_of_controls_and_all_over_it_follows(
    site: Site, page: Page, width: int, height: int
) -> None:
    with screen_of(page, width, height):
        page.press(recorded_scene(site), "View")
        page.until_state("live")
        page.until_text("#time-value", "40")
        for css in ("#tools", "#controls"):
            page.find(css)
            page.until(lambda css=css: is_free_of(page, css))  # type: ignore[misc]
        site.announce()
        page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.timeline.goTo(0))")
        page.until(lambda: page.find("#scale .bar").is_displayed())
        length_mm, *_ = page.text("#scale .about").split()
        shown_px = box_of(page, "#scale .bar")[2] - box_of(page, "#scale .bar")[0]
        left, _, right, _ = picture_box(page)
        assert shown_px == pytest.approx(float(length_mm) * (right - left) / 60 / MM_A_PIXEL, rel=0.05)

        page.click("#measure")
        for x in (0.25, 0.5):
            site.announce()
            until_still(page)
            click_at(page, x, 0.5)
            page.until(lambda: page.script("return document.querySelectorAll('.measured path').length") >= 2)
        page.until(lambda: page.text("#measuring .figure"))
        if min(width, height) > PHONE_PX:
            page.click("#tools [data-drawer=library]")
            page.until(lambda: is_free_of(page, "#library"))
            assert page.script(MESSAGE_LEFT) > box_of(page, "#library")[2]
        page.until(lambda: is_free_of(page, "#measuring"))
        chosen = lambda: [*on_screen(page, 0.25, 0.5), *on_screen(page, 0.5, 0.5)]  # noqa: E731
        page.until(lambda: page.script(ENDS) == pytest.approx(chosen(), abs=CLOSE_PX))
        assert is_free_of(page, "#measuring")
        assert "±" in page.script("return document.querySelector('.measured text').textContent")
        left, _, right, _ = picture_box(page)
        assert right - left > 0.3 * min(width, height)
        page.click("#measuring .end")
        if min(width, height) > PHONE_PX:
            page.click("#library [data-close]")

        choose(page, "wipe")
        page.script("document.querySelector('#seam').dispatchEvent(new KeyboardEvent('keydown', { key: 'Home' }))")
        left, _, right, _ = box_of(page, "#picture")
        seam = box_of(page, "#seam")
        assert (seam[0] + seam[2]) / 2 == pytest.approx(left, abs=CLOSE_PX)
        choose(page, "off")

        page.script("document.querySelector('#stage').focus()")  # what has the focus of a keyboard does not step back
        page.script("document.querySelector('#theatre').toggleAttribute('data-idle', true)")
        left, top, right, bottom = box_of(page, "#stage")
        fills = lambda box: box[2] - box[0] > right - left - 8 or box[3] - box[1] > bottom - top - 8  # noqa: E731
        page.until(lambda: fills(picture_box(page)))
        page.find("#stage")  # a hand: they return at once
        page.until(lambda: is_free_of(page, "#controls"))
