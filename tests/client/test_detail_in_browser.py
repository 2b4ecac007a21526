"""A browser that draws scenes by itself shows the service's picture, with detail, as soon as the view rests."""

from __future__ import annotations

import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from contract.store.store import Store
from intrasplat.names import DETAIL, RECORDED
from intrasplat.scene.recorded_file import name_of
from intrasplat.scene.training_pictures import RecordedEye, encoded
from tests.client.drawn import opened, picture_of, render_of
from tests.client.page import site_at
from tests.client.player import drawing_browser
from tests.client.test_player import scattered
from worker.views import Views


def test_a_view_that_rests_gets_detail_from_the_service(tmp_path: Path) -> None:
    model, archive = scattered(14, moves=True), BytesIO()
    lens = model.intrinsics
    white = np.full((lens.height, lens.width, 3), 250, np.uint8)
    video = encoded(model.trained_frames, [RecordedEye(lens, np.eye(4))], lambda eye, frame: white)
    assert video is not None
    with zipfile.ZipFile(archive, "w") as recorded:
        recorded.writestr(name_of("left", 0, "jpg"), b"")
    beside = {DETAIL: video, RECORDED: archive.getvalue()}
    views = Views(Store(tmp_path / "data"))
    with drawing_browser() as driver, site_at(tmp_path / "data", views.answer) as site:
        driver.set_window_size(640, 480)  # a processor draws few pixels
        with opened(site.url, driver) as page:
            page.press(site.scene(model=model, beside=beside), "View")
            page.choose_way("always")
            page.until_way("memory", "")
            page.look(t=0.3)
            page.until(lambda: page.shown.get("t") == 0.3 and page.shown.get("way") in ("stream", "single"))
            shown = picture_of(page).mean()
            assert page.way == ("memory", "")  # what moves is drawn here
            assert shown == pytest.approx(render_of(site.url, page.shown).mean(), abs=2.0)
