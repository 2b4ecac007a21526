"""Camera and time of the page in a real browser: hands on the picture, keys, and what they ask the service for."""

from __future__ import annotations

from typing import Any

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

from intrasplat.notices import Notice, NoticeCode
from intrasplat.pose import OrbitPose, parse_pose
from tests.cameras import CAMERAS, FIRST_CAMERAS, FRAMES
from tests.client.page import CAMERA, DEPTH_MM, Page, Site
from tests.client.words import say

SHOWN = "const done = arguments[0]; import(document.scripts[0].src).then(({ viewer }) => done(viewer.shown));"
SHORTER_FRAMES = 30
SHORTER_CAMERAS = CAMERAS.model_copy(
    update={
        "frame_times_s": CAMERAS.frame_times_s[:SHORTER_FRAMES],
        "world_from_camera": CAMERAS.world_from_camera[:SHORTER_FRAMES],
        "trained_t": (0.0,),
    }
)
MEDIAN_MM = 60 / CAMERAS.units_per_mm


def shown(page: Page) -> dict[str, Any]:
    """The view on the screen."""
    found: dict[str, Any] = page.driver.execute_async_script(SHOWN)  # type: ignore[no-untyped-call]
    return found


def orbit(page: Page) -> OrbitPose:
    pose = parse_pose(shown(page)["pose"])
    assert isinstance(pose, OrbitPose)
    return pose


@pytest.fixture
def scene(site: Site, page: Page) -> str:
    """A finished scene in view, whose cameras are known."""
    scene = site.scene()
    page.press(scene, "View")
    page.until_state("live")
    page.until_text("#time-value", f"of {FRAMES}")
    return scene


def test_time_is_told_in_seconds_and_frames_and_stepped_frame_by_frame(page: Page, scene: str) -> None:
    assert page.find("#time").get_attribute("max") == str(FRAMES - 1)
    assert page.text("#time-value") == "0.00 s of 1.95 s, frame 1 of 40"
    stage = page.find("#stage")
    stage.send_keys(".", ".", ".")
    page.until_text("#time-value", "0.15 s of 1.95 s, frame 4 of 40")
    stage.send_keys(",")
    page.until_text("#time-value", "frame 3 of 40")
    page.click("#step-on")
    page.until_text("#time-value", "frame 4 of 40")
    page.click("#step-back")
    page.until(lambda: shown(page)["t"] == pytest.approx(2 / FRAMES))
    page.find("#time").send_keys(Keys.END)
    page.until_text("#time-value", "1.95 s of 1.95 s, frame 40 of 40")
    assert page.find("#time").get_attribute("aria-valuetext") == "1.95 s of 1.95 s, frame 40 of 40"
    stage.send_keys(".")  # there is none after the last
    page.until(lambda: shown(page)["t"] == pytest.approx((FRAMES - 1) / FRAMES))


def test_a_scene_that_is_watched_from_its_first_picture_on_is_played_as_soon_as_it_trains(
    site: Site, page: Page
) -> None:
    site.painter.warnings = [Notice.warning(NoticeCode.FIRST_PICTURE, "One moment.")]
    site.painter.cameras = FIRST_CAMERAS
    scene = site.queued_job()
    claim = site.claim()
    site.train(claim, 0, 20.0)
    page.press(scene, "Watch")
    page.until_text("#badge", say("screen.first_picture"))
    page.until_text("#time-value", "frame 1 of 1")
    page.driver.execute_async_script(
        "const [t, done] = arguments; import(document.scripts[0].src).then(({ viewer }) => done(viewer.look({ t })))",
        0.5,
    )
    site.painter.cameras = CAMERAS
    site.painter.warnings = []
    page.until_text("#badge", say("screen.training"))
    page.until_text("#time-value", f"1.00 s of 1.95 s, frame 21 of {FRAMES}")  # t is kept
    assert page.find("#eye").is_displayed()
    page.click("#step-on")
    page.until_text("#time-value", "frame 22 of 40")
    site.painter.cameras = SHORTER_CAMERAS
    site.finish(claim)
    page.until_text("#time-value", f"of {SHORTER_FRAMES}")


PLAYED = """
const [speed, ms, done] = arguments;
import(new URL("stage/timeline.js", document.scripts[0].src)).then(async ({ Timeline }) => {
  const { viewer } = await import(document.scripts[0].src);
  const parts = Object.fromEntries(["play", "loop", "loopStart", "loopEnd", "loopAll", "timeValue"].map((name) =>
    [name, document.createElement("button")]));
  parts.time = Object.assign(document.createElement("input"), { type: "range" });
  parts.speed = { value: speed };
  let clock = 1000;
  const steps = [];
  const [now, frame] = [performance.now, window.requestAnimationFrame];
  performance.now = () => clock;
  window.requestAnimationFrame = (step) => steps.push(step);
  try {
    const timeline = new Timeline(parts, () => {}, () => false);
    timeline.know(viewer.timeline.cameras);
    timeline.play(true);
    const seen = [];
    for (const passed of ms) {
      clock += passed;
      steps.pop()(clock);
      seen.push(timeline.t);
    }
    done(seen);
  } finally {
    performance.now = now;
    window.requestAnimationFrame = frame;
  }
});
"""


@pytest.mark.parametrize("speed", [0.25, 0.5, 1.0, 2.0])
def test_a_clip_plays_as_long_as_it_lasted_times_the_speed(page: Page, scene: str, speed: float) -> None:
    lasts_ms = CAMERAS.frame_times_s[-1] * 1000 / speed
    half, almost, again = page.driver.execute_async_script(  # type: ignore[no-untyped-call]
        PLAYED, str(speed), [lasts_ms / 2, lasts_ms * 0.49, lasts_ms * 0.26]
    )
    last = (FRAMES - 1) / FRAMES
    assert (half, almost, again) == (
        pytest.approx(0.5 * last),
        pytest.approx(0.99 * last),
        pytest.approx(0.25 * last),
    )


def test_speed_is_chosen_by_keys_and_a_part_is_repeated_and_seen_on_the_slider(page: Page, scene: str) -> None:
    stage = page.find("#stage")
    stage.send_keys("<")
    assert page.find("#speed").get_attribute("value") == "0.5"
    stage.send_keys(">", ">", ">")
    assert page.find("#speed").get_attribute("value") == "2"
    assert not page.find("#loop").is_displayed()
    page.find("#time").send_keys(*[Keys.ARROW_RIGHT] * 10)
    stage.send_keys("a", *["."] * 5, "b")
    left, right = page.script(
        "const [track, loop] = ['.track', '#loop'].map((css) => document.querySelector(css).getBoundingClientRect());"
        "return [(loop.left - track.left - 8) / (track.width - 16), (loop.right - track.left - 8) / (track.width - 16)]"
    )
    assert (left, right) == (pytest.approx(10 / 39, abs=0.01), pytest.approx(15 / 39, abs=0.01))
    stage.send_keys(" ")
    seen: set[int] = set()
    page.until(lambda: seen.add(int(page.find("#time").get_attribute("value"))) or len(seen) > 4)
    assert seen <= set(range(10, 16))
    stage.send_keys(" ", "x")
    assert not page.find("#loop").is_displayed()


LOOP = """
const track = document.querySelector("#loop").style;
return ["--first", "--last"].map((name) => Math.round(39 * Number(track.getPropertyValue(name))));
"""


@pytest.mark.parametrize(
    ("marks", "part"),
    [
        ([(20, "a"), (10, "b")], [10, 20]),
        ([(10, "b"), (20, "a")], [10, 20]),
        ([(10, "a"), (20, "b"), (30, "a")], [30, 39]),
        ([(10, "a"), (20, "b"), (5, "b")], [0, 5]),
        ([(10, "a"), (10, "b")], [10, 39]),
    ],
)
def test_marks_set_the_other_way_round_are_swapped_and_beyond_a_part_a_new_one_begins(
    page: Page, scene: str, marks: list[tuple[int, str]], part: list[int]
) -> None:
    for frame, key in marks:
        page.script(
            "const time = document.querySelector('#time');"
            "time.value = arguments[0]; time.dispatchEvent(new Event('input'))",
            frame,
        )
        page.find("#stage").send_keys(key)
    assert page.script(LOOP) == part


def test_a_page_that_rests_names_no_pictures_a_second(page: Page, scene: str) -> None:
    page.click("#play")
    page.until_text("#readout", "pictures/s")
    page.click("#play")
    page.until(lambda: "pictures/s" not in page.text("#readout"))


def test_turning_takes_more_and_more_beyond_what_the_clip_taught_and_ends_at_60_degrees(page: Page, scene: str) -> None:
    stage = page.find("#stage")
    stage.send_keys(*[Keys.ARROW_LEFT] * 6)  # 3 degrees each
    page.until(lambda: "18°" in page.view)
    assert say("view.beyond") not in page.view
    stage.send_keys(*[Keys.ARROW_LEFT] * 8)
    page.until(lambda: say("view.beyond") in page.view)
    assert say("view.beyond") in page.text("#status-text")
    page.until(lambda: -39 < orbit(page).yaw_deg < -34)  # 42 without resistance
    stage.send_keys(*[Keys.ARROW_LEFT] * 80)
    page.until(lambda: -60 <= orbit(page).yaw_deg < -59)
    stage.send_keys(*[Keys.ARROW_RIGHT] * 4)  # back is free
    page.until(lambda: orbit(page).yaw_deg > -49)
    stage.send_keys(Keys.HOME)
    page.until(lambda: shown(page)["pose"] is None)
    assert say("view.endoscope") in page.view


DRAG = """
const [kind, buttons, moves] = arguments;
const stage = document.querySelector("#stage");
stage.setPointerCapture = () => {};
const { left, top, width, height } = stage.getBoundingClientRect();
for (const [type, id, x, y] of moves)
  stage.dispatchEvent(new PointerEvent(type, { pointerId: id, pointerType: kind, button: buttons, bubbles: true,
    clientX: left + width / 2 + x, clientY: top + height / 2 + y }));
"""


def scale_of(page: Page) -> float:
    """CSS pixels of one pixel of the picture."""
    width, height = page.script(
        "const { width, height } = document.querySelector('#picture').getBoundingClientRect(); return [width, height]"
    )
    return float(min(width / CAMERA.width, height / CAMERA.height))


def test_the_point_looked_at_follows_the_hand(page: Page, scene: str) -> None:
    x_mm = 50 / scale_of(page) / CAMERAS.intrinsics.fx * MEDIAN_MM
    ActionChains(page.driver).key_down(Keys.SHIFT).click_and_hold(page.find("#stage")).move_by_offset(
        50, 0
    ).release().key_up(Keys.SHIFT).perform()
    page.until(lambda: shown(page)["pose"] is not None)
    page.until(lambda: orbit(page).about_mm == pytest.approx((-x_mm, 0, MEDIAN_MM), abs=0.02))
    page.script(DRAG, "mouse", 2, [("pointerdown", 1, 0, 0), ("pointermove", 1, -50, 0), ("pointerup", 1, -50, 0)])
    page.until(lambda: orbit(page).about_mm == pytest.approx((0, 0, MEDIAN_MM), abs=0.02))
    page.find("#stage").send_keys(Keys.SHIFT, Keys.ARROW_DOWN)
    page.until(lambda: (orbit(page).about_mm or (0, 0, 0))[1] > 0.5)


def test_two_fingers_move_and_pinch(page: Page, scene: str) -> None:
    page.script(
        DRAG,
        "touch",
        0,
        [
            ("pointerdown", 1, -50, 0),
            ("pointerdown", 2, 50, 0),
            ("pointermove", 1, -100, 0),
            ("pointermove", 2, 100, 0),
            ("pointermove", 1, -100, 40),
            ("pointermove", 2, 100, 40),
            ("pointerup", 1, 0, 0),
            ("pointerup", 2, 0, 0),
        ],
    )
    page.until(lambda: shown(page)["pose"] is not None and orbit(page).zoom == pytest.approx(2, rel=0.1))
    about_mm = orbit(page).about_mm
    assert about_mm is not None
    y_mm = 40 / scale_of(page) / CAMERAS.intrinsics.fy * MEDIAN_MM / orbit(page).zoom
    assert about_mm == pytest.approx((0, -y_mm, MEDIAN_MM), rel=0.05, abs=0.7)


def test_a_double_click_looks_at_the_point_under_it_and_says_where_there_is_none(page: Page, scene: str) -> None:
    stage = page.find("#fitted")
    aside = 10 * scale_of(page)
    ActionChains(page.driver).move_to_element_with_offset(stage, -int(aside), 0).double_click().perform()
    page.until(lambda: shown(page)["pose"] is not None)
    x_mm = -10 / CAMERA.fx * DEPTH_MM
    assert orbit(page).about_mm == pytest.approx((x_mm, 0, DEPTH_MM), abs=0.3)
    assert page.text("#address-message") == ""
    ActionChains(page.driver).move_to_element_with_offset(stage, int(aside), 0).double_click().perform()
    page.until_text("#address-message", say("view.nothing_there"))
    assert orbit(page).about_mm == pytest.approx((x_mm, 0, DEPTH_MM), abs=0.3)


def test_the_right_eye_is_a_key_away_and_turning_begins_there(site: Site, page: Page, scene: str) -> None:
    page.find("#stage").send_keys("e")
    page.until(lambda: shown(page)["eye"] == "right")
    assert shown(page)["pose"] is None
    assert site.painter.eye == "right"
    assert say("view.right_eye") in page.view
    assert page.find("#eye").get_attribute("value") == "right"
    page.until(lambda: "pose=right" in page.driver.current_url)
    page.find("#stage").send_keys("+")
    page.until(lambda: (shown(page)["pose"] or "").startswith("orbit:"))
    assert orbit(page).about_mm == pytest.approx((4, 0, MEDIAN_MM))
    page.find("#stage").send_keys(Keys.HOME)
    page.until(lambda: shown(page)["pose"] is None)
    assert shown(page)["eye"] == "left"
    assert page.find("#eye").get_attribute("value") == "left"
