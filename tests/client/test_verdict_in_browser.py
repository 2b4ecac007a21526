"""How far to trust a scene, beside the word that says what its picture is."""

from __future__ import annotations

import pytest

from intrasplat.notices import NoticeCode
from tests.client.page import FAR_DEG, REPORT_OF_THE_PAGE, Page, Site
from tests.client.test_theatre_in_browser import SIZES, is_on_screen, screen_of
from tests.client.words import LANGUAGES, say
from tests.reports import a_warning

GREEN = "rgb(79, 179, 165)"
COLOUR = "return getComputedStyle(document.querySelector(arguments[0])).color"
HEIGHT_PX = "return parseFloat(getComputedStyle(document.querySelector(arguments[0])).fontSize)"


def scene_with(site: Site, *codes: NoticeCode) -> str:
    site.queued_job()
    report = REPORT_OF_THE_PAGE.model_copy(update={"warnings": tuple(a_warning("Beware.", code) for code in codes)})
    return site.finish(site.claim(), report=report)


def look(page: Page, pose: str) -> None:
    page.driver.execute_async_script(
        "const [pose, done] = arguments; "
        "import(document.scripts[0].src).then(({ viewer }) => done(viewer.look({ pose })))",
        pose,
    )


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_verdict_of_a_doubtful_scene_stands_beside_the_status_and_opens_the_report(
    site: Site, page: Page, width: int, height: int, language: str
) -> None:
    page.script("localStorage.setItem('intrasplat-language', arguments[0])", language)
    page.driver.refresh()
    with screen_of(page, width, height):
        page.press(scene_with(site, NoticeCode.TIME_TOO_SHORT), say("job.view", language))
        page.until_state("live")
        page.until_text("#verdict", say("light.care", language))
        assert page.text("#badge") == say("screen.current", language)
        assert GREEN not in (page.script(COLOUR, "#badge"), page.script(COLOUR, "#verdict .light"))
        assert page.script(HEIGHT_PX, "#verdict") == page.script(HEIGHT_PX, "#badge")
        assert is_on_screen(page, "#verdict")
        page.until_text("#picture-warning", say("notice.time_too_short", language))
        page.find("#verdict").click()
        assert page.find("#report-drawer").is_displayed()
    page.script("localStorage.clear()")


def test_a_scene_without_doubt_is_called_good_but_not_beside_a_view_that_is_a_guess(site: Site, page: Page) -> None:
    page.press(scene_with(site), "View")
    page.until_text("#verdict", say("light.good"))
    assert page.script(COLOUR, "#verdict .light") == GREEN
    look(page, f"orbit:{FAR_DEG + 5},0,1")
    page.until_state("extrapolated")
    assert not page.find("#verdict").is_displayed()


def test_a_little_that_was_never_seen_is_named_and_filling_it_is_a_guess(site: Site, page: Page) -> None:
    site.painter.unseen_share = 0.04
    page.press(scene_with(site), "View")
    page.until_text("#picture-warning", say("notice.unseen"))
    assert page.state == "live"
    page.click("#guess")
    page.until_state("extrapolated")
    page.until_text("#picture-warning", say("picture.guessed"))


def test_a_converted_calibration_asks_for_care(site: Site, page: Page) -> None:
    page.press(scene_with(site, NoticeCode.CALIBRATION_SCALED), "View")
    page.until_text("#verdict", say("light.care"))


def test_another_scene_does_not_inherit_the_verdict(site: Site, page: Page) -> None:
    page.press(scene_with(site, NoticeCode.EYES_DISAGREE), "View")
    page.until_text("#verdict", say("light.bad"))
    site.queued_job()
    claim = site.claim()
    site.train(claim, 10, 21.0)
    page.press(claim.job_id, "Watch")
    page.until_state("training")
    assert page.text("#verdict") == page.text("#picture-warning") == ""
