"""Comparing with the recording, in a real browser: a seam or side by side, either eye, instruments or a hatch."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip
from intrasplat.clip import Eye as ClipEye
from intrasplat.names import RECORDED, Eye
from intrasplat.report import LightChanges, Masks
from intrasplat.scene.recorded_file import EYES
from intrasplat.view.recorded import recorded_files
from tests.client.page import REPORT_OF_THE_PAGE, WORKER, Page, Site, grey_of
from tests.client.test_theatre_in_browser import SIZES, box_of, screen_of
from tests.client.words import say

FRAMES = REPORT_OF_THE_PAGE.frame_count
HATCH = (40, 74)
MODEL_MARK = "e0"
"""Of a scene that is painted brighter than its recorded frames."""


def shade_of(frame: int, eye: Eye = "left") -> int:
    return 20 + 8 * frame + (100 if eye == "right" else 0)


def eye_of(eye: Eye, *, masks: bool) -> dict[str, Any]:
    """Plain frames of a shade each, whose left half is masked."""
    shape = (FRAMES, 48, 60)
    shades = np.array([shade_of(frame, eye) for frame in range(FRAMES)], np.uint8)
    tissue = np.ones(shape, np.bool_)
    tissue[:, :, :30] = not masks
    return {
        "rgb": np.broadcast_to(shades[:, None, None, None], (*shape, 3)),
        "tissue": tissue,
        "depth_mm": np.zeros(shape, np.float32),
        "depth_confidence": np.zeros(shape, np.uint8),
        "intrinsics": Intrinsics(width=60, height=48, fx=60, fy=60, cx=30, cy=24),
        "world_from_camera": np.tile(np.eye(4), (FRAMES, 1, 1)),
    }


def recorded_scene(
    site: Site,
    eyes: tuple[Eye, ...] = ("left",),
    *,
    masks: bool = True,
    light: LightChanges | None = REPORT_OF_THE_PAGE.light,
) -> str:
    """A finished scene that keeps recorded frames."""
    scene = site.scene(MODEL_MARK)
    left, right = (eye_of(eye, masks=masks) for eye in EYES)
    clip = DepthClip(**left, frame_times_s=np.arange(FRAMES) / 25, right=ClipEye(**right))
    files, kept = recorded_files(clip, eyes, ())
    (site.store.scene_folder(scene, 1) / RECORDED).write_bytes(files[RECORDED] or b"")
    given = Masks(source="given", share=0.5) if masks else None
    changes = {"recorded": kept, "masks": given, "light": light}
    site.store.add_scores(WORKER, scene, 1, REPORT_OF_THE_PAGE.model_copy(update=changes))
    return scene


def view(page: Page, scene: str) -> None:
    """Open a scene, and wait for its report, which says what it keeps."""
    page.press(scene, "View")
    page.until_state("live")
    page.until_text("#report", "dB")


def choose(page: Page, mode: str) -> None:
    page.script("document.querySelector('#more').open = true")  # on narrow screens it is under "More"
    Select(page.find("#compare")).select_by_value(mode)


def shade_at(page: Page, share: float) -> int:
    """Of the recorded picture, at a share of its width; -1: there is none."""
    found: int = page.script(
        """
        const canvas = document.querySelector("#recorded");
        if (canvas.hidden || canvas.width === 0) return -1;
        const x = Math.floor(canvas.width * arguments[0]);
        return canvas.getContext("2d").getImageData(x, canvas.height / 2, 1, 1).data[0];
        """,
        share,
    )
    return found


def until_frame(page: Page, frame: int, eye: Eye = "left") -> None:
    page.until(lambda: abs(shade_at(page, 0.75) - shade_of(frame, eye)) <= 2)
    page.until_text("#of-recorded", say("compare.recorded", frame=frame + 1))


def seen(page: Page) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """What the screen shows, in grey."""
    shot = np.frombuffer(page.driver.get_screenshot_as_png(), np.uint8)
    return np.asarray(cv2.imdecode(shot, cv2.IMREAD_GRAYSCALE), np.uint8)


def shades_across(page: Page) -> tuple[int, int]:
    """At a third and at two thirds of the picture's width, half-way down."""
    left, top, right, bottom = box_of(page, "#fitted")
    row = seen(page)[round((top + bottom) / 2)]
    width = (bottom - top) * 60 / 48
    middle = (left + right) / 2
    return int(row[round(middle - width / 6)]), int(row[round(middle + width / 6)])


def test_a_seam_parts_recording_and_model_and_moves_by_keys_and_by_hand(site: Site, page: Page) -> None:
    scene = recorded_scene(site)
    view(page, scene)
    choose(page, "wipe")
    until_frame(page, 0)
    assert page.text("#of-model") == say("compare.model")
    model, recorded = grey_of(scene), shade_of(0)
    page.until(lambda: np.allclose(shades_across(page), (recorded, model), atol=3))
    seam = page.find("#seam")
    left, _, right, _ = box_of(page, "#fitted")
    by_hand = ActionChains(page.driver, 0).move_to_element(seam).click_and_hold()
    by_hand.move_by_offset(round(0.4 * (right - left)), 0).release().perform()
    assert 88 <= int(seam.get_attribute("aria-valuenow") or 0) <= 92
    page.until(lambda: np.allclose(shades_across(page), (recorded, recorded), atol=3))
    for key, percent in ((Keys.END, 100), (Keys.PAGE_DOWN, 90), (Keys.ARROW_RIGHT, 92), (Keys.HOME, 0)):
        seam.send_keys(key)
        assert seam.get_attribute("aria-valuenow") == str(percent)
    page.until(lambda: np.allclose(shades_across(page), (model, model), atol=3))
    assert page.view.startswith("colour, endoscope's view")  # the hand on the seam has not turned the model


def test_the_recorded_frame_is_the_one_of_the_moment_in_view(site: Site, page: Page) -> None:
    view(page, recorded_scene(site))
    choose(page, "wipe")
    until_frame(page, 0)
    for frame in (5, 3, FRAMES - 1):
        page.script(
            "const time = document.querySelector('#time'); const { min, max } = time;"
            "time.value = Number(min) + (Number(max) - Number(min)) * arguments[0];"
            "time.dispatchEvent(new Event('input', { bubbles: true }))",
            frame / FRAMES,
        )
        until_frame(page, frame)


def test_it_follows_playing_with_few_pictures_in_memory(site: Site, page: Page) -> None:
    page.script(
        """
        window.open_bitmaps = window.most_bitmaps = window.frames_asked = 0;
        window.frames_shown = new Set();
        const make = window.createImageBitmap;
        window.createImageBitmap = async (...given) => {
          const made = await make(...given);
          window.most_bitmaps = Math.max(window.most_bitmaps, ++window.open_bitmaps);
          return made;
        };
        const close = ImageBitmap.prototype.close;
        ImageBitmap.prototype.close = function () { window.open_bitmaps--; close.call(this); };
        const ask = window.fetch;
        window.fetch = (path, ...given) => {
          if (String(path).includes("/recorded")) window.frames_asked++;
          return ask(path, ...given);
        };
        new MutationObserver(() => window.frames_shown.add(document.querySelector("#of-recorded").textContent))
          .observe(document.querySelector("#of-recorded"), { childList: true });
        """
    )
    view(page, recorded_scene(site))
    assert page.script("return frames_asked") == 0  # nobody compares yet
    choose(page, "side")
    until_frame(page, 0)
    page.find("#play").click()
    page.until(lambda: page.script("return frames_shown.size") >= FRAMES)
    shown = page.script("return performance.now()")
    page.until(lambda: page.script("return performance.now()") > shown + 3000)  # some loops
    assert page.script("return frames_asked") == 2 * FRAMES  # pictures and masks, each once
    assert page.script("return most_bitmaps") <= 2 * 8 + 4  # eight frames with masks, and what is just being made
    page.find("#play").click()
    choose(page, "off")
    page.until(lambda: page.script("return open_bitmaps") <= 1)
    assert shade_at(page, 0.75) == -1


def test_instruments_are_shown_or_hatched(site: Site, page: Page) -> None:
    view(page, recorded_scene(site))
    choose(page, "wipe")
    until_frame(page, 0)
    assert abs(shade_at(page, 0.25) - shade_of(0)) <= 2
    page.click("#compare-tools")
    page.until(lambda: shade_at(page, 0.25) in HATCH)
    until_frame(page, 0)  # tissue is as it was
    across = {shade_at(page, x / 60 + 0.001) for x in range(30)}
    assert across == set(HATCH)
    page.click("#compare-tools")
    page.until(lambda: abs(shade_at(page, 0.25) - shade_of(0)) <= 2)


def test_instruments_are_not_offered_where_nothing_is_masked(site: Site, page: Page) -> None:
    view(page, recorded_scene(site, masks=False))
    choose(page, "wipe")
    until_frame(page, 0)
    assert not page.find("#compare-tools").is_displayed()


def test_comparing_goes_home_and_turning_away_says_why_it_ends(site: Site, page: Page) -> None:
    view(page, recorded_scene(site))
    page.find("#stage").send_keys(Keys.ARROW_LEFT)
    page.until(lambda: "turned" in page.view)
    choose(page, "side")
    until_frame(page, 0)
    assert "endoscope's view" in page.view
    page.find("#stage").send_keys(Keys.ARROW_LEFT)
    page.until_text("#compare-message", say("compare.turned"))
    assert page.find("#compare").get_attribute("value") == "off"
    assert not page.find("#compare-box").is_displayed()
    choose(page, "wipe")
    until_frame(page, 0)
    assert page.text("#compare-message") == ""


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_side_by_side_each_has_half_of_what_is_free(site: Site, page: Page, width: int, height: int) -> None:
    with screen_of(page, width, height):
        view(page, recorded_scene(site))
        choose(page, "side")
        until_frame(page, 0)
        left, top, right, bottom = box_of(page, "#fitted")
        recorded, model = box_of(page, "#recorded"), box_of(page, "#picture")
        if width > height:
            middle = (left + right) / 2
            assert np.allclose(recorded, (left, top, middle, bottom), atol=3)
            assert np.allclose(model, (middle, top, right, bottom), atol=3)
            assert box_of(page, "#tools")[0] >= right
        else:
            middle = (top + bottom) / 2
            assert np.allclose(recorded, (left, top, right, middle), atol=3)
            assert np.allclose(model, (left, middle, right, bottom), atol=3)
        assert not page.find("#seam").is_displayed()


@pytest.mark.parametrize("mode", ["wipe", "side"])
def test_the_model_is_drawn_as_the_moment_was_recorded_until_the_comparison_ends(
    site: Site, page: Page, mode: str
) -> None:
    view(page, recorded_scene(site))
    page.find("#stage").send_keys(Keys.ARROW_LEFT)
    page.until(lambda: "turned" in page.view)
    assert site.painter.light == ("steady", "remove")
    choose(page, mode)
    until_frame(page, 0)
    assert site.painter.light == ("recorded", "show")
    assert say("picture.recorded_light") in page.view
    for _ in range(4):  # of the slider's 40 places; the report's clip has 12 frames
        page.find("#step-on").click()
    until_frame(page, 1)
    assert site.painter.light == ("recorded", "show")
    choose(page, "off")
    page.until(lambda: site.painter.light == ("steady", "remove"))
    page.until(lambda: say("picture.recorded_light") not in page.view)


def test_light_that_does_not_change_is_not_spoken_of_and_a_frame_is_of_the_moment_in_view(
    site: Site, page: Page
) -> None:
    view(page, recorded_scene(site, light=None))
    choose(page, "wipe")
    until_frame(page, 0)
    assert site.painter.light == ("steady", "remove")
    assert say("picture.recorded_light") not in page.view
    page.script("import(document.scripts[0].src).then(({ viewer }) => viewer.look({ layer: 'recorded', t: 0.31 }))")
    page.until(lambda: page.text("#status-text") not in ("", "0.00 s"))
    page.until(lambda: page.text("#status-text") == page.text("#time-value").split(" of ")[0])


def test_another_layer_is_compared_too(site: Site, page: Page) -> None:
    view(page, recorded_scene(site))
    Select(page.find("#layer")).select_by_value("depth")
    choose(page, "wipe")
    until_frame(page, 0)
    page.until(lambda: page.find("#seam").is_displayed())


def test_the_right_eyes_frames_are_compared_with_what_the_right_eye_sees(site: Site, page: Page) -> None:
    view(page, recorded_scene(site, ("left", "right")))
    choose(page, "wipe")
    until_frame(page, 0)
    page.until(lambda: page.find("#eye").is_displayed())
    for eye in ("right", "left"):
        Select(page.find("#eye")).select_by_value(eye)
        until_frame(page, 0, "right" if eye == "right" else "left")
        assert site.painter.eye == eye
    Select(page.find("#eye")).select_by_value("right")
    until_frame(page, 0, "right")
    choose(page, "side")  # stays with the eye
    page.until(lambda: page.script("return document.querySelector('#stage').dataset.compare") == "side")
    until_frame(page, 0, "right")
    assert page.find("#eye").get_attribute("value") == "right"


def test_an_eye_whose_frames_are_not_kept_is_told(site: Site, page: Page) -> None:
    view(page, recorded_scene(site))
    choose(page, "wipe")
    until_frame(page, 0)
    Select(page.find("#eye")).select_by_value("right")
    page.until_text("#compare-message", say("compare.no_eye"))


def test_a_key_goes_from_mode_to_mode(site: Site, page: Page) -> None:
    view(page, recorded_scene(site))
    for mode in ("wipe", "side", "off"):
        page.find("#stage").send_keys("c")
        assert page.find("#compare").get_attribute("value") == mode


def test_scenes_without_recorded_frames_and_jobs_that_train_say_so(site: Site, page: Page) -> None:
    view(page, site.scene())
    choose(page, "wipe")
    page.until_text("#compare-message", say("compare.none"))
    assert page.find("#compare").get_attribute("value") == "off"
    job_id = site.queued_job()
    site.train(site.claim(), 20, 24.0)
    page.press(job_id, "Watch")
    page.until_state("training")
    assert page.text("#compare-message") == ""
    choose(page, "wipe")
    page.until_text("#compare-message", say("compare.not_yet"))
    page.driver.get(f"{site.url}/#/scene/{job_id}?compare=wipe")  # for when it is finished
    page.find("#stage").send_keys(Keys.ARROW_LEFT)
    page.until(lambda: "pose=" in page.driver.current_url)
    assert "compare=wipe" in page.driver.current_url


def test_another_scene_or_a_purge_ends_it_and_leaves_no_picture(site: Site, page: Page) -> None:
    other, scene = site.scene(), recorded_scene(site)
    view(page, scene)
    choose(page, "wipe")
    until_frame(page, 0)
    page.press(other, "View")
    page.until(lambda: page.shade == grey_of(other))
    assert shade_at(page, 0.75) == -1
    view(page, scene)
    choose(page, "wipe")
    until_frame(page, 0)
    site.store.purge(scene)
    site.queue.forget(scene)
    page.until_state("waiting")
    assert shade_at(page, 0.75) == -1
    assert page.text("#of-recorded") == "" or not page.find("#compare-box").is_displayed()


def test_frames_that_cannot_be_read_are_told(site: Site, page: Page) -> None:
    scene = recorded_scene(site)
    (site.store.scene_folder(scene, 1) / RECORDED).write_bytes(b"PK")
    view(page, scene)
    choose(page, "wipe")
    page.until_text("#compare-message", say("compare.failed", why="").strip())
    assert page.find("#compare").get_attribute("value") == "off"
