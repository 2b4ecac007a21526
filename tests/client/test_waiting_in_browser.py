"""From the click that sends a clip to its scene: the user's own frame, one bar that only grows, pictures."""

from __future__ import annotations

from contract.wire.job import JobError, JobProgress
from intrasplat.errors import ErrorCode
from tests.client.local_service import CLIP
from tests.client.page import REPORT_OF_THE_PAGE, Page, Site
from tests.client.test_theatre_in_browser import box_of
from tests.client.words import say

BAR = "return document.querySelector('#waiting progress').value"
HIDDEN = "return document.querySelector(arguments[0]).hidden"
PREVIEW = """
const preview = document.querySelector("#preview");
const { data } = preview.getContext("2d").getImageData(preview.width / 4, preview.height / 4, 1, 1);
return [preview.width, preview.height, data[0] + data[1] + data[2] > 0];
"""
"""Width, height, and whether it is not black."""
SPACE = "document.body.dispatchEvent(new KeyboardEvent('keydown', { key: ' ', bubbles: true }))"
PRESSED = "return document.querySelector('#play').getAttribute('aria-pressed')"


def test_the_first_frame_of_the_users_own_clip_is_on_the_stage_until_the_first_picture(site: Site, page: Page) -> None:
    page.send(CLIP)
    page.until(lambda: not page.script(HIDDEN, "#preview"))
    assert page.script(PREVIEW) == [96, 80, True]  # the left eye of two
    assert page.text("#badge") == say("screen.own_clip")
    assert not page.find("#drawer").is_displayed()
    assert not page.find("#play").is_enabled()
    page.script(SPACE)
    assert page.script(PRESSED) == "false"
    claim = site.claim()  # from now on the worker may answer with pictures
    site.train(claim, 20, 24.0)
    page.until_state("training")
    page.until(lambda: page.find("#play").is_enabled())
    assert page.script(HIDDEN, "#preview")
    page.until_text("#waiting p", "about 20 s left")
    assert page.text("#badge") == say("screen.training")
    for stage in ("finish", "publish"):
        site.queue.beat(claim, JobProgress(stage=stage, fraction=1.0))
        page.until_text("#waiting p", say(f"stage.{stage}"))
        page.until(lambda: page.text("#badge") == say("screen.storing"))
    page.click("#tools [data-drawer=report-drawer]")
    scene = site.finish(claim, scored=False)
    page.until_state("live")
    page.until(lambda: page.script(HIDDEN, "#waiting"))
    page.until_text("#report", say("report.depth_pending"))
    assert say("report.no_depth") not in page.text("#report")
    page.click("#report .figures summary")
    page.until_text("#report .figures", say("figure.pending"))
    site.store.add_scores("worker-1", scene, 1, REPORT_OF_THE_PAGE)
    page.until_text("#report", say("report.depth", mm="0.8"))


def test_one_bar_and_the_title_of_the_tab_grow_with_every_stage(site: Site, page: Page) -> None:
    page.send(CLIP)
    claim = site.claim()
    shares = []
    for stage, fraction in (("decode", 0.2), ("decode", 0.9), ("stereo", 0.1), ("fusion", 0.0), ("train", 0.1)):
        site.queue.beat(claim, JobProgress(stage=stage, fraction=fraction))
        page.until_text("#waiting p", say(f"stage.{stage}"))
        before = shares[-1] if shares else 0.1
        page.until(lambda before=before: page.script(BAR) > before)
        shares.append(page.script(BAR))
        page.until(lambda: page.script("return document.title") == f"{round(100 * shares[-1])} % · intrasplat")
    site.queue.beat(claim, JobProgress(stage="stereo", fraction=0.0))  # it began again
    page.until_text("#waiting p", say("stage.stereo"))
    assert page.script(BAR) == shares[-1]


def test_a_scene_in_view_does_not_stand_under_the_word_of_the_clip_that_is_sent(site: Site, page: Page) -> None:
    scene = site.scene()
    page.press(scene, "View")
    page.until_state("live")
    page.send(CLIP)
    page.until(lambda: page.text("#badge") == say("screen.own_clip"))
    assert page.script(HIDDEN, "#picture")
    page.press(scene, "View")
    page.until_state("live")
    assert page.script(HIDDEN, "#preview")


def test_a_clip_that_fails_before_its_first_picture_says_so_on_the_stage(site: Site, page: Page) -> None:
    page.send(CLIP)
    page.until(lambda: not page.script(HIDDEN, "#preview"))
    site.queue.fail(site.claim(), JobError(code=ErrorCode.TRAINING_DIVERGED, problem="NaN."))
    page.until_text("#stage-message", say("problem.training_diverged"))
    assert page.script(HIDDEN, "#preview")
    assert page.script(HIDDEN, "#waiting")


def test_a_refused_clip_gives_form_and_scene_back(site: Site, page: Page) -> None:
    page.press(site.scene(), "View")
    page.until_state("live")
    top = box_of(page, "#stage")
    site.stop()
    try:
        page.send(CLIP)
        page.until(lambda: not page.script(HIDDEN, "#preview"))
        page.click("#upload-stop")
        page.until_text("#upload-message", say("upload.stopped"))
        assert page.find("#drawer").is_displayed()
        assert page.script(HIDDEN, "#preview")
        assert not page.script(HIDDEN, "#picture")
        assert box_of(page, "#stage") == top
    finally:
        site.start()
