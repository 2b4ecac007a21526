"""A picture of the view, saved from the page in a real browser: what is in view, and what it is in words."""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import cv2
import numpy as np
from selenium.webdriver.common.keys import Keys

from contract.wire.labels import LabelChange
from tests.client.page import Page, Site, grey_of
from tests.client.words import say

SIGNATURE_BYTES = 8


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
    page.until(lambda: list(tmp_path.glob("*.png")))
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
