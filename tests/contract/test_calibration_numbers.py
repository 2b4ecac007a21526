"""A calibration with a number that is none is refused when it arrives."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.intake.calibration.text import read_calibration
from contract.intake.limits import ClipLimits
from contract.intake.sniff import check_calibration_file, check_file
from contract.wire.errors import InputError

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


@pytest.mark.parametrize(("text", "given"), [("{}", "None"), ('{"model": "fisheye"}', "fisheye")])
def test_a_calibration_of_no_known_model_is_refused_in_plain_words(text: str, given: str) -> None:
    with pytest.raises(InputError) as refused:
        read_calibration(text)
    assert refused.value.problem == f"model is {given}, not rectified or raw."
