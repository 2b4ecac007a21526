"""The report in two layers: plain sentences in mm and seconds first, codes and all figures under "details"."""

from __future__ import annotations

from typing import Literal

import pytest

from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import CameraPoses, FieldOfView, Masks, Report
from tests.client.page import REPORT_OF_THE_PAGE, Page, Site
from tests.client.test_theatre_in_browser import SIZES, screen_of
from tests.client.words import say

LINES = "return [...document.querySelectorAll(`#report .${arguments[0]} li`)].map((each) => each.textContent)"
NAMES = "return [...document.querySelectorAll('#report .everything th')].map((each) => each.textContent)"
BOXES = """
return [...document.querySelectorAll("#curve .tick")].map((each) => {
  const { left, top, right, bottom } = each.getBoundingClientRect();
  const scale = document.querySelector("#curve").getScreenCTM().a;
  return [left, top, right, bottom, parseFloat(getComputedStyle(each).fontSize) * scale];
});
"""
GOOD = REPORT_OF_THE_PAGE.model_copy(
    update={
        "warnings": (),
        "frame_times_s": tuple(frame / 30 for frame in range(88)),
        "frame_count": 88,
        "eyes": "both",
        "masks": Masks(source="found", share=0.123, sure=0.9),
        "poses": CameraPoses(source="estimated", path_mm=12.3),
    }
)


def show(site: Site, page: Page, report: Report) -> str:
    scene = site.scene()
    site.store.add_scores("worker-1", scene, 1, report)
    page.press(scene, "View")
    page.show("report-drawer")
    page.until_text("#report", say("report.trusted"))
    return scene


def test_the_first_layer_says_in_mm_and_seconds_what_can_be_trusted(site: Site, page: Page) -> None:
    show(site, page, GOOD)
    assert page.script(LINES, "trusted") == [
        say("report.clip_both", frames="88", seconds="2.9"),
        say("report.depth", mm="0.8"),
        say("report.covered", share="97 %"),
        say("report.masks", share="12 %"),
        say("report.camera_estimated", mm="12"),
    ]
    assert page.script(LINES, "reasons") == []
    assert say("report.tested_beside") in page.text("#report")
    assert "dB" not in page.text("#report")


@pytest.mark.parametrize(
    ("source", "key"), [("found", "report.field_of_view"), ("given", "report.field_of_view_given")]
)
def test_the_field_of_view_is_named_as_found_or_given(
    site: Site, page: Page, source: Literal["found", "given"], key: str
) -> None:
    field = FieldOfView(source=source, share=0.72, shape="round")
    show(site, page, GOOD.model_copy(update={"field_of_view": field}))
    assert say(key, share="72 %") in page.script(LINES, "trusted")


@pytest.mark.parametrize(
    ("source", "codes"),
    [
        ("fixed", ["camera_or_tissue"]),
        ("fixed", ["poses_unsure"]),
        ("fixed", ["poses_unsure", "camera_or_tissue"]),
        ("estimated", ["camera_or_tissue"]),
    ],
)
def test_a_doubt_about_the_endoscopes_movement_and_what_was_taken_for_it_are_one_sentence(
    site: Site, page: Page, source: Literal["fixed", "estimated"], codes: list[str]
) -> None:
    poses = CameraPoses(source=source, path_mm=12.3)
    warnings = site.painter.warnings = [Notice.warning(NoticeCode(code), "GET /x") for code in codes]
    show(site, page, GOOD.model_copy(update={"poses": poses, "warnings": tuple(warnings)}))
    assert page.script(LINES, "reasons") == [say(f"report.camera_{source}_or_tissue", mm="12")]
    assert say(f"report.camera_{source}", mm="12") not in page.script(LINES, "trusted")
    page.until(lambda: page.text("#picture-warning") == say(f"report.camera_{source}_or_tissue", mm="12"))


def test_only_the_worst_reasons_are_in_the_first_layer_and_all_are_in_the_second(site: Site, page: Page) -> None:
    codes = [NoticeCode.BLOOD, NoticeCode.VEILED, NoticeCode.HOLES, NoticeCode.EYES_DISAGREE]
    notices = tuple(Notice.warning(code, f"GET /x {code}") for code in codes)
    show(site, page, GOOD.model_copy(update={"warnings": notices, "depth_agreement_mm": None, "psnr_right_db": None}))
    first = page.script(LINES, "reasons")
    assert first == [say(f"notice.{code}") for code in ("eyes_disagree", "blood", "veiled")]
    assert say("report.more_reasons", count=1) in page.text("#report")
    assert say("report.no_depth") in page.text("#report")
    assert say("report.tested_here") in page.text("#report")
    page.click("#report .figures summary")
    for code in codes:
        page.until_text("#report .figures", f"GET /x {code}")
        assert code in page.text("#report .figures")
    page.click("#report .figures .figures, #report .figures details summary")
    page.until_text("#report .everything", "31.2")
    named = page.script(NAMES)
    assert {"psnr_tissue_db", "seconds.t_train_s", "poses.path_mm", "masks.share", "scene_bytes"} <= set(named)


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("apart_db", [0.05, 1.5])
def test_row_11_the_curve_is_readable_and_no_two_of_its_texts_overlap(
    site: Site, page: Page, width: int, height: int, apart_db: float
) -> None:
    with screen_of(page, width, height):
        near = {"baseline_blend_db": 31.0, "baseline_flow_db": 31.0 + apart_db}
        show(site, page, GOOD.model_copy(update=near))
        page.until(lambda: page.script("return document.querySelectorAll('#curve .baseline').length") == 2)
        boxes = page.script(BOXES)
        assert len(boxes) == 6
        assert min(box[4] for box in boxes) >= 12.0
        left, right = page.script(
            "const { left, right } = document.querySelector('#curve').getBoundingClientRect(); return [left, right]"
        )
        for index, (a_left, a_top, a_right, a_bottom, size) in enumerate(boxes):
            assert left - 1 <= a_left < a_right <= right + 1
            slack = 0.2 * size  # a line's box is higher than its letters
            for b_left, b_top, b_right, b_bottom, _ in boxes[index + 1 :]:
                apart_x = a_right <= b_left or b_right <= a_left
                assert apart_x or a_bottom - slack <= b_top or b_bottom - slack <= a_top
