"""The page draws scenes by itself where it can and may, says who draws and why, and never shows what is gone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium import webdriver

from contract.access.keys import KeyFile, KeyScope
from contract.store.store import Store
from contract.wire.rendering import SceneRequest
from intrasplat.scene.checkpoint import SCENE_FILE
from tests.client.drawn import VIEWER, Drawn, beside_the_service, opened, picture_of, same_as_the_service, view_here
from tests.client.local_service import Line
from tests.client.page import Painter, Site, browser, site_at
from tests.client.player import drawing_browser
from tests.client.test_player import scattered
from tests.client.words import say
from tests.intrasplat.scenes import random_scene
from worker.reply import Reply
from worker.views import Views


@pytest.fixture(scope="module")
def driver() -> Iterator[webdriver.Chrome]:
    with drawing_browser() as driver:
        driver.set_window_size(640, 480)  # a processor draws few pixels
        yield driver


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with site_at(tmp_path / "data", Views(Store(tmp_path / "data")).answer) as site:
        yield site


@pytest.fixture
def page(site: Site, driver: webdriver.Chrome) -> Iterator[Drawn]:
    with opened(site.url, driver) as page:
        yield page


FILLS = """
const { width, height } = document.querySelector("#picture");
const { clientWidth, clientHeight } = document.querySelector("#fitted");
return width === clientWidth || height === clientHeight;
"""
VIEWS: list[dict[str, object]] = [
    {"t": 0.0, "pose": None},
    {"t": 0.31, "pose": "orbit:12,-7,1.5", "unseen": "guess"},
    {"t": 2 / 3, "pose": "orbit:-20,5,0.8", "highlights": "off", "unseen": "mark"},
    {"t": 0.8, "pose": "1 0 0 4 0 1 0 0.1 0 0 1 0", "highlights": "on"},
]


def test_the_page_shows_the_picture_that_the_service_would(site: Site, page: Drawn) -> None:
    view_here(site, page)
    for wish in VIEWS:
        page.look(**wish)
        page.until(lambda: page.shown.get("t") == pytest.approx(wish["t"], abs=1e-3))  # noqa: B023
        page.until(lambda: (page.shown.get("pose", "") is None) == (wish["pose"] is None))  # noqa: B023
        height, width, _ = same_as_the_service(site, page).shape
        assert width / height == pytest.approx(64 / 48, rel=0.01)
    page.until(lambda: page.script(FILLS))  # what is free of the screen; the clip is 64 x 48


def test_a_picture_is_exact_again_when_playing_ends(site: Site, page: Drawn) -> None:
    view_here(site, page)
    page.look(pose="orbit:20,10,1")
    page.click("#play")
    page.until(lambda: page.shown.get("t", 0) > 0.3)
    page.click("#play")
    settle(site, page)
    # Nobody chose this time: two Gaussians may lie at one depth, which the service may blend the other way round.
    t = page.shown["t"]
    drawn, _ = beside_the_service(site, page)
    for wish in ({"t": 0.1, "pose": "orbit:-10,0,1"}, {"t": t, "pose": "orbit:20,10,1"}):
        page.look(**wish)
        settle(site, page)
    assert page.shown["t"] == t
    assert (picture_of(page) == drawn).all()


def settle(site: Site, page: Drawn) -> int:
    """Wait until the page draws nothing more; pictures drawn so far."""
    drawn = -1
    while drawn != (drawn := page.driver.execute_async_script(COUNT_DRAWN)):
        site.announce()
        time.sleep(SETTLED_S)
    return drawn


def test_without_a_graphics_processor_the_service_draws_and_the_page_says_so(site: Site, page: Drawn) -> None:
    page.press(site.scene(model=scattered(10, moves=False)), "View")
    page.until_state("live")
    page.until_way("service", "software")
    page.script("document.querySelector('#way').open = true")
    assert say("way.there") in page.text("#way")
    assert say("way.why_software") in page.text("#way")
    page.until_text("#readout", say("readout.stream"))
    assert page.decided_ms > 0.0


def test_a_browser_without_webgl_leaves_drawing_to_the_service(site: Site) -> None:
    with browser(("--disable-gpu", "--disable-3d-apis")) as bare, opened(site.url, bare) as page:
        page.press(site.scene(model=scattered(10, moves=False)), "View")
        page.until_state("live")
        page.until_way("service", "no_webgl")
        page.choose_way("always")
        page.until_way("service", "no_webgl")
        page.until_state("live")


def test_the_choice_is_kept_and_can_be_taken_back_in_two_languages(site: Site, page: Drawn) -> None:
    scene = view_here(site, page)
    assert say("way.here") in page.text("#way")
    page.until(lambda: "SwiftShader" in page.text("#way output"))  # what draws, and how long it takes
    page.open()
    page.press(scene, "View")
    page.until_way("memory", "")
    page.choose_way("never")
    page.until_way("service", "never")
    page.until(lambda: page.shown.get("way") == "stream")
    page.speak("de")
    page.until_text("#way", say("way.why_never", "de"))
    page.until_text("#badge", say("screen.current", "de"))


def test_a_key_without_the_scope_sees_the_stream(tmp_path: Path, driver: webdriver.Chrome) -> None:
    data = tmp_path / "data"
    with site_at(data, Views(Store(data)).answer, hosts=("127.0.0.1",)) as site:
        _, key = KeyFile(data).create("local", {KeyScope.VIEW}, "page")
        with opened(site.url, driver) as page:
            page.script(
                "localStorage['intrasplat-drawing'] = 'always'; sessionStorage['intrasplat-key'] = arguments[0]", key
            )
            page.open()
            page.press(site.scene(model=scattered(10, moves=False)), "View")
            page.until_state("live")
            page.until_way("service", "no_scope")
            names = page.script("return performance.getEntriesByType('resource').map((each) => each.name)")
            assert [each for each in names if "/files/" in each] == []
            page.script("sessionStorage.clear()")


@pytest.mark.parametrize("damage", ["bytes", "kind"])
def test_what_cannot_be_drawn_here_is_drawn_by_the_service(site: Site, page: Drawn, damage: str) -> None:
    scene = site.scene(model=random_scene("fdm-gaussian") if damage == "kind" else scattered(10, moves=False))
    page.press(scene, "View")
    page.until_state("live")  # the worker has it in memory
    if damage == "bytes":
        path = site.store.scene_folder(scene, 1) / SCENE_FILE
        content = bytearray(path.read_bytes())
        content[-200] ^= 0xFF
        path.write_bytes(content)
    page.choose_way("always")
    page.until_way("service", "damaged" if damage == "bytes" else "kind")
    page.look(t=0.5)
    page.until(lambda: page.shown.get("t") == 0.5)
    assert (page.shown.get("way"), page.state) == ("stream", "live")


def test_a_download_that_breaks_off_goes_on_where_it_was(site: Site, page: Drawn) -> None:
    page.script(CUT_ONCE)
    view_here(site, page)
    assert page.script("return window.asked.map(([range]) => range)") == [None, "bytes=1000-"]


CUT_ONCE = """
window.asked = [];
const fetched = window.fetch;
window.fetch = async (path, options) => {
  const response = await fetched(path, options);
  if (!String(path).endsWith("scene.safetensors")) return response;
  window.asked.push([options.headers.Range ?? null]);
  if (window.asked.length > 1) return response;
  const start = (await response.arrayBuffer()).slice(0, 1000);
  const body = new ReadableStream({
    start: (controller) => controller.enqueue(new Uint8Array(start)),
    pull: (controller) => controller.error(new TypeError("network error")),
  });
  return new Response(body, { headers: response.headers });
};
"""


def test_while_a_job_trains_the_service_draws_and_then_the_browser(tmp_path: Path, driver: webdriver.Chrome) -> None:
    data = tmp_path / "data"
    views, painter = Views(Store(data)), Painter()

    def answer(request: SceneRequest) -> Reply:
        return (painter if request.attempt is None else views).answer(request)

    with site_at(data, answer) as site, opened(site.url, driver) as page:
        page.choose_way("always")
        job = site.queued_job()
        claim = site.claim()
        site.train(claim, 20, 24.0)
        page.press(job, "Watch")
        page.until_state("training")
        page.until_way("service", "training")
        site.finish(claim, model=scattered(13, moves=False))
        page.until_way("memory", "")
        page.until_state("live")


def test_a_scene_that_is_purged_while_it_plays_leaves_the_screen(site: Site, page: Drawn) -> None:
    scene = view_here(site, page)
    page.click("#play")
    site.queue.forget(scene)
    site.store.purge(scene)
    page.until(lambda: page.state == "waiting")
    page.until_text("#stage-message", say("problem.http_404:scene"))
    assert page.script("return document.querySelector('#picture').width") == 0
    assert page.driver.execute_async_script(VIEWER % "done(viewer.memory.player === null && viewer.shown === null)")


def test_a_withdrawn_key_takes_the_scene_away(tmp_path: Path, driver: webdriver.Chrome) -> None:
    data = tmp_path / "data"
    with site_at(data, Views(Store(data)).answer, hosts=("127.0.0.1",)) as site:
        keys = KeyFile(data)
        known, key = keys.create("local", {KeyScope.VIEW, KeyScope.DOWNLOAD}, "page")
        with opened(site.url, driver) as page:
            page.script("sessionStorage['intrasplat-key'] = arguments[0]", key)
            page.open()
            view_here(site, page)
            keys.revoke(known.key_id)
            page.until_text("#key-message", say("problem.http_401:wrong"))
            page.until(lambda: page.script("return document.querySelector('#picture').width") == 0)
            page.script("sessionStorage.clear()")


def test_a_scene_in_memory_plays_on_while_the_service_is_away_and_the_page_says_so(site: Site, page: Drawn) -> None:
    view_here(site, page)
    site.stop()
    try:
        page.until_state("unconfirmed")
        assert say("screen.unconfirmed") in page.text("#badge")
        assert say("screen.unconfirmed_why", time="|").split("|")[0] in page.text("#status-text")
        for t in (0.25, 0.5):
            page.look(t=t)
            page.until(lambda: page.shown.get("t") == t)  # noqa: B023
        page.click("#play")
        page.until(lambda: page.shown.get("t") not in (0.25, 0.5))
        assert page.state == "unconfirmed"  # drawing confirms nothing
    finally:
        site.start()
    page.until_state("live")
    assert page.way == ("memory", "")


def test_a_lost_graphics_context_hands_over_to_the_service(site: Site, page: Drawn) -> None:
    view_here(site, page)
    page.driver.execute_async_script(
        VIEWER
        % "viewer.memory.player.canvas.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext(); done()"
    )
    page.until_way("service", "context_lost")
    page.until(lambda: page.shown.get("way") == "stream")
    page.until_state("live")


def test_two_tabs_draw_the_same_scene_and_both_lose_it(site: Site, page: Drawn) -> None:
    scene = view_here(site, page)
    first = page.driver.current_window_handle
    page.driver.switch_to.new_window("tab")
    page.open()
    page.press(scene, "View")
    page.until_way("memory", "")  # the choice is the browser's
    second = page.driver.current_window_handle
    site.queue.forget(scene)
    site.store.purge(scene)
    for tab in (second, first):
        page.driver.switch_to.window(tab)
        page.until_text("#stage-message", say("problem.http_404:scene"))
    page.driver.switch_to.window(second)
    page.driver.close()
    page.driver.switch_to.window(first)


STILL_S, SETTLED_S = 8.0, 2.0
MAX_STILL_BYTES_S = 1000


@pytest.mark.parametrize("choice", ["always", "never"])
def test_a_scene_that_rests_costs_less_than_a_kilobyte_a_second(
    site: Site, driver: webdriver.Chrome, choice: str
) -> None:
    line = Line(int(site.url.rsplit(":", 1)[1]))
    try:
        with opened(line.url, driver) as page:
            page.press(site.scene(model=scattered(13, moves=False)), "View")
            page.choose_way(choice)
            page.until_way(*(("memory", "") if choice == "always" else ("service", "never")))
            page.until(lambda: page.shown.get("way") == ("memory" if choice == "always" else "stream"))
            page.until_state("live")
            drawn = settle(site, page)
            before = line.bytes
            for _ in range(4):
                site.announce()  # else the worker counts as gone, and the page says so
                time.sleep(STILL_S / 4)
            spent = line.bytes - before
            assert page.driver.execute_async_script(COUNT_DRAWN) == drawn
            assert page.state == "live"
            assert 0 < spent < MAX_STILL_BYTES_S * STILL_S
    finally:
        line.close()


COUNT_DRAWN = (
    VIEWER
    % """
  if (window.drawn === undefined) {
    window.drawn = 0;
    viewer.addEventListener("shown", () => (window.drawn += 1));
  }
  done(window.drawn);
"""
)


def test_opening_and_playing_again_and_again_leaves_nothing_behind(site: Site, page: Drawn) -> None:
    script = page.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": COUNT})
    try:
        page.open()
        scenes = [view_here(site, page), site.scene(model=scattered(10, moves=False))]
        counts = []
        for _ in range(2):
            for scene in reversed(scenes):
                site.announce()  # else the worker counts as gone after a while
                page.press(scene, "View")
                page.until_way("memory", "")
                page.click("#play")
                page.until(lambda: page.shown.get("t", 0) > 0)
                page.click("#play")
            counts.append(page.script("return window.alive()"))
        assert counts[0]["textures"] > 0
        assert counts[0]["workers"] == 1
        assert counts[1] == counts[0]
    finally:
        page.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)


COUNT = """
const contexts = new Map();
const [create, remove] = ["createTexture", "deleteTexture"].map((name) => WebGL2RenderingContext.prototype[name]);
WebGL2RenderingContext.prototype.createTexture = function () {
  contexts.set(this, (contexts.get(this) ?? 0) + 1);
  return create.call(this);
};
WebGL2RenderingContext.prototype.deleteTexture = function (texture) {
  contexts.set(this, contexts.get(this) - 1);
  return remove.call(this, texture);
};
let workers = 0;
const terminate = Worker.prototype.terminate;
window.Worker = class extends Worker {
  constructor(...given) {
    super(...given);
    workers += 1;
  }
  terminate() {
    if (!this.isOver) workers -= 1;
    this.isOver = true;
    terminate.call(this);
  }
};
let bitmaps = 0;
const [make, close] = [window.createImageBitmap, ImageBitmap.prototype.close];
window.createImageBitmap = async (...given) => {
  const made = await make(...given);
  bitmaps += 1;
  return made;
};
ImageBitmap.prototype.close = function () {
  bitmaps -= 1;
  close.call(this);
};
window.alive = () => {
  const live = [...contexts].filter(([context]) => !context.isContextLost());
  return { contexts: live.length, textures: live.reduce((sum, [, count]) => sum + count, 0), workers, bitmaps };
};
"""
