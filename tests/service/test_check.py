"""POST /reconstruct/check: what speaks against a clip is told before it is sent, by the rules by which it is judged."""

from __future__ import annotations

import json
from typing import Any

import pytest

from contract.access.keys import KeyScope
from intrasplat.intake.sniff import PNG_MAGIC
from tests.client.local_service import CLIP
from tests.service.under_test import ServiceUnderTest, assert_problem, bearer

HEAD = CLIP.read_bytes()[:16].hex()
RECTIFIED = {
    "model": "rectified",
    "width": 640,
    "height": 512,
    "fx_px": 500.0,
    "fy_px": 500.0,
    "cx_px": 320.0,
    "cy_px": 256.0,
    "baseline_mm": 4.5,
}
INI = """[StereoLeft]
res_x=640
res_y=512
fc_x=500
fc_y=500
cc_x=320
cc_y=256
[StereoRight]
res_x=640
res_y=512
fc_x=500
fc_y=500
cc_x=320
cc_y=256
R_0=1
R_1=0
R_2=0
R_3=0
R_4=1
R_5=0
R_6=0
R_7=0
R_8=1
T_0=-4.5
T_1=0
T_2=0
"""


def video(**changes: Any) -> dict[str, Any]:
    return {"suffix": ".mp4", "size_bytes": 1000, "head": HEAD, **changes}


def calibration(value: object = RECTIFIED, suffix: str = ".json") -> dict[str, Any]:
    text = value if isinstance(value, str) else json.dumps(value)
    return {"suffix": suffix, "size_bytes": len(text), "text": text}


def findings(service: ServiceUnderTest, **described: Any) -> list[tuple[str, str, bool]]:
    answer = service.http.post("/reconstruct/check", json=described)
    assert answer.status_code == 200, answer.text
    return [(each["field"], each["code"], each["refused"]) for each in answer.json()["findings"]]


def test_nothing_speaks_against_a_clip_with_the_calibration_of_its_eyes(service: ServiceUnderTest) -> None:
    fitting = [(1280, 512), (640, 1024)]
    for width, height in fitting:
        clip = video(width=width, height=height, duration_s=2.9)
        assert findings(service, clip=clip, calibration=calibration()) == []
        assert findings(service, clip=clip, calibration=calibration(INI, ".ini")) == []
    eye = video(width=640, height=512, duration_s=3.0)
    assert findings(service, left=eye, right=eye, calibration=calibration()) == []
    assert findings(service, clip=video(), calibration=calibration()) == []  # of a size that the caller cannot tell
    assert service.queue.records() == []


@pytest.mark.parametrize(
    ("part", "changes", "code", "refused"),
    [
        ("clip", {"suffix": ".avi"}, "ending", True),
        ("clip", {"suffix": ".avi", "head": b"RIFF film".hex()}, "ending", True),
        ("calibration", {"suffix": ".pdf", "text": "\0"}, "ending", True),
        ("clip", {"size_bytes": 0}, "empty", True),
        ("clip", {"size_bytes": 10**15}, "too_large", True),
        ("clip", {"head": b"no film at all".hex()}, "kind", True),
        ("clip", {"suffix": ".webm"}, "kind", True),
        ("clip", {"suffix": ".zip"}, "kind", False),
        ("clip", {"width": 8_960, "height": 3_584}, "too_large", False),
        ("clip", {"duration_s": 100_000.0}, "too_long", False),
        ("masks", {"head": b"no film at all".hex()}, "kind", True),
        ("fov_mask", {"head": b"\xff\xd8\xff\xe0 jpeg".hex()}, "kind", True),
        ("fov_mask", {"suffix": ".jpg"}, "ending", True),
        ("calibration", {"size_bytes": 2_000_000, "text": None}, "too_large", True),
        ("calibration", {"text": "<!DOCTYPE x>"}, "calibration_unreadable", True),
        ("calibration", {"text": '{"fx_px": NaN}'}, "calibration_unreadable", True),
        ("calibration", {"text": "{"}, "calibration_unreadable", True),
        ("calibration", {"text": json.dumps(RECTIFIED | {"baseline_mm": 0.0045})}, "calibration_unreadable", True),
        ("calibration", {"text": json.dumps(RECTIFIED | {"width": 600})}, "calibration_size", False),
        ("calibration", {"text": json.dumps(RECTIFIED | {"width": 320, "height": 256})}, "calibration_scaled", False),
        ("calibration", {"text": INI.replace("T_2=0", "")}, "calibration_unreadable", True),
        ("calibration", {"suffix": ".yaml", "text": "%YAML:1.0\n---\nK: 1\n"}, "calibration_unreadable", True),
    ],
)
def test_a_wrong_file_is_told_with_its_field(
    service: ServiceUnderTest, part: str, changes: dict[str, Any], code: str, refused: bool
) -> None:
    described = {"clip": video(width=1280, height=512), "calibration": calibration(), "masks": video()}
    described["fov_mask"] = {"suffix": ".png", "size_bytes": 90, "head": PNG_MAGIC.hex()}
    described[part] = described[part] | changes
    assert [each for each in findings(service, **described) if each[0] == part] == [(part, code, refused)]


def test_a_calibration_of_one_eye_does_not_fit_a_layout_that_was_chosen(service: ServiceUnderTest) -> None:
    described = {"clip": video(width=1280, height=512), "calibration": calibration()}
    assert findings(service, **described, options={"layout": "sbs"}) == []
    assert findings(service, **described, options={"layout": "tb"}) == [("calibration", "calibration_size", False)]


def test_a_video_without_calibration_is_told_and_a_zip_or_an_earlier_clip_is_not(service: ServiceUnderTest) -> None:
    missing, refused = ([("calibration", "calibration_missing", refused)] for refused in (False, True))
    assert findings(service, clip=video()) == missing  # a layout of the worker's own may need none
    assert findings(service, clip=video(), options={"layout": "sbs"}) == refused
    assert findings(service, left=video(), right=video()) == refused
    assert findings(service, clip=video(suffix=".zip", head=b"PK\3\4".hex())) == []
    assert findings(service, masks=video(), clip_of="0" * 32) == []


@pytest.mark.parametrize("changes", [{"width": 320}, {"duration_s": 2.5}])
def test_two_eyes_that_differ_are_told(service: ServiceUnderTest, changes: dict[str, Any]) -> None:
    left = video(width=640, height=512, duration_s=3.0)
    described = {"left": left, "right": left | changes, "calibration": calibration()}
    assert findings(service, **described) == [("right", "eyes_differ", False)]


def test_options_and_what_a_key_may_not_are_told(service: ServiceUnderTest) -> None:
    described = {"clip": video(), "calibration": calibration()}
    assert findings(service, **described, options={"budget": 3}) == [("options.budget", "option", True)]
    high = described | {"options": {"priority": "high"}}
    answer = service.http.post("/reconstruct/check", json=high, headers=bearer(service, "a", {KeyScope.RECONSTRUCT}))
    assert [(each["code"], each["refused"]) for each in answer.json()["findings"]] == [("not_allowed", True)]
    viewer = bearer(service, "a", {KeyScope.VIEW})
    assert_problem(service.http.post("/reconstruct/check", json=described, headers=viewer), 403, "Authorization")


def test_what_is_told_as_refused_is_refused(service: ServiceUnderTest) -> None:
    files = {"clip": ("clip.mp4", b"no film at all")}
    assert findings(service, clip=video(head=b"no film at all".hex()), calibration=calibration())[0][2]
    assert_problem(service.http.post("/reconstruct", files=files), 422, "clip")
    assert_problem(service.upload(options='{"layout": "tb"}'), 422, "calibration")
    broken = {"clip": ("a.mp4", CLIP.read_bytes()), "calibration": ("c.json", b"{")}
    assert_problem(service.http.post("/reconstruct", files=broken), 422, "calibration")


def test_a_description_that_is_none_is_refused(service: ServiceUnderTest) -> None:
    for body, status in (("{", 400), ('{"clip": 3}', 422), ('{"film": {}}', 422), (" " * 4_000_000, 413)):
        answer = service.http.post("/reconstruct/check", content=body, headers={"Content-Type": "application/json"})
        assert answer.status_code == status, body[:20]


def test_many_blanks_in_an_ini_are_read_at_once(service: ServiceUnderTest) -> None:
    text = INI + "a" + " " * 200_000 + "b\n"
    assert findings(service, clip=video(), calibration=calibration(text, ".ini")) == [
        ("calibration", "calibration_unreadable", True)
    ]
