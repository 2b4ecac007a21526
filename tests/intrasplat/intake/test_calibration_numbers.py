"""A calibration with a number that is none is refused when it arrives."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from intrasplat.errors import InputError
from intrasplat.intake.calibration.text import read_calibration
from intrasplat.intake.limits import MAX_CALIBRATION_BYTES, ClipLimits
from intrasplat.intake.sniff import check_calibration_file, check_file

YAML = "%YAML:1.0\nM1: !!opencv-matrix\n   rows: 1\n   data: [ 570., {}, 1. ]\n"
XML = "<?xml version='1.0'?><opencv_storage><T><data>-4.1 {} 0.1</data></T></opencv_storage>"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("c.json", '{"fx_px": NaN}'),
        ("c.json", '{"fx_px": -Infinity}'),
        ("c.yaml", YAML.format(".Nan")),
        ("c.yaml", YAML.format("-.Inf")),
        ("c.xml", XML.format("nan")),
        ("c.ini", "[StereoLeft]\nfc_x=nan\n"),
    ],
)
def test_a_calibration_with_what_is_no_number_is_refused_at_upload(tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match="not a finite number") as refused:
        check_file(path, "calibration", ClipLimits())
    assert refused.value.field == "calibration"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("c.json", '{"model": "rectified", "info": "inf"}'),
        ("c.yaml", "# nan where unknown\n" + YAML.format("0.")),
        ("c.xml", XML.format("0.0") + "<!-- nan -->"),
        ("c.ini", "; inf\n[StereoLeft]\nfc_x=570\n"),
        ("c.yaml", YAML.format("0.") + "nan_count: 0\ninf: 1\n"),
    ],
)
def test_words_and_comments_are_no_numbers(name: str, text: str) -> None:
    check_calibration_file(text, "calibration", name)


@pytest.mark.parametrize(("text", "said"), [("{}", "is not said:"), ('{"model": "fisheye"}', "is fisheye, not")])
def test_a_calibration_of_no_known_model_is_refused_in_plain_words(text: str, said: str) -> None:
    with pytest.raises(InputError) as refused:
        read_calibration(text)
    assert refused.value.problem == f"model {said} rectified or raw."


HANGS_AFTER_S = 60.0
LOOK = (
    "import sys; from intrasplat.intake.calibration.opencv import look_at_calibration as look; look(sys.stdin.read())"
)


CHECK = "import sys; from intrasplat.intake.sniff import check_calibration_file as c; c(sys.stdin.read(), 'f', 'it')"


def test_many_comments_that_do_not_end_keep_nobody() -> None:
    text = "<!--" * (MAX_CALIBRATION_BYTES // 4)
    subprocess.run([sys.executable, "-c", CHECK], input=text, check=True, text=True, timeout=HANGS_AFTER_S)


def test_a_number_that_is_none_is_told_with_its_line_whatever_ends_the_lines() -> None:
    for end in ("\n", "\r\n", "\r"):
        with pytest.raises(InputError, match="holds nan, which is not a finite number, in line 3"):
            check_calibration_file(end.join(("# inf", "<!-- nan --> a: 1", "b: nan")), "calibration", "it")


@pytest.mark.parametrize(
    ("again", "is_cut"), [(":!", False), (":[", True), (": !!a", False), ("::{", True), (":[}", True)]
)
def test_no_text_keeps_who_looks_at_it(again: str, is_cut: bool) -> None:
    k = "[90, 0, 48, 0, 90, 40, 0, 0, 1]"
    head, end = f"%YAML:1.0\nM1: {k}\nM2: {k}\nR: [0, 0, 0]\nT: [-4, 0, 0]\n", "" if is_cut else "]}"
    text = head + again * ((MAX_CALIBRATION_BYTES - 100) // len(again)) + end
    looked = subprocess.run(  # of a process of its own: a pattern that does not come to an end hears no signal
        [sys.executable, "-c", LOOK], input=text, capture_output=True, text=True, timeout=HANGS_AFTER_S
    )
    assert ("was cut short" in looked.stderr) is is_cut
    assert looked.returncode == int(is_cut)


def test_a_number_beyond_all_floats_is_refused_at_upload(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    matrices = {"M1": [10**400], "M2": [1], "D1": [0], "D2": [0], "R": [1], "T": [4, 0, 0]}
    path.write_text(json.dumps(matrices))
    with pytest.raises(InputError) as refused:
        check_file(path, "calibration", ClipLimits())
    assert refused.value.field == "calibration"
