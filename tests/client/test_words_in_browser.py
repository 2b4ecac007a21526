"""What the page says to people in a real browser: plain words in their language; codes and the API's words below."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from contract.wire.job import JobError
from intrasplat.errors import ErrorCode
from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import Report
from tests.client.page import REPORT_OF_THE_PAGE, Page, Site
from tests.client.test_messages import API_WORDS
from tests.client.words import say

API_TEXT = "Send `Authorization: Bearer KEY` to GET /jobs/4d24a1b2c3d4, see layer=confidence."


@pytest.fixture
def german(page: Page) -> Iterator[Page]:
    """The page in a browser whose user reads German."""
    agent = page.script("return navigator.userAgent")
    page.driver.execute_cdp_cmd("Emulation.setUserAgentOverride", {"userAgent": agent, "acceptLanguage": "de-CH,en"})
    page.open()
    yield page
    page.driver.execute_cdp_cmd("Emulation.setUserAgentOverride", {"userAgent": agent, "acceptLanguage": "en-US"})


def first_layer(page: Page) -> str:
    """What is read without opening any details."""
    text: str = page.script("return document.body.innerText")
    return text


def report_with(*warnings: Notice) -> Report:
    return REPORT_OF_THE_PAGE.model_copy(update={"warnings": warnings})


def test_row_6_no_word_of_the_api_reaches_the_first_layer(site: Site, page: Page) -> None:
    failed = site.queued_job()
    site.queue.fail(site.claim(), JobError(code=ErrorCode.INPUT, problem=API_TEXT, field="calibration"))
    scene = site.scene()
    warning = Notice.warning(NoticeCode.BLOOD, API_TEXT)
    site.store.add_scores("worker-1", scene, 1, report_with(warning))
    page.press(scene, "View")
    page.until_state("live")
    for drawer, text in (("report-drawer", "notice.blood"), ("library", "problem.input:calibration")):
        page.show(drawer)
        page.until_text(f"#{drawer}", say(text))
        assert [found.group() for found in API_WORDS.finditer(first_layer(page))] == []
    page.click(f'[data-job="{failed}"] .api-words summary')
    page.until_text(f'[data-job="{failed}"]', API_TEXT)
    page.show("report-drawer")
    page.click("#report .figures summary")
    page.until_text("#report", "blood")
    assert API_TEXT in page.text("#report")


def test_row_7_a_good_scene_is_told_without_an_alarm(site: Site, page: Page) -> None:
    scene = site.scene()
    copies = Notice.info(NoticeCode.COPYING_SCORES_MORE, "Copying neighbours scores more.")
    slow = report_with(copies).model_copy(update={"baseline_blend_db": 41.9})
    site.store.add_scores("worker-1", scene, 1, slow)
    site.painter.warnings = [Notice.warning(NoticeCode.HARDLY_SEEN, "x"), Notice.warning(NoticeCode.POSES_UNSURE, "x")]
    page.press(scene, "View")
    page.until_state("live")
    page.until_text("#picture-warning", say("notice.hardly_seen"))
    page.show("report-drawer")
    page.until_text("#report .verdict", say("light.good"))
    assert say("light.good_why") in page.text("#report .verdict")
    assert "copying" not in first_layer(page)
    page.find("#stage").send_keys("-")  # away from the endoscope, what was hardly seen is a guess
    page.until_state("extrapolated")


@pytest.mark.parametrize(
    ("warnings", "changes", "light"),
    [
        ((Notice.warning(NoticeCode.BLOOD, "x"),), {}, "care"),
        ((Notice.warning(NoticeCode.BLOOD, "x"), Notice.warning(NoticeCode.EYES_DISAGREE, "x")), {}, "bad"),
        ((), {"psnr_tissue_db": None}, "bad"),
        ((), {"scored": False, "psnr_tissue_db": None}, "pending"),
        ((Notice.warning(NoticeCode.GPU_IDLE, "x"),), {}, "good"),
    ],
)
def test_the_light_has_a_word_and_its_reasons_the_worst_first(
    site: Site, page: Page, warnings: tuple[Notice, ...], changes: dict[str, object], light: str
) -> None:
    scene = site.scene()
    site.store.add_scores("worker-1", scene, 1, report_with(*warnings).model_copy(update=changes))
    page.press(scene, "View")
    page.show("report-drawer")
    page.until_text("#report .verdict", say(f"light.{light}"))
    told = page.script("return [...document.querySelectorAll('#report .reasons li')].map((each) => each.textContent)")
    expected = [] if light == "good" else [say(f"notice.{each.code}") for each in reversed(warnings)]
    assert told == (expected or ([say("light.not_measured")] if light == "bad" else []))
    assert page.find("#report .light .shape").is_displayed()


def test_a_german_browser_reads_german(site: Site, german: Page) -> None:
    failed = site.queued_job()
    site.queue.fail(site.claim(), JobError(code=ErrorCode.TRAINING_DIVERGED, problem="NaN."))
    scene = site.scene()
    german.press(scene, say("job.view", "de"))
    german.until_text("#report", say("report.trusted", "de"))
    german.until_text(f'[data-job="{failed}"]', say("problem.training_diverged", "de"))
    assert german.script("return document.documentElement.lang") == "de"


def test_row_10_trying_again_is_offered_only_where_it_can_succeed(site: Site, page: Page) -> None:
    offered = {}
    for code in (ErrorCode.INPUT, ErrorCode.TRAINING_DIVERGED, ErrorCode.OUT_OF_MEMORY, ErrorCode.UNAVAILABLE):
        offered[site.queued_job()] = code
        site.queue.fail(site.claim(), JobError(code=code, problem="x"))
    for job_id, code in offered.items():
        page.until_text(f'[data-job="{job_id}"]', say(f"problem.{code}"))
        names = page.script(
            "return [...document.querySelectorAll(`[data-job='${arguments[0]}'] button`)].map((b) => b.dataset.action)",
            job_id,
        )
        assert ("retry" in names) == (code is ErrorCode.UNAVAILABLE or code is ErrorCode.OUT_OF_MEMORY), code


def test_row_5_a_time_left_is_told_roughly_and_a_broken_promise_is_admitted(site: Site, page: Page) -> None:
    job_id = site.queued_job()
    claim = site.claim()
    site.train(claim, 20, 24.0)
    page.until_text("#jobs", say("left.seconds", count=20))
    page.script("Date.now = ((now) => () => now() + (window.later ?? 0))(Date.now.bind(Date))")
    site.train(claim, 90, 25.0, seconds_left=1.0)
    page.until_text("#jobs", say("left.soon"))
    page.script("window.later = 20000")
    site.train(claim, 91, 25.0, seconds_left=1.0)
    page.until_text(f'[data-job="{job_id}"]', say("left.overdue"))


def test_another_language_is_chosen_in_the_help_and_kept(site: Site, page: Page) -> None:
    page.click("#show-help")
    page.script(
        "const choice = document.querySelector('#language'); choice.value = 'de';"
        "choice.dispatchEvent(new Event('change'))"
    )
    page.until_text("#help caption", say("help.keys", "de"))
    page.until_text("#help-title", say("help.title", "de"))
    page.open()
    page.until_text("#tools", say("tool.scenes", "de"))
    page.script("localStorage.clear()")


def test_nothing_plays_without_a_scene(site: Site, page: Page) -> None:
    assert not page.find("#play").is_enabled()
    page.press(site.scene(), "View")
    page.until_state("live")
    assert page.find("#play").is_enabled()


def test_a_change_of_language_changes_what_is_said_of_the_picture_at_rest_and_of_the_service(
    site: Site, page: Page
) -> None:
    page.press(site.scene(), "View")
    page.until_text("#status-text", say("view.endoscope"))
    page.until_text("#connection", say("page.ready"))
    page.speak("de")
    page.until_text("#status-text", say("view.endoscope", "de"))
    page.until_text("#connection", say("page.ready", "de"))
    page.script("localStorage.clear()")
