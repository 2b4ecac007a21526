"""A browser that draws scenes by itself leaves the light and the smoke of the recording to the service."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from contract.store.store import Store
from tests.client.drawn import opened, picture_of, render_of, same_as_the_service, view_here
from tests.client.page import site_at
from tests.client.player import drawing_browser
from tests.client.test_player import scattered
from worker.views import Views


def test_the_service_draws_the_recorded_light_where_it_is_not_the_models(tmp_path: Path) -> None:
    model = scattered(14, moves=True)
    gains = np.linspace(-0.6, 0.6, model.frame_count)
    drifting = replace(model, settings={**model.settings, "log_gains": np.tile(gains[:, None], 3).tolist()})
    views = Views(Store(tmp_path / "data"))
    with drawing_browser() as driver, site_at(tmp_path / "data", views.answer) as site:
        driver.set_window_size(640, 480)  # a processor draws few pixels
        with opened(site.url, driver) as page:
            view_here(site, page)
            page.look(light="recorded")
            page.until(lambda: page.shown.get("light") == "recorded")
            assert page.way == ("memory", "")  # it has the light of its recording
            page.press(site.scene(model=drifting), "View")
            page.until(lambda: page.shown.get("way") == "memory" and page.shown["light"] == "steady")
            steady = same_as_the_service(site, page).mean()
            page.look(light="recorded")
            page.until(lambda: page.shown.get("light") == "recorded")
            assert page.way == ("service", "layer")
            drawn = picture_of(page).mean()
            assert drawn == pytest.approx(render_of(site.url, page.shown).mean(), abs=1.0)
            assert drawn < 0.8 * steady
            page.look(light="steady")
            page.until(lambda: page.shown.get("way") == "memory")
