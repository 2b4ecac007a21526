"""Calibrations as people write them: each way means the same cameras, or is refused with the cause and the line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from intrasplat.clip.calibration import load_calibration
from intrasplat.errors import InputError
from intrasplat.intake.calibration.opencv import look_at_calibration
from intrasplat.intake.calibration.types import RawCalibration, StereoCalibration, parse_calibration
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.sniff import check_file
from tests.intrasplat.clip.test_calibration import (
    HEIGHT,
    LEFT_D,
    LEFT_K,
    RECTIFIED,
    RIGHT_D,
    RIGHT_K,
    ROTATION,
    TRANSLATION_MM,
    WIDTH,
    ini_text,
    load,
    raw_calibration,
    write,
    write_opencv,
)

VALUES = dict(
    zip(("M1", "D1", "M2", "D2", "R", "T"), (LEFT_K, LEFT_D, RIGHT_K, RIGHT_D, ROTATION, TRANSLATION_MM), strict=True)
)
LISTS = {name: value.tolist() for name, value in VALUES.items()} | {"image_width": WIDTH, "image_height": HEIGHT}
SCARED = {
    "camera-pose": np.eye(4).tolist(),
    "camera-calibration": {
        "KL": LISTS["M1"], "KR": LISTS["M2"], "DL": [LISTS["D1"]], "DR": [LISTS["D2"]],
        "R": LISTS["R"], "T": [[each] for each in LISTS["T"]],
    },
}  # fmt: skip


def renamed(names: str) -> dict[str, Any]:
    """LISTS under other names, in the order of VALUES."""
    given = dict(zip(names.split(), (value.tolist() for value in VALUES.values()), strict=True))
    return given | {"imageSize": [WIDTH, HEIGHT]}


def yaml_of(tmp_path: Path, **changes: Any) -> str:
    """The calibration as OpenCV writes it."""
    return write_opencv(tmp_path / "c.yaml", image_width=WIDTH, image_height=HEIGHT, **changes).read_text()


def block(values: dict[str, Any]) -> str:
    """YAML as PyYAML writes it: a line with a dash for each number."""
    lines = []
    for name, value in values.items():
        rows = value if isinstance(value, list) else [value]
        lines.append(f"{name}:" if isinstance(value, list) else f"{name}: {value}")
        for row in rows if isinstance(value, list) else []:
            cells = row if isinstance(row, list) else [row]
            first = "- - " if isinstance(row, list) else "- "
            lines += [f"{first if i == 0 else '  - '}{cell}" for i, cell in enumerate(cells)]
    return "\n".join(lines) + "\n"


def commented(text: str) -> str:
    """JSON with a comment above, and one at the end of each of its lines."""
    return "// by hand\n" + text.replace(",\n", ", # so\n")


TEXTS = {
    "lists in JSON": json.dumps(LISTS),
    "columns of lists in JSON": json.dumps(LISTS | {"D1": [LISTS["D1"]], "T": [[each] for each in LISTS["T"]]}),
    "names of OpenCV's functions": json.dumps(
        renamed("cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2 R T"), indent=1
    ),
    "left and right behind": json.dumps(renamed("K_left D_left K_right D_right R T")),
    "an eye each": json.dumps(
        {"left": {"K": LISTS["M1"], "dist": LISTS["D1"]}, "right": {"K": LISTS["M2"], "dist": LISTS["D2"]}}
        | {name: LISTS[name] for name in ("R", "T", "image_width", "image_height")}
    ),
    "comments in JSON": commented(json.dumps(LISTS, indent=1)),
    "lists in YAML": "".join(f"{name}: {value}\n" for name, value in LISTS.items()),
    "numbers line by line": block(LISTS),
    "maps in YAML": "".join(
        f"{name}: {{rows: {np.atleast_2d(value).shape[0]}, cols: {np.atleast_2d(value).shape[1]}, dt: d, "
        f"data: {np.ravel(value).tolist()}}} # {name}\n"
        for name, value in VALUES.items()
    )
    + f"imageSize: [{WIDTH}, {HEIGHT}]\n",
    "single numbers": json.dumps(
        {
            side: {"fx": k[0][0], "fy": k[1][1], "cx": str(k[0][2]), "cy": k[1][2]}
            | dict(zip(("k1", "k2", "p1", "p2", "k3"), d, strict=True))
            for side, k, d in (("Camera 1", LISTS["M1"], LISTS["D1"]), ("right_eye", LISTS["M2"], LISTS["D2"]))
        }
        | {name: LISTS[name] for name in ("R", "T", "image_width", "image_height")}
    ),
    "a comma behind the last": json.dumps(LISTS, indent=1)[:-2] + ",\n}",
    "nested YAML": f"left:\n  K: {LISTS['M1']}\n  D: {LISTS['D1']}\nright:\n  K: {LISTS['M2']}\n  D: {LISTS['D2']}\n"
    f"stereo:\n  R: {LISTS['R']}\n  T: {LISTS['T']}\nimage_size: [{WIDTH}, {HEIGHT}]\n",
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_lists_and_names_as_people_write_them_mean_the_same_calibration(tmp_path: Path, text: str) -> None:
    assert load(write(tmp_path / "c", text)) == raw_calibration()


def test_the_json_of_a_scared_frame_is_read_at_the_clips_size(tmp_path: Path) -> None:
    read = load(write(tmp_path / "frame_data.json", json.dumps(SCARED)))
    assert isinstance(read, RawCalibration)
    assert (read.left, read.right) == (raw_calibration().left, raw_calibration().right)
    assert read.right_from_left_translation_mm == pytest.approx(TRANSLATION_MM)
    assert any("no image size" in note for note in read.assumptions)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "# left and right\n" + text,
        lambda text: "\n\n# above\n" + text.replace("rows: 3", "rows: 3  # three"),
        lambda text: text.replace("   ", "\t"),
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("dt: d", "dt: f").replace("!!opencv-matrix", ""),
        lambda text: text.replace("   dt: d", "   unit: px"),
        lambda text: "\n".join(line.strip() for line in text.splitlines()),
    ],
    ids=["above %YAML", "behind values", "tabs", "CRLF", "no tags", "keys between", "no indent"],
)
def test_comments_and_blanks_do_not_count(tmp_path: Path, change: Any) -> None:
    assert load(write(tmp_path / "c.yml", change(yaml_of(tmp_path)))) == raw_calibration()


@pytest.mark.parametrize("encoding", ["latin-1", "cp1252", "utf-16", "utf-16-be", "utf-8-sig"])
@pytest.mark.parametrize("form", ["yaml", "json", "ini"])
def test_the_encodings_of_editors_are_read_on_arrival_and_by_decoding(tmp_path: Path, encoding: str, form: str) -> None:
    text = {"yaml": yaml_of(tmp_path), "json": json.dumps(LISTS, indent=1), "ini": ini_text()}[form]
    text += {"yaml": "# für Gerät 2\n", "json": "\n// für Gerät 2", "ini": "\n; für Gerät 2\n"}[form]
    path = tmp_path / f"given.{form}"
    path.write_bytes((b"\xfe\xff" if encoding == "utf-16-be" else b"") + text.encode(encoding))
    check_file(path, "calibration", ClipLimits())
    assert load_calibration(path, eye_width=WIDTH, eye_height=HEIGHT) == raw_calibration()


FISHEYE = {
    "a model in YAML": lambda text: text + "distortion_model: fisheye\n",
    "Kannala-Brandt": lambda text: text + 'camera_model: "kannala_brandt"\n',
    "equidistant in JSON": lambda text: json.dumps(LISTS | {"distortion_model": "equidistant"}),
    "a flag": lambda text: json.dumps(LISTS | {"fisheye": True}, indent=1),
    "its coefficients by eye": lambda text: json.dumps(
        {side: dict.fromkeys(("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), 1.0) for side in ("left", "right")}
        | LISTS
    ),
    "Kalibr's": lambda text: "cam0:\n  distortion_model: equidistant\n  intrinsics: [90, 90, 48, 40]\n",
    "its coefficients": lambda text: text + "k1: 0.1\nk2: 0.2\nk3: 0.1\nk4: 0.0\n",
    "in an ini": lambda text: ini_text() + "\nmodel=fisheye\n",
}


@pytest.mark.parametrize("make", FISHEYE.values(), ids=FISHEYE)
def test_fisheye_models_are_refused_by_name(tmp_path: Path, make: Any) -> None:
    path = write(tmp_path / "c", make(yaml_of(tmp_path)))
    with pytest.raises(InputError, match="it is of a fisheye model") as caught:
        load(path)
    assert "ndistort the frames" in caught.value.remedy
    with pytest.raises(InputError, match="it is of a fisheye model"):
        look_at_calibration(path.read_text())


@pytest.mark.parametrize("line", ["fisheye: 0\n", "is_fisheye: false\n", "# no fisheye lens\n"])
def test_a_file_that_denies_a_fisheye_lens_is_read(tmp_path: Path, line: str) -> None:
    assert load(write(tmp_path / "c.yml", yaml_of(tmp_path) + line)) == raw_calibration()


@pytest.mark.parametrize(
    ("factor", "unit", "named_mm"),
    [(0.1, "centimetres", "4.2"), (0.001, "metres", "4.2"), (1000.0, "micrometres", "4.2")],
)
@pytest.mark.parametrize("form", ["yaml", "json", "ini", "rectified"])
def test_a_baseline_in_another_unit_names_the_unit_and_its_mm(
    tmp_path: Path, factor: float, unit: str, named_mm: str, form: str
) -> None:
    t = (TRANSLATION_MM * factor).tolist()
    texts = {
        "yaml": yaml_of(tmp_path, T=TRANSLATION_MM * factor),
        "json": json.dumps(LISTS | {"T": t}),
        "ini": ini_text(**{f"T_{i}": str(each) for i, each in enumerate(t)}),
        "rectified": json.dumps(RECTIFIED | {"baseline_mm": 4.2 * factor}),
    }
    with pytest.raises(InputError, match=f"it is probably in {unit}, which would be {named_mm}") as caught:
        load(write(tmp_path / "c", texts[form]))
    assert (caught.value.field, "in mm" in caught.value.remedy) == ("calibration", True)


@pytest.mark.parametrize("baseline_mm", [0.6, 1.2])
def test_a_baseline_of_wide_eyes_in_centimetres_is_refused(baseline_mm: float) -> None:
    with pytest.raises(InputError, match="probably in centimetres"):
        look_at_calibration(json.dumps(RECTIFIED | {"baseline_mm": baseline_mm}))


@pytest.mark.parametrize("baseline_mm", [2.0, 4.3, 5.5, 12.0, 15.0])
def test_baselines_of_endoscopes_are_accepted(baseline_mm: float) -> None:
    read: StereoCalibration | None = look_at_calibration(json.dumps(RECTIFIED | {"baseline_mm": baseline_mm}))
    assert read == parse_calibration(RECTIFIED | {"baseline_mm": baseline_mm})


WRONG = {
    "a decimal comma": (lambda text: text.replace("M1: [[130.0", "M1: [[130,5"), "M1 in line 1 has 10 numbers, not 9"),
    "a word": (lambda text: text.replace("M2: [[131.0", "M2: [[f"), "M2 in line 3 holds 'f', which is not a number"),
    "cut in a list": (lambda text: text[: text.index("T:") + 9], "cut short"),
    "too few in a matrix": (lambda text: text + "imageSize: {rows: 1, cols: 2, data: [5]}\n", "announces 1 x 2"),
}


@pytest.mark.parametrize(("change", "problem"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_names_the_file_the_key_and_the_line(tmp_path: Path, change: Any, problem: str) -> None:
    text = "".join(f"{name}: {value.tolist()}\n" for name, value in VALUES.items())
    with pytest.raises(InputError, match=problem) as caught:
        load(write(tmp_path / "given.yml", change(text)))
    assert caught.value.problem.startswith("given.yml: ")


@pytest.mark.parametrize("unit", ['"\\"', "a ", "a: ", "'\"", "#", "// ", "fisheye", "[1", "-", "\t", '"k": '])
def test_no_text_keeps_who_reads_it(unit: str) -> None:
    for head in ("M1: [1]\n", '{"M1": '):
        with pytest.raises(InputError):
            look_at_calibration(head + unit * (60_000 // len(unit)))
