"""The file of a scene with recorded frames in a browser that cannot decode their video."""

from __future__ import annotations

from pathlib import Path

from selenium import webdriver
from selenium.webdriver.common.by import By

from client.page import DASHBOARD
from intrasplat.names import REPORT
from intrasplat.report import DetailScores
from intrasplat.scene.stored_exports import stored_parts
from tests.archives import ORIGIN, report_of
from tests.client.test_page_file import TABLE, driver, opened, scene_with_recorded_frames, text
from tests.client.words import say

__all__ = ["driver"]
WITHOUT_DECODER = {"source": "delete window.VideoDecoder;"}


def test_it_says_so_and_offers_neither_detail_nor_comparison(driver: webdriver.Chrome, tmp_path: Path) -> None:
    folder, path = tmp_path / "scene", tmp_path / "scene.html"
    scene = scene_with_recorded_frames(folder)
    report = report_of(scene, detail=DetailScores(psnr_tissue_db=38.1, psnr_right_db=None, ssim=None))
    (folder / REPORT).write_text(report.model_dump_json())
    path.write_bytes(b"".join(stored_parts("html", folder, ORIGIN, DASHBOARD)))
    driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", WITHOUT_DECODER)
    opened(driver, path, "shown", "#compare=wipe")
    assert text(driver, "#message") == TABLE["no_video"]
    assert f"{TABLE['fact_quality']}{say('figure.without_detail', db='36.20 dB')}" in text(driver, "#facts")
    assert not driver.find_element(By.ID, "compare").is_displayed()
