"""The live screen in a browser, beside a worker whose pictures carry their own time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver

from intrasplat.live.state import FeedReason, FeedState
from intrasplat.live.times import FeedTimeKind
from tests.client.live_feed import PAST_S, READ_TIME, LivePage, LivePainter, live_painter, opened_feed
from tests.client.page import Site
from tests.client.words import say

TOLERANCE_MS = 100.0
CLICK = """
const stage = document.getElementById("model-stage");
const canvas = document.getElementById("model-picture");
const box = canvas.getBoundingClientRect();
const scale = Math.min(box.width / canvas.width, box.height / canvas.height);
const x = box.left + box.width / 2 + (arguments[0] - 0.5) * scale * canvas.width;
const y = box.top + box.height / 2 + (arguments[1] - 0.5) * scale * canvas.height;
stage.setPointerCapture = () => {};
const about = { bubbles: true, isPrimary: true, button: 0, pointerId: 7, clientX: x, clientY: y };
for (const kind of ["pointerdown", "pointerup"]) stage.dispatchEvent(new PointerEvent(kind, about));
"""
HAS_CLOCK = "return import(document.scripts[0].src).then(({ clock }) => clock.bounds.length > 10)"
DRAG_TAPE = """
const tape = document.getElementById("tape");
return (async () => {
  for (const each of arguments) {
    tape.value = String(each);
    for (const kind of ["input", "change"]) tape.dispatchEvent(new Event(kind, { bubbles: true }));
    await new Promise((done) => setTimeout(done, 100));
  }
})();
"""
"""Drag the tape's thumb to each of these places, 100 ms apart."""
WRITES = """
const [done] = arguments;
import(document.scripts[0].src).then(({ look }) => {
  const write = history.replaceState;
  let writes = 0;
  history.replaceState = (...given) => (writes++, write.apply(history, given));
  for (let i = 0; i < 200; i++) look.turn((orbit) => orbit.turn(1, 0));
  look.freezeAt(Date.now() / 1000 - 5);
  setTimeout(() => done(writes), 1000);
});
"""
"""How often the address is written while a hand turns the model and then freezes it."""
ASKED_WITHIN_A_SECOND = """
performance.clearResourceTimings();
return new Promise((done) => setTimeout(done, 1000)).then(() =>
  performance.getEntriesByType("resource").map(({ name }) => name).filter((name) => name.includes("/recorded")));
"""
PRESS = "document.body.dispatchEvent(new KeyboardEvent('keydown', { key: arguments[0], bubbles: true }))"


@pytest.fixture
def painter(site: Site, tmp_path: Path) -> Iterator[LivePainter]:
    with live_painter(site, tmp_path) as painter:
        yield painter


@pytest.fixture
def page(site: Site, painter: LivePainter, driver: webdriver.Chrome) -> Iterator[LivePage]:
    page = LivePage(driver, site.url)
    driver.get(site.url)
    page.script("localStorage.setItem('intrasplat-language', 'en')")
    yield page
    assert page.faults() == []
    page.script("localStorage.clear()")
    driver.get("about:blank")


def watched(site: Site, page: LivePage, label: str | None = None) -> str:
    """A feed whose screen is live, with pictures of endoscope and model."""
    feed_id = opened_feed(site, label)
    page.watch(feed_id)
    page.until(lambda: page.state == "live" and age_of(page, "model") is not None and age_of(page, "live") is not None)
    page.until(lambda: page.script("return !document.getElementById('tape').disabled"))
    return feed_id


def age_of(page: LivePage, name: str) -> dict[str, Any] | None:
    found: dict[str, Any] | None = page.script(READ_TIME, f"{name}-picture", f"{name}-age")
    return found


def shown_ms(text: str) -> float:
    """What "80 ms old" or "1.2 s behind" says."""
    number, unit, *_ = text.split()
    return float(number) * (1 if unit == "ms" else 1000)


def word(page: LivePage) -> str:
    return page.text("#word")


def test_it_shows_the_endoscope_and_the_model_with_their_true_ages(
    site: Site, page: LivePage, painter: LivePainter
) -> None:
    watched(site, page)
    assert word(page) == say("live.word_live")
    page.until(lambda: page.script(HAS_CLOCK))
    for name in ("live", "model"):
        differences, moments = [], set()
        for _ in range(15):
            found = age_of(page, name)
            assert found is not None
            differences.append(abs(shown_ms(found["text"]) - found["ageMs"]))
            moments.add(found["ms"])
            time.sleep(0.1)
        assert sorted(differences)[-2] <= TOLERANCE_MS, (name, differences)  # one may fall between picture and text
        assert len(moments) >= 4, name
    assert page.text("#trust").endswith(say("light.good"))


def test_ages_are_true_where_the_browser_s_clock_is_wrong(site: Site, page: LivePage, painter: LivePainter) -> None:
    wrong = page.driver.execute_cdp_cmd(
        "Page.addScriptToEvaluateOnNewDocument", {"source": "const now = Date.now; Date.now = () => now() - 3600e3;"}
    )
    try:
        watched(site, page)
        page.until(lambda: page.script(HAS_CLOCK))
        found = age_of(page, "live")
        assert found is not None
        age_ms = time.time() * 1000 % 2**24 - found["ms"]
        assert abs(shown_ms(found["text"]) - age_ms) <= 2 * TOLERANCE_MS  # the driver takes some
    finally:
        page.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", wrong)


def test_a_model_that_is_late_is_said_to_be_behind(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    painter.model_lag_s = 3.3
    page.until_text("#word", "MODEL BEHIND 3 s")
    assert page.text("#live-word") == say("live.word_live")
    painter.model_lag_s = 0.4
    page.until_text("#word", say("live.word_live"))


def test_loss_of_signal_is_said_within_two_seconds_and_marks_the_last_picture(
    site: Site, page: LivePage, painter: LivePainter
) -> None:
    watched(site, page)
    painter.stops_s = began_s = time.time()
    page.until_text("#word", say("live.word_stalled"))
    assert time.time() - began_s < 2.5
    assert page.script("return getComputedStyle(document.getElementById('live-picture')).opacity") == "0.35"
    painter.state, painter.reason = FeedState.STALLED, FeedReason.SILENT
    page.until_text("#why", say("live.reason_silent"))
    for reason, place in ((FeedReason.PACKING_UNKNOWN, "unusable"), (FeedReason.FAULT, "fault")):
        painter.reason = reason
        page.until_text("#word", say(f"live.word_{place}"))
    painter.state, painter.reason = FeedState.BEHIND, FeedReason.TOO_SLOW
    page.until_text("#word", say("live.word_too_slow"))
    painter.stops_s, painter.state, painter.reason = None, FeedState.STALLED, FeedReason.NO_SCENE
    page.until_text("#word", say("live.word_no_model"))  # the cable is fine
    page.until_text("#live-word", say("live.word_live"))
    painter.stops_s, painter.state, painter.reason = None, FeedState.LIVE, None
    page.until_text("#word", say("live.word_live"))


def test_a_service_that_is_gone_is_said_to_be_lost_and_comes_back(
    site: Site, page: LivePage, painter: LivePainter
) -> None:
    watched(site, page)
    site.stop()
    began_s = time.time()
    page.until_text("#word", say("live.word_service_lost"))
    assert time.time() - began_s < 2.5
    site.start()
    page.until_text("#word", say("live.word_live"))


def test_freeze_holds_the_model_and_never_the_endoscope(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    page.click("#freeze")
    page.until(lambda: page.state == "frozen")
    held = age_of(page, "model")
    live = age_of(page, "live")
    assert held is not None
    assert live is not None
    page.until(lambda: (age_of(page, "live") or live)["ms"] - live["ms"] > 1000)
    after = age_of(page, "model")
    assert after is not None
    assert after["ms"] == held["ms"]
    painter.has_model = False  # as while another width begins
    page.until(lambda: age_of(page, "model") is None)
    painter.has_model, painter.is_coarse = True, True
    page.until(lambda: (age_of(page, "model") or {"ms": None})["ms"] == held["ms"])
    asked = len(painter.renders)
    page.until(lambda: len(painter.renders) > asked + 1)
    page.until_text("#trust-why", say("notice.coarse"))
    painter.is_coarse = False  # there is time: from the next picture on none of a frozen moment is asked for
    page.until(lambda: say("notice.coarse") not in page.text("#trust-why"))
    asked = len(painter.renders)
    time.sleep(2)
    assert len(painter.renders) == asked
    assert word(page).startswith("FROZEN")
    assert page.text("#live-word") == say("live.word_live")
    frame = "return getComputedStyle(document.body, '::after')"
    assert page.script(f"{frame}.borderTopStyle") == "double"
    assert page.script("return getComputedStyle(document.querySelector('.strike')).visibility") == "visible"
    address = page.driver.current_url
    page.script(PRESS, "l")
    page.until(lambda: page.state == "live")
    assert page.script(f"{frame}.borderTopWidth") == "0px"
    page.until(lambda: "at=" not in page.driver.current_url)
    page.driver.get("about:blank")
    feed, _, at = address.replace("/live.html#/", "/#/live/").partition("?")
    page.driver.get(f"{feed}?{at.replace(':', '%3A')}")  # as some programs spell what they hand on
    page.until(lambda: page.state == "frozen")
    page.until(lambda: (age_of(page, "model") or {"ms": None})["ms"] == held["ms"])
    page.until(lambda: page.script("return document.querySelectorAll('#tape-drawing .frozen').length") == 1)
    page.driver.get("about:blank")
    page.driver.get(f"{feed}?at=yesterday")
    page.until_text("#message", say("live.at_unreadable"))
    page.until(lambda: page.state == "live")
    assert page.driver.execute_async_script(WRITES) == 1  # type: ignore[no-untyped-call]  # browsers refuse more than some
    assert "at=" in page.driver.current_url


def test_the_tape_goes_back_and_plays_on_from_there(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    page.script(DRAG_TAPE, -12)
    page.until_text("#word", "LOOKING BACK 12 s")
    page.until(lambda: 11_000 < (age_of(page, "model") or {"ageMs": 0})["ageMs"] < 13_000)
    first = age_of(page, "model")
    assert first is not None
    page.until(lambda: (age_of(page, "model") or first)["ms"] > first["ms"] + 500)
    assert word(page) == "LOOKING BACK 12 s"
    page.script(PRESS, "ArrowLeft")
    page.until_text("#word", "LOOKING BACK 13 s")
    assert page.text("#tape-ticks").split("\n") == ["−2 min", "−1:30 min", "−1 min", "−0:30 min", "now"]
    page.script(DRAG_TAPE, -PAST_S - 20)
    page.until(lambda: page.text("#model-message") != "")
    page.click("#live")
    page.until(lambda: page.state == "live" and page.text("#model-message") == "")


def test_a_frozen_moment_is_measured_with_its_interval(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    page.click("#measure")
    page.until(lambda: page.state == "frozen")
    page.until_text("#measured", say("live.measure_first"))
    page.script(CLICK, 0.4, 0.6)
    page.until_text("#measured", say("live.measure_second"))
    page.script(CLICK, 0.6, 0.6)
    page.until_text("#measured", "mm")
    found = age_of(page, "model")
    assert found is not None
    assert page.text("#measured").count("±") == 1
    measured = painter.measured[-1]
    assert measured.moment is not None
    assert measured.moment.kind is FeedTimeKind.UNIX
    assert abs(measured.moment.seconds * 1000 % 2**24 - found["ms"]) <= 2
    assert [round(x) for point in measured.points for x in point] == [160, 192, 240, 192]
    page.script(PRESS, "Escape")
    page.until(lambda: page.script("return document.getElementById('measured').hidden"))


def test_points_are_chosen_by_keys_too(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    page.script(PRESS, "m")
    page.until_text("#measured", say("live.measure_first"))
    on_stage = PRESS.replace("document.body", "document.getElementById('model-stage')")
    page.script(on_stage, "ArrowDown")
    page.script(on_stage, "Enter")
    page.until_text("#measured", say("live.measure_second"))
    for _ in range(5):
        page.script(on_stage, "ArrowRight")
    page.script(on_stage, "Enter")
    page.until_text("#measured", "±")


def test_out_of_the_body_nothing_is_shown(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    painter.state = FeedState.NO_TISSUE
    page.until_text("#word", say("live.word_no_tissue"))
    page.until_text("#live-message", say("live.nothing_recorded"))
    time.sleep(0.5)  # one that was under way stays unseen, and no more are asked for
    assert page.script(ASKED_WITHIN_A_SECOND) == []
    assert page.script("const { hidden, width } = document.getElementById('live-picture'); return [hidden, width]") == [
        True,
        0,
    ]
    painter.state = FeedState.LIVE
    page.until(lambda: page.state == "live" and age_of(page, "live") is not None)


def test_pause_and_end_say_what_they_do(site: Site, page: LivePage, painter: LivePainter) -> None:
    feed_id = watched(site, page)
    page.click("#pause")
    page.until_text("#word", say("live.word_paused"))
    page.until_text("#why", say("live.reason_by_hand"))
    page.until_text("#pause", say("live.resume"))
    page.click("#pause")
    page.until_text("#word", say("live.word_live"))
    page.click("#end")
    page.until_text("#confirm-question", "12.3 MB")
    page.click("#confirm [value=no]")
    assert site.queue.feed(feed_id) is not None
    page.click("#end")
    page.click("#confirm [value=yes]")
    page.until_text("#word", say("live.word_ended"))
    assert site.queue.feed(feed_id) is None
    for name in ("keep", "live", "pause", "end"):
        assert not page.find(f"#{name}").is_enabled(), name


def test_health_says_rates_and_why_nothing_is_recorded(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    page.script("document.getElementById('health').open = true")
    for part in ("30.0/s", "4.9/s", "12.3 MB", "0.06 s"):
        page.until_text("#health-list", part)
    texts = "return ['model-age', 'health-list'].map((id) => document.getElementById(id).textContent)"
    age, listed = page.script(texts)
    assert f"{say('live.model_age')}{age.split()[0]} s" in listed
    painter.recording = FeedReason.DISK_FULL
    page.until_text("#health-list", say("live.reason_disk_full"))
    assert word(page) == say("live.word_live")


def test_turning_is_shown_with_its_trust_and_ends_without_a_hand(
    site: Site, page: LivePage, painter: LivePainter
) -> None:
    watched(site, page)
    page.script("import(document.scripts[0].src).then(({ look }) => look.turn((orbit) => orbit.stand('orbit:18,0,1')))")
    page.until_text("#trust", say("light.care"))
    page.until_text("#trust-why", say("notice.pose_far"))
    page.script("import(document.scripts[0].src).then(({ look }) => (look.handMs -= 20000))")
    page.until_text("#trust", say("light.good"))
    page.until_text("#model-place", say("view.endoscope"))


def test_rocking_turns_to_and_fro_by_8_degrees(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    page.click("#look")
    page.until_text("#model-place", say("live.rocking"))
    yaws = lambda: [getattr(each.pose, "yaw_deg", 0.0) for each in painter.renders]  # noqa: E731
    page.until(lambda: min(yaws()) < -6 and max(yaws()) > 6)
    assert max(abs(yaw) for yaw in yaws()) <= 8.01
    page.click("#live")
    page.until_text("#model-place", say("view.endoscope"))


def test_a_presenter_freezes_and_goes_back_to_live(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    for key, state in (("PageDown", "frozen"), ("PageUp", "live"), (" ", "frozen"), (" ", "live")):
        page.script(PRESS, key)
        page.until(lambda state=state: page.state == state)  # type: ignore[misc]


def test_it_asks_nobody_else(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    names = page.script("return performance.getEntriesByType('resource').map((each) => each.name)")
    assert [each for each in names if not each.startswith((site.url, "blob:"))] == []
