"""The theatre view in a real browser: the picture fills the screen, and all else steps back from it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from selenium.webdriver.common.keys import Keys

from contract.wire.job import JobError
from intrasplat.errors import ErrorCode
from intrasplat.notices import NoticeCode
from tests.client.page import CALIBRATION, Page, Site
from tests.client.words import LANGUAGES, say
from tests.reports import a_warning

SIZES = [(1280, 800), (1920, 1080), (820, 1180), (390, 844)]
"""A laptop, the screen of an operating room, a tablet held upright, a phone."""


@contextmanager
def screen_of(page: Page, width: int, height: int) -> Iterator[None]:
    page.driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
    )
    try:
        yield
    finally:
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def box_of(page: Page, css: str) -> tuple[float, float, float, float]:
    """Left, top, right, bottom on the screen, in pixels."""
    left, top, right, bottom = page.script(
        "const box = document.querySelector(arguments[0]).getBoundingClientRect();"
        "return [box.left, box.top, box.right, box.bottom]",
        css,
    )
    return left, top, right, bottom


def is_on_screen(page: Page, css: str) -> bool:
    """Whether all of an element is on the screen, and nothing lies over its middle."""
    return bool(
        page.script(
            """
            const found = document.querySelector(arguments[0]);
            const { left, top, right, bottom, width, height } = found.getBoundingClientRect();
            if (width * height === 0 || left < 0 || top < 0 || right > innerWidth + 1 || bottom > innerHeight + 1)
              return false;
            const over = document.elementFromPoint(left + width / 2, top + height / 2);
            return found.contains(over);
            """,
            css,
        )
    )


def test_a_drawer_opens_beside_the_picture_and_gives_the_focus_back(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")
    assert not page.find("#library").is_displayed()  # it was open at first, to choose a scene
    button = page.find("#tools [data-drawer=drawer]")
    button.click()
    assert page.find("#drawer").is_displayed()
    assert button.get_attribute("aria-expanded") == "true"
    page.find("#tools [data-drawer=library]").click()
    assert not page.find("#drawer").is_displayed()
    page.find("#library [data-close]").send_keys(Keys.ENTER)
    assert not page.find("#library").is_displayed()
    assert page.script("return document.activeElement.dataset.drawer") == "library"


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_picture_fills_the_screen_and_a_refusal_is_seen_whatever_is_open(
    site: Site, page: Page, tmp_path: Path, width: int, height: int
) -> None:
    broken = tmp_path / "cut short.mp4"
    broken.write_bytes(b"\0\0\0\x18ftypisom" + bytes(64))
    with screen_of(page, width, height):
        page.press(site.scene(), "View")
        page.until_state("live")
        left, top, right, bottom = box_of(page, "#stage")
        assert (right - left) * (bottom - top) > 0.85 * width * height
        page.choose("clip", broken)
        page.script("document.querySelector('#upload details').open = true")
        page.choose("calibration", CALIBRATION)
        page.click("#upload [type=submit]")
        page.until_text("#upload-message", say("problem.input:clip"))
        assert is_on_screen(page, "#upload-message")
        page.click("#drawer [data-close]")
        assert is_on_screen(page, "#upload-message")
        assert is_on_screen(page, ".notice")
        assert page.script("return document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize(("width", "height"), [size for size in SIZES if size[0] < size[1]])
def test_held_upright_the_picture_keeps_its_share_and_the_status_its_words(
    site: Site, page: Page, width: int, height: int, language: str
) -> None:
    page.script("localStorage.setItem('intrasplat-language', arguments[0])", language)
    page.driver.refresh()
    with screen_of(page, width, height):
        page.press(site.scene(), say("job.view", language))
        page.until_state("live")
        page.until_text("#time-value", "40")
        page.find("#controls")
        assert box_of(page, ".scales")[1] - box_of(page, "#tools")[3] > 0.4 * height
        cut = "const line = document.querySelector('.status-line'); return line.scrollWidth > line.clientWidth"
        assert not page.script(cut)
        assert not page.find("#layer").is_displayed()
        page.find("#more summary").click()
        assert page.find("#layer").is_displayed()
        assert is_on_screen(page, "#layer")
    page.script("localStorage.clear()")


@pytest.mark.parametrize(("width", "height"), [(390, 844), (360, 640), (844, 390)])
def test_on_a_phone_the_picture_keeps_its_share_while_more_is_open_and_the_rest_is_scrolled_to(
    site: Site, page: Page, width: int, height: int
) -> None:
    with screen_of(page, width, height):
        page.press(site.scene(), "View")
        page.until_state("live")
        page.until_text("#time-value", "40")
        page.find("#more summary").click()
        assert box_of(page, "#controls")[1] - box_of(page, "#theatre")[1] > 0.4 * height
        for css in ("#speed", "#way summary"):
            page.script("document.querySelector(arguments[0]).scrollIntoView()", css)
            assert is_on_screen(page, css)


def test_on_a_phone_an_open_drawer_has_the_screen_also_below_a_message(site: Site, page: Page, tmp_path: Path) -> None:
    broken = tmp_path / "cut short.mp4"
    broken.write_bytes(b"\0\0\0\x18ftypisom" + bytes(64))
    width, height = SIZES[-1]
    with screen_of(page, width, height):
        page.press(site.scene(), "View")
        page.until_state("live")
        page.send(broken)
        page.until_text("#upload-message", say("problem.input:clip"))
        _, top, _, bottom = box_of(page, "#drawer")
        assert bottom - top >= 0.6 * height
        assert not page.find("#controls").is_displayed()
        page.find("#drawer [data-close]").send_keys(Keys.ENTER)
        assert page.script("return document.activeElement.dataset.drawer") == "drawer"
        assert page.find("#controls").is_displayed()


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_message_moves_no_button(site: Site, page: Page, width: int, height: int) -> None:
    with screen_of(page, width, height):
        page.press(site.scene(), "View")
        page.until_state("live")
        page.find("#tools")
        pressed = ("#tools [data-drawer=library]", "#show-help", "#play", "#time", "#stage")
        if width == SIZES[-1][0]:
            pressed = tuple(css for css in pressed if css != "#show-help")  # below "More"
        before = [box_of(page, css) for css in pressed]
        page.script("document.querySelector('#jobs-message').textContent = 'A message that stays.'")
        assert page.find("#jobs-message").is_displayed()
        assert [box_of(page, css) for css in pressed] == before


def test_controls_step_back_while_idle_and_return(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")
    idle = "return document.querySelector('#theatre').hasAttribute('data-idle')"
    page.until(lambda: page.script(idle))
    page.until(lambda: page.script("return getComputedStyle(document.querySelector('#tools')).opacity") == "0")
    assert box_of(page, ".scales")[3] == box_of(page, "#theatre")[3]  # not where the controls were
    assert is_on_screen(page, "#badge")
    for sign in ("pointermove", "pointerdown", "keydown"):
        page.script("document.querySelector('#theatre').toggleAttribute('data-idle', true)")
        page.script("document.body.dispatchEvent(new Event(arguments[0], { bubbles: true }))", sign)
        assert not page.script(idle), sign


@pytest.mark.parametrize("close", ["#jobs-message + [data-close]", '[data-job] button[aria-label^="View"]'])
def test_the_news_of_a_deletion_leaves_by_its_button_and_with_the_next_scene(
    site: Site, page: Page, close: str
) -> None:
    site.scene()
    gone = site.scene()
    assert not page.find("#jobs-message + [data-close]").is_displayed()
    page.press(gone, "Delete")
    page.until(lambda: page.find("#confirm").is_displayed())
    page.click("#confirm [value=yes]")
    page.until_text("#jobs-message", "are deleted for good")
    assert page.find("#jobs-message + [data-close]").is_displayed()
    page.click(close)
    page.until(lambda: page.text("#jobs-message") == "")
    assert not page.find("#jobs-message + [data-close]").is_displayed()


def test_the_warning_of_this_view_is_read_before_those_of_its_scene_and_all_are_behind_it(
    site: Site, page: Page
) -> None:
    of_scene = [NoticeCode.POSES_UNSURE, NoticeCode.MASKS_UNSURE, NoticeCode.POSE_JITTER]
    site.painter.warnings = [a_warning("Of the scene.", code) for code in of_scene]
    with screen_of(page, 1280, 800):
        page.press(site.scene(), "View")
        page.until_text("#picture-warning", say("notice.poses_unsure"))
        page.driver.execute_async_script(
            "const [pose, done] = arguments; "
            "import(document.scripts[0].src).then(({ viewer }) => done(viewer.look({ pose })))",
            "orbit:30,0,1",
        )
        page.until_text("#picture-warning", say("notice.pose_far"))
        whole = " ".join(say(f"notice.{code}") for code in (NoticeCode.POSE_FAR, *of_scene, NoticeCode.UNCLASSIFIED))
        assert page.script("return document.querySelector('#picture-warning').textContent") == whole
        assert page.find("#picture-warning").get_attribute("title") == whole
        hidden = "const { scrollHeight, clientHeight } = document.querySelector('#picture-warning'); "
        hidden += "return scrollHeight - clientHeight"
        assert page.script(hidden) > 0
        page.click(".picture-warning summary")
        assert page.script(hidden) == 0
        assert is_on_screen(page, "#picture-warning")


def test_the_stage_says_why_nothing_comes_of_a_job_that_failed(site: Site, page: Page) -> None:
    site.queued_job()
    claim = site.claim()
    site.train(claim, 10, 21.0)
    page.press(claim.job_id, "Watch")
    page.until_state("training")
    diverged = JobError(code=ErrorCode.TRAINING_DIVERGED, problem="It diverged.", remedy="Send another clip.")
    assert site.queue.fail(claim, diverged)
    page.until_text("#stage-message", say("problem.training_diverged"))


def test_the_status_of_recorded_frames_says_once_what_they_are(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")
    page.script(
        "const layer = document.querySelector('#layer'); layer.value = 'recorded';"
        "layer.dispatchEvent(new Event('change'))"
    )
    page.until_text("#badge", say("screen.recorded"))
    page.until(lambda: page.text("#status-text") == "0.00 s")


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_button_that_sends_is_in_view_however_long_the_form_is(page: Page, width: int, height: int) -> None:
    with screen_of(page, width, height):
        page.show("drawer")
        page.script("document.querySelector('#upload details').open = true")
        assert is_on_screen(page, "#upload [type=submit]")


@pytest.mark.parametrize(("width", "height"), [(820, 1180), (390, 844), (844, 390)])
def test_on_small_screens_the_slider_is_wide_and_every_tool_is_seen(
    site: Site, page: Page, width: int, height: int
) -> None:
    with screen_of(page, width, height):
        page.press(site.scene(), "View")
        page.until_state("live")
        left, _, right, _ = box_of(page, "#time")
        assert right - left > 0.3 * width
        for css in ("[data-drawer=library]", "[data-drawer=drawer]", "[data-drawer=report-drawer]", "#measure"):
            assert is_on_screen(page, f"#tools {css}"), css
