"""What the page shows of masks, in a real browser: recorded frames with marks, and masks to save and correct."""

from __future__ import annotations

from pathlib import Path
from zipfile import ZipFile

import pytest
from selenium.webdriver.support.select import Select

from intrasplat.names import MASKS
from intrasplat.report import Masks
from tests.client.local_service import CLIP
from tests.client.page import CALIBRATION, RECORDED_SHADE, REPORT_OF_THE_PAGE, Page, Site
from tests.client.words import say


def test_found_masks_are_told_of_and_saved_to_be_corrected(site: Site, page: Page, tmp_path: Path) -> None:
    page.driver.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    masks = Masks(source="found", share=0.123, sure=0.41)
    scene = site.scene()
    site.store.add_scores("worker-1", scene, 1, REPORT_OF_THE_PAGE.model_copy(update={"masks": masks}))
    (site.store.scene_folder(scene, 1) / MASKS).write_bytes(b"PK")
    page.press(scene, "View")
    page.click("#report .figures summary")
    page.until_text("#report", "Found by their colour and depth; 12.3 % of the picture. Not sure: of what looks")
    page.click('#report button[aria-label^="Save the masks"]')
    page.until(lambda: list(tmp_path.glob(f"scene-*-{scene[:8]}-masks.zip")))
    (saved,) = tmp_path.glob("scene-*-masks.zip")
    assert saved.read_bytes() == b"PK"


def test_recorded_frames_show_the_masks_while_a_job_trains_and_afterwards(site: Site, page: Page) -> None:
    job_id = site.queued_job()
    claim = site.claim()
    site.train(claim, 20, 24.0)
    page.press(job_id, "Watch")
    page.until_state("training")
    Select(page.find("#layer")).select_by_value("recorded")
    for end in (lambda: None, lambda: site.finish(claim)):
        end()
        page.until(lambda: page.text("#badge").startswith("RECORDED") and page.shade == RECORDED_SHADE)
        assert page.view == "recorded, masks marked, 0.00 s"
    Select(page.find("#layer")).select_by_value("rgb")
    page.until(lambda: page.text("#badge") == say("screen.current") and page.shade > RECORDED_SHADE)


def test_better_masks_are_sent_without_the_clip(site: Site, page: Page, tmp_path: Path) -> None:
    page.choose("clip", CLIP)
    page.click("#upload > details > summary")
    Select(page.find("#upload [name=mask_source]")).select_by_value("auto")
    Select(page.find("#upload [name=poses]")).select_by_value("fixed")
    page.choose("calibration", CALIBRATION)
    page.click("#upload [type=submit]")
    page.until_text("#jobs", "waiting")
    claim = site.claim()
    site.train(claim, 20, 24.0)
    page.until_state("training")
    Select(page.find("#layer")).select_by_value("recorded")
    page.click("#better-masks")
    page.until_text("#upload-again", f"The clip of {claim.job_id[:8]} again")
    page.click("#upload-again button")
    page.until(lambda: page.find("#upload [name=clip]").is_displayed())
    Select(page.find("#layer")).select_by_value("rgb")
    page.until(lambda: not page.find("#better-masks").is_displayed())
    scene = site.finish(claim)
    masks = Masks(source="found", share=0.123, sure=0.41)
    site.store.add_scores("worker-1", scene, 1, REPORT_OF_THE_PAGE.model_copy(update={"masks": masks}))
    page.click('#report button[aria-label="Send better masks"]')
    page.until(lambda: not page.find("#upload [name=clip]").is_displayed())
    with ZipFile(tmp_path / "better.zip", "w"):
        pass
    page.choose("masks", tmp_path / "better.zip")
    page.click("#upload [type=submit]")
    page.until_text("#jobs", "waiting")
    again = site.claim()
    (record,) = (each for each in site.queue.records() if each.job_id == again.job_id)
    assert record.clip_of == scene
    assert (record.options.poses, record.options.mask_source) == ("fixed", "given")
    folder = site.store.spool_folder(record.job_id)
    assert (folder / "clip.mp4").read_bytes() == CLIP.read_bytes()
    assert (folder / "masks.zip").read_bytes() == (tmp_path / "better.zip").read_bytes()
    page.until_text("#jobs", say("stage.start"))  # and it opened by itself
    page.show("drawer")
    page.until(lambda: page.find("#upload [name=clip]").is_displayed())
    page.press(scene, "Delete")
    page.click("#confirm [value=yes]")
    page.until_text("#jobs-message", say("job.clip_kept"))
    page.click("#jobs-message summary")
    page.until_text("#jobs-message", f"clip_kept_by {record.job_id}")


def test_a_clip_is_sent_again_without_any_file(site: Site, page: Page) -> None:
    page.send(CLIP)
    page.until_text("#jobs", "waiting")
    scene = site.finish(site.claim())
    report = REPORT_OF_THE_PAGE.model_copy(update={"masks": Masks(source="none")})
    site.store.add_scores("worker-1", scene, 1, report)
    page.click(f'#report button[aria-label="{say("report.send_masks")}"]')
    page.click("#upload [type=submit]")
    page.until(lambda: [each.clip_of for each in site.queue.records() if each.job_id != scene] == [scene])


@pytest.mark.parametrize(
    ("masks", "words"),
    [
        (Masks(source="none"), "None masked: every pixel counts as tissue."),
        (Masks(source="given", share=0.2), "Masked as given with the clip; 20.0 % of the picture."),
    ],
)
def test_masks_that_were_not_found_are_not_offered(site: Site, page: Page, masks: Masks, words: str) -> None:
    scene = site.scene()
    site.store.add_scores("worker-1", scene, 1, REPORT_OF_THE_PAGE.model_copy(update={"masks": masks}))
    page.press(scene, "View")
    page.click("#report .figures summary")
    page.until_text("#report", words)
    assert "Save the masks" not in page.text("#report")
