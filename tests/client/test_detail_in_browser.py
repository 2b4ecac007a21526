"""A page that draws scenes adds the detail of recorded frames; where it cannot, the service's picture follows."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium import webdriver

from contract.store.store import Store
from intrasplat.names import DETAIL, RECORDED, REPORT
from intrasplat.report import Recorded, Report
from intrasplat.scene.recorded_file import EYES
from tests.client.drawn import Drawn, beside_the_service, opened, picture_of, render_of
from tests.client.page import Site, site_at
from tests.client.player import drawing_browser
from tests.client.test_player import scattered
from tests.client.test_player_detail import stored
from worker.views import Views

WITHOUT_WEBCODECS = "delete window.VideoDecoder;"


@pytest.fixture(scope="module")
def driver() -> Iterator[webdriver.Chrome]:
    with drawing_browser() as driver:
        driver.set_window_size(640, 480)  # a processor draws few pixels
        yield driver


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with site_at(tmp_path / "data", Views(Store(tmp_path / "data")).answer) as site:
        yield site


def view_with_detail(
    site: Site, page: Drawn, folder: Path, *, is_masked: bool = True, is_damaged: bool = False
) -> None:
    """A scene with recorded frames that the page draws by itself."""
    model = dataclasses.replace(scattered(14, moves=True), trained_t=(0.0, 1 / 3, 2 / 3))
    scene = stored(folder, model, 2, is_masked=is_masked)
    beside = {name: (folder / name).read_bytes() for name in (DETAIL, RECORDED)}
    if is_damaged:
        beside[DETAIL] = beside[DETAIL][:3000] + bytes(len(beside[DETAIL]) - 3000)
    name = site.scene(model=scene, beside=beside)
    path = site.store.scene_folder(name, 1) / REPORT
    frames, content = tuple(scene.trained_frames), beside[RECORDED]
    kept = Recorded(frames=frames, eyes=EYES, width=1, height=1, masks=is_masked, size_bytes=len(content))
    changes = {"frame_count": scene.frame_count, "recorded": kept}
    path.write_text(Report.model_validate_json(path.read_text()).model_copy(update=changes).model_dump_json())
    page.press(name, "View")
    page.choose_way("always")
    page.until_way("memory", "")


WISHES: tuple[dict[str, object], ...] = (
    {"t": 0.3, "pose": None},
    {"t": 0.5, "pose": "orbit:5,-3,1"},
    {"t": 0.6, "pose": None, "highlights": "off"},
)


@pytest.mark.parametrize("is_masked", [True, False])
def test_a_view_that_rests_gets_detail_from_the_page(
    site: Site, driver: webdriver.Chrome, tmp_path: Path, is_masked: bool
) -> None:
    with opened(site.url, driver) as page:
        view_with_detail(site, page, tmp_path / "made", is_masked=is_masked)
        for wish in WISHES:
            page.look(**wish)
            page.until(lambda: page.shown.get("t") == wish["t"] and page.shown["hasDetail"])  # noqa: B023
            beside_the_service(site, page)


@pytest.mark.parametrize("lack", ["no_codec", "damaged"])
def test_where_the_page_cannot_the_services_picture_follows(
    site: Site, driver: webdriver.Chrome, tmp_path: Path, lack: str
) -> None:
    source = WITHOUT_WEBCODECS if lack == "no_codec" else ""
    script = driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": source})
    try:
        with opened(site.url, driver) as page:
            view_with_detail(site, page, tmp_path / "made", is_damaged=lack == "damaged")
            page.look(t=0.3)
            page.until(lambda: page.shown.get("t") == 0.3 and page.shown.get("way") in ("stream", "single"))
            shown = picture_of(page).mean()
            assert page.way == ("memory", "")  # what moves is drawn here
            assert shown == pytest.approx(render_of(site.url, page.shown).mean(), abs=2.0)
    finally:
        driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)
