"""A picture of the view, saved from the page in a real browser: what is in view, and what it is in words."""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from contract.wire.labels import LabelChange
from tests.client.page import Page, Site, grey_of
from tests.client.test_compare_in_browser import MODEL_MARK, choose, shade_of, until_frame
from tests.client.test_sheet_in_browser import follow_measured, viewed
from tests.client.words import say

SIGNATURE_BYTES = 8
LINE_BGR = (75, 179, 232)
"""Of measurements: --warn of style/page.css."""


def texts_of(png: bytes) -> dict[str, str]:
    """The uncompressed international texts of a PNG whose chunks are all sound."""
    found, at = {}, SIGNATURE_BYTES
    while at < len(png):
        length, kind = int.from_bytes(png[at : at + 4], "big"), png[at + 4 : at + 8]
        body = png[at + 8 : at + 8 + length]
        assert zlib.crc32(kind + body) == int.from_bytes(png[at + 8 + length : at + 12 + length], "big")
        if kind == b"iTXt":
            keyword, rest = body.split(b"\0", 1)
            found[keyword.decode()] = rest[2:].split(b"\0", 2)[2].decode()
        at += 12 + length
    return found


def test_a_picture_of_the_view_says_what_it_shows(site: Site, page: Page, tmp_path: Path) -> None:
    page.driver.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    scene = site.scene()
    site.queue.relabel(scene, LabelChange(label="Läsion 3"))
    page.press(scene, "View")
    page.until_state("live")
    page.until(lambda: page.text("#verdict"))
    page.find("#stage").send_keys(Keys.ARROW_RIGHT * 12)
    page.until_state("extrapolated")
    page.find("#stage").send_keys("p")
    page.until(lambda: [file for file in tmp_path.glob("*.png") if file.stat().st_size])
    (file,) = tmp_path.glob("*.png")
    assert file.name == "Läsion_3-0.00_s.png"
    content = file.read_bytes()
    texts = texts_of(content)
    view, trust, made = texts["Description"].split("\n")
    assert texts["Title"] == "Läsion 3"
    assert view.startswith("Läsion 3 · 0.00 s · " + say("layer.rgb"))
    assert json.loads(texts["View"])["pose"].startswith("orbit:")
    assert page.view.split(", ")[1] in view
    assert trust.startswith(f"{page.text('#badge')} · {say('light.care')} · ")
    assert say("notice.pose_far") in trust
    assert texts["Software"] in made
    assert say("page.notice") in made
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture.shape[1] == 660  # the painter's 60, enlarged
    assert np.all(abs(picture[:528].astype(int) - grey_of(scene)) <= 3)
    caption = picture[528:]
    assert (caption == 0).mean() > 0.6  # on black
    assert (caption > 200).mean() > 0.02  # written


def saved_file(page: Page, folder: Path) -> bytes:
    """The PNG that the key saves."""
    page.find("#stage").send_keys("p")
    page.until(lambda: [file for file in folder.glob("*.png") if file.stat().st_size])
    (file,) = folder.glob("*.png")
    content = file.read_bytes()
    file.unlink()
    return content


def saved(page: Page, folder: Path) -> NDArray[np.uint8]:
    """[H, W, 3] BGR of the picture that the key saves."""
    content = np.frombuffer(saved_file(page, folder), np.uint8)
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), np.uint8)


def test_a_picture_of_a_comparison_names_both_sides_and_has_the_measurements_that_are_shown(
    site: Site, page: Page, tmp_path: Path
) -> None:
    page.driver.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    other, scene = site.scene("10"), viewed(site, page)
    follow_measured(site, page, scene)

    def lines(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
        return np.asarray(np.all(abs(picture.astype(int) - LINE_BGR) <= 3, axis=2))

    side_px, factor = 660, 660 / 60
    for mode, left in (("off", 0), ("wipe", 0), ("side", side_px)):
        choose(page, mode)
        if mode != "off":
            until_frame(page, 0)
        site.announce()
        picture = saved(page, tmp_path)
        lower, right = (round(factor * each) for each in (28, 36))  # of the area, in pixels of its picture
        found = lines(picture)[lower - 3 : lower + 4, left : left + side_px]
        assert found[:, round(factor * 26) : right].any(axis=0).mean() > 0.8
        assert not found[:, right + 30 :].any()
        values = picture[round(factor * 6) : round(factor * 26), left : left + side_px]
        assert (values.min(axis=2) > 220).sum() > 300  # letters, brighter than the model
        if mode == "off":
            continue
        middle = side_px if mode == "side" else side_px // 2
        of_recorded, of_model = picture[6:60, :middle], picture[6:60, middle:]
        assert min((of_recorded > 200).mean(), (of_model < 60).mean()) > 0.005
        assert shade_of(0) < 60 < grey_of(MODEL_MARK) < 220
    Select(page.find("#beside")).select_by_value(other)
    page.until_text("#of-recorded", "0.00 s")
    site.painter.pause_s = 0.3
    page.find("#step-on").click()
    view = json.loads(texts_of(saved_file(page, tmp_path))["View"])  # both halves are of the next frame
    assert view["compared"]["scene"] == other
    assert view["compared"]["t"] == pytest.approx(view["t"], abs=1e-5)
    assert view["t"] > 0
    site.painter.pause_s = 0
    choose(page, "off")
    page.click("#measuring .end")
    assert not lines(saved(page, tmp_path)).any()
