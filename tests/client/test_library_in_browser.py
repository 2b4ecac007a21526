"""The list of scenes in a real browser: found by name, told apart by picture, judged by a light, saved as files."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.common.keys import Keys

from contract.access.keys import KeyFile, KeyScope
from contract.wire.job import JobFiles, JobRecord
from contract.wire.labels import LabelChange, Labels
from intrasplat.formats import EXPORT_FORMATS
from intrasplat.notices import Notice, NoticeCode
from service.renderer import ADDRESSES_VALID_S
from tests.client.page import REPORT_OF_THE_PAGE, Page, Site, grey_of, site_at
from tests.client.words import say

NAMES = "return [...document.querySelectorAll('#jobs .name')].map((each) => each.textContent)"
PICTURES = "return [...document.querySelectorAll('#jobs img.thumbnail')].map((each) => each.src)"
SHADE_OF_THUMBNAIL = """
const [scene] = arguments;
const image = document.querySelector(`[data-job="${scene}"] img.thumbnail`);
if (!image?.naturalWidth) return -1;
const canvas = document.createElement("canvas");
canvas.getContext("2d").drawImage(image, 0, 0, 1, 1);
return canvas.getContext("2d").getImageData(0, 0, 1, 1).data[0];
"""


def card(job_id: str, inside: str = "") -> str:
    return f'[data-job="{job_id}"] {inside}'.strip()


def labelled(site: Site, job_id: str, label: str) -> str:
    site.queue.relabel(job_id, LabelChange(label=label))
    return job_id


def many_done(site: Site, count: int, began_s: float = -10_000) -> None:
    """Jobs that are done, with names, without scenes of their own; began_s: of the first, from now."""
    for index in range(count):
        record = JobRecord(
            job_id=f"{index:032x}",
            files=JobFiles(clip="clip.mp4"),
            labels=Labels(label=f"case {index}"),
            created_at_s=time.time() + began_s + index,
        )
        site.queue.submit(record)
        assert site.queue.finish(site.claim())


@pytest.fixture(autouse=True)
def _library(page: Page) -> None:
    page.show("library")


def test_each_scene_has_its_picture_its_name_its_length_and_its_light(site: Site, page: Page) -> None:
    ids = [site.queued_job(mark) for mark in ("20", "c0")]
    scenes = [labelled(site, site.finish(site.claim(), scored=False), f"liver {job_id[:2]}") for job_id in ids]
    assert scenes == ids
    slow = REPORT_OF_THE_PAGE.model_copy(
        update={"frame_times_s": (0.0, 1.5, 2.93), "warnings": (Notice.warning(NoticeCode.BLOOD, "GET /x"),)}
    )
    for scene, report in zip(scenes, (slow, REPORT_OF_THE_PAGE), strict=True):
        site.store.add_scores("worker-1", scene, 1, report)
    for scene in scenes:
        page.until(lambda scene=scene: page.text(card(scene, ".trust")))
        page.until(lambda scene=scene: abs(page.script(SHADE_OF_THUMBNAIL, scene) - grey_of(scene)) <= 3)
    assert page.script(NAMES) == ["liver c0", "liver 20"]
    page.until_text(card(scenes[0]), say("job.long", seconds="2.9"))
    page.until_text(card(scenes[0], ".trust"), say("notice.blood"))
    assert say("light.care") in page.text(card(scenes[0], ".trust"))
    assert re.search(r"\d{4}, \d\d:\d\d", page.text(card(scenes[0])))


def test_a_scene_is_renamed_in_place_and_found_by_its_name(site: Site, page: Page) -> None:
    first, second = site.scene("11"), site.scene("22")
    page.press(first, say("job.rename"))
    field = page.find(card(first, "input"))
    assert say("label.no_names") in page.text(card(first))
    field.send_keys("liver, left lobe", Keys.ENTER)
    page.until_text(card(first, ".name"), "liver, left lobe")
    record = site.queue.get(first)
    assert record is not None
    assert record.labels.label == "liver, left lobe"
    page.press(first, say("job.rename"))
    page.find(card(first, "input")).send_keys("something else", Keys.ESCAPE)
    assert page.text(card(first, ".name")) == "liver, left lobe"
    page.find("#search").send_keys("LOBE")
    page.until(lambda: page.script(NAMES) == ["liver, left lobe"])
    page.find("#search").send_keys("x")
    page.until(lambda: page.script(NAMES) == [])
    page.until_text("#no-jobs", say("label.none_found"))
    page.find("#search").send_keys(*[Keys.BACKSPACE] * 5)
    page.until(lambda: len(page.script(NAMES)) == 2)
    assert page.script("return document.querySelector('#jobs li').dataset.job") == second


def test_a_name_that_is_refused_is_told_beside_its_field(site: Site, page: Page) -> None:
    scene = site.scene()
    page.press(scene, say("job.rename"))
    page.script("document.querySelector('.rename input').maxLength = 500")
    page.find(card(scene, "input")).send_keys("x" * 100, Keys.ENTER)
    page.until_text(card(scene, ".message"), say("problem.input"))
    assert page.find(card(scene, "input")).is_displayed()


def test_a_thousand_scenes_are_listed_page_by_page_and_only_those_in_sight_have_pictures(
    site: Site, page: Page
) -> None:
    many_done(site, 1000)
    page.open()
    page.show("library")
    page.until(lambda: len(page.script(NAMES)) == 30)
    assert page.script(NAMES)[0] == "case 999"
    page.click("#more-jobs")
    page.until(lambda: len(page.script(NAMES)) == 60)
    page.click("#more-jobs")
    page.until(lambda: len(page.script(NAMES)) == 90)
    assert page.script(NAMES)[-1] == "case 910"
    page.find("#search").send_keys("case 12")
    page.until(lambda: page.script(NAMES)[:2] == ["case 912", "case 812"])
    asked = page.script("return performance.getEntriesByType('resource').map((entry) => entry.name)")
    lists = [each for each in asked if re.search(r"/jobs\?", each)]
    assert all("limit=30" in each for each in lists)
    assert len({each for each in asked if "thumbnail" in each}) < 40


def test_a_scene_that_is_found_has_its_light_however_many_are_newer(site: Site, page: Page) -> None:
    old = labelled(site, site.scene(), "liver old")
    many_done(site, 120, 1)
    labelled(site, f"{119:032x}", "liver new")
    page.open()
    page.show("library")
    page.find("#search").send_keys("liver")
    page.until(lambda: page.script(NAMES) == ["liver new", "liver old"])
    page.until(lambda: page.text(card(old, ".trust")))


def test_pictures_out_of_sight_are_let_go_of(site: Site, page: Page) -> None:
    page.script(
        "window.urls = new Set(); for (const [name, work] of [['createObjectURL', 'add'], ['revokeObjectURL', "
        "'delete']]) { const before = URL[name]; URL[name] = (given) => { const url = before.call(URL, given); "
        "urls[work](url ?? given); return url; }; }"
    )
    scene = site.scene()
    page.until(lambda: "blob:" in str(page.script(PICTURES)))
    assert page.script("return urls.size") == 1
    page.click("#library [data-close]")
    page.until(lambda: page.script("return urls.size") == 0)
    page.show("library")
    page.until(lambda: page.script("return urls.size") == 1)
    site.queue.forget(scene)
    site.store.purge(scene)
    page.until(lambda: page.script("return urls.size") == 0)


def test_a_scene_is_saved_in_every_format_of_the_service_at_the_moment_in_view(
    site: Site, page: Page, tmp_path: Path
) -> None:
    page.driver.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    scene = labelled(site, site.scene(), "läsion/3")
    page.press(scene, "View")
    page.until_state("live")
    page.find("#time").send_keys(Keys.END)
    page.press(scene, say("job.save"))
    page.until(lambda: page.find("#download").is_displayed())
    page.until(lambda: page.script("return !!document.querySelector('#download [data-format]')"))
    offered = page.script(
        "return [...document.querySelectorAll('#download [data-format]')].map(({ dataset: d }) => [d.format, d.view])"
    )
    assert {name for name, _ in offered} == {*EXPORT_FORMATS}
    assert {view for name, view in offered if name == "mp4"} == {"", "rock", "orbit", "stereo"}
    assert say("download.moment", seconds=say("time.moment", seconds="1.95")) in page.text("#download")
    page.click("#download [data-format=mesh-stl]")
    page.until(lambda: (tmp_path / "läsion_3-mesh.stl").exists())
    assert not page.find("#download").is_displayed()
    asked = page.script("return performance.getEntriesByType('resource').map((entry) => entry.name)")
    (saved,) = (each for each in asked if f"/scenes/{scene}/export?format=mesh-stl&t=" in each)
    assert float(saved.rpartition("=")[2]) > 0.9
    page.press(scene, say("job.save"))
    page.click("#download [data-view=rock]")
    page.until(lambda: (tmp_path / "läsion_3-rock.mp4").exists())


def test_what_the_installation_cannot_make_is_disabled_and_names_the_extra(site: Site, page: Page) -> None:
    (able,) = site.queue.workers()
    site.queue.announce(able.model_copy(update={"missing_extras": ("mesh",)}))
    scene = site.scene()
    site.queue.announce(able.model_copy(update={"missing_extras": ("mesh",)}))
    time.sleep(ADDRESSES_VALID_S)

    def lacks_meshes() -> bool:
        page.press(scene, say("job.save"))
        page.until(lambda: page.script("return !!document.querySelector('#download [data-format]')"))
        return say("download.needs", what="intrasplat[mesh]") in page.text("#download [data-format=mesh-glb]")

    page.until(lacks_meshes)
    assert not page.find("#download [data-format=mesh-glb]").is_enabled()
    assert page.find("#download [data-format=splat]").is_enabled()
    assert not page.find("#download [data-view=stereo]").is_enabled()
    assert say("download.no_stereo") in page.text("#download [data-view=stereo]")
    lost = "const { exportScene } = await import(new URL('base/api.js', document.scripts[0].src)); "
    ask = f"return exportScene('{scene}', {{ format: 'mesh-stl' }}).catch((error) => error.message)"
    assert page.script(f"return (async () => {{ {lost}{ask} }})()") == say("problem.missing_extra")


def test_a_click_on_the_picture_of_a_scene_opens_it(site: Site, page: Page) -> None:
    scene = site.scene()
    page.script("import(document.scripts[0].src).then(({ jobs }) => jobs.poll())")
    page.click(card(scene, ".card"))
    page.until_state("live")


def test_row_10_a_key_without_scopes_is_offered_nothing_that_would_be_refused(
    tmp_path: Path, driver: webdriver.Chrome
) -> None:
    with site_at(tmp_path / "data", hosts=("127.0.0.1",)) as site:
        _, key = KeyFile(tmp_path / "data").create("local", {KeyScope.VIEW}, "page")
        scene = site.scene()
        failed = site.queued_job()
        page = Page(driver, site.url)
        page.open()
        page.until(lambda: page.find("#key-text").is_displayed())
        page.find("#key-text").send_keys(key, Keys.ENTER)
        page.until(lambda: actions(page, scene) == ["view", "save"])
        assert actions(page, failed) == []
        assert page.faults() == []
        driver.get("about:blank")


def actions(page: Page, job_id: str) -> Any:
    source = "return [...document.querySelectorAll(`[data-job='${arguments[0]}'] button`)].map((b) => b.dataset.action)"
    return page.script(source, job_id)
