"""Calibration files of every kind, and rectification: values survive reading, and every wrong file is refused."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip.calibration import load_calibration, rectify
from intrasplat.clip.types import StereoClip
from intrasplat.errors import InputError
from intrasplat.intake.calibration.opencv import look_at_calibration
from intrasplat.intake.calibration.types import (
    RawCalibration,
    RectifiedCalibration,
    StereoCalibration,
    calibration_schema,
    parse_calibration,
)

CONVENTIONS = Path(__file__).parents[3] / "docs/conventions.md"
WIDTH, HEIGHT = 160, 128
RECTIFIED: dict[str, Any] = {
    "model": "rectified",
    "width": WIDTH,
    "height": HEIGHT,
    "fx_px": 140.0,
    "fy_px": 141.0,
    "cx_px": 78.0,
    "cy_px": 62.0,
    "baseline_mm": 4.3,
    "disparity_offset_px": 0.25,
}
LEFT_K = np.array([[130.0, 0.0, 75.0], [0.0, 130.5, 65.0], [0.0, 0.0, 1.0]])
RIGHT_K = np.array([[131.0, 0.0, 86.0], [0.0, 130.0, 64.0], [0.0, 0.0, 1.0]])
LEFT_D = np.array([-0.05, 0.02, 0.001, -0.002, 0.003])
RIGHT_D = np.array([-0.04, 0.01, -0.001, 0.001, 0.002])
ROTATION: NDArray[np.float64] = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
TRANSLATION_MM = np.array([-4.2, 0.1, 0.05])


def raw_calibration(**changes: Any) -> RawCalibration:
    def eye(k: NDArray[np.float64], d: NDArray[np.float64]) -> dict[str, Any]:
        return {"fx_px": k[0, 0], "fy_px": k[1, 1], "cx_px": k[0, 2], "cy_px": k[1, 2], "distortion": d.tolist()}

    value = {
        "model": "raw",
        "width": WIDTH,
        "height": HEIGHT,
        "left": eye(LEFT_K, LEFT_D),
        "right": eye(RIGHT_K, RIGHT_D),
        "right_from_left_rotation": ROTATION.tolist(),
        "right_from_left_translation_mm": TRANSLATION_MM.tolist(),
    }
    calibration = parse_calibration(value | changes)
    assert isinstance(calibration, RawCalibration)
    return calibration


def load(path: Path, width: int = WIDTH, height: int = HEIGHT) -> StereoCalibration:
    read = load_calibration(path, eye_width=width, eye_height=height)
    look_at_calibration(path.read_text())  # what can be read is not refused on arrival
    return read


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def write_opencv(path: Path, names: str = "M1 D1 M2 D2 R T", **changes: Any) -> Path:
    values: dict[str, Any] = dict(
        zip(names.split(), (LEFT_K, LEFT_D, RIGHT_K, RIGHT_D, ROTATION, TRANSLATION_MM), strict=True)
    )
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (values | changes).items():
        if value is not None:
            storage.write(name, value)
    storage.release()
    return path


def ini_text(**changes_of_the_right_eye: str) -> str:
    eyes = {
        "StereoLeft": (LEFT_K, LEFT_D, np.eye(3), np.zeros(3), {}),
        "StereoRight": (RIGHT_K, RIGHT_D, ROTATION, TRANSLATION_MM, changes_of_the_right_eye),
    }
    lines: list[str] = []
    for section, (k, distortion, rotation, translation_mm, changes) in eyes.items():
        values: dict[str, Any] = {"res_x": WIDTH, "res_y": HEIGHT}
        values |= {"fc_x": k[0, 0], "fc_y": k[1, 1], "cc_x": k[0, 2], "cc_y": k[1, 2]}
        values |= {f"kc_{i}": distortion[i] for i in range(5)}
        values |= {f"R_{i}": rotation.ravel()[i] for i in range(9)}
        values |= {f"T_{i}": translation_mm[i] for i in range(3)}
        lines += [f"[{section}]", *(f"{key}={value!s}" for key, value in (values | changes).items())]
    return "\n".join(lines)


def clip_of(left: NDArray[np.uint8], right: NDArray[np.uint8], tissue: NDArray[np.bool_] | None = None) -> StereoClip:
    height, width = left.shape[:2]
    return StereoClip(1, height, width, lambda: iter([(left, right)]), tissue, np.zeros(1))


def test_our_json_of_both_kinds_survives_writing_and_reading(tmp_path: Path) -> None:
    for calibration in (parse_calibration(RECTIFIED), raw_calibration()):
        assert load(write(tmp_path / "c.json", calibration.model_dump_json())) == calibration


def test_the_json_schema_names_both_kinds_and_their_units() -> None:
    text = json.dumps(calibration_schema())
    for name in ("rectified", "raw", "baseline_mm", "fx_px", "right_from_left_translation_mm"):
        assert f'"{name}"' in text


def test_the_module_prints_the_schema() -> None:
    command = [sys.executable, "-m", "intrasplat.intake.calibration.types"]
    printed = subprocess.run(command, cwd=CONVENTIONS.parents[1], capture_output=True, text=True, check=True)
    assert json.loads(printed.stdout) == json.loads(json.dumps(calibration_schema()))


def test_the_conventions_page_shows_both_kinds_as_they_are_read(tmp_path: Path) -> None:
    """Every key, and values that pass all checks up to rectification."""
    blocks = re.findall(r"^```json\n(.*?)^```", CONVENTIONS.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    examples = [json.loads(block) for block in blocks]
    parsed = [parse_calibration(example) for example in examples]
    assert [type(each) for each in parsed] == [RectifiedCalibration, RawCalibration]
    for block, example, calibration in zip(blocks, examples, parsed, strict=True):
        assert set(example) == set(type(calibration).model_fields) - {"assumptions", "scaled_from"}
        width, height = calibration.width, calibration.height
        assert load(write(tmp_path / "c.json", block), width, height) == calibration
        image = np.zeros((height, width, 3), np.uint8)
        assert rectify(clip_of(image, image), calibration).warnings == ()


def test_a_clip_says_whether_its_calibration_rectified_it() -> None:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    said = [
        rectify(clip_of(image, image), each).assumptions[-1].text
        for each in (parse_calibration(RECTIFIED), raw_calibration())
    ]
    assert said == [
        "frames: rectified already, as the calibration says",
        "frames: as recorded, rectified by the calibration",
    ]


def test_opencv_yaml_xml_and_json_and_the_ini_all_mean_the_same_calibration(tmp_path: Path) -> None:
    sized: dict[str, Any] = {"image_width": WIDTH, "image_height": HEIGHT}
    files = [write_opencv(tmp_path / f"c.{suffix}", **sized) for suffix in ("yaml", "xml", "json")]
    files.append(write(tmp_path / "c.ini", ini_text()))
    for path in files:
        assert load(path) == raw_calibration(), path.name


@pytest.mark.parametrize(
    "names",
    [
        "camera_matrix_1 dist_coeffs_1 camera_matrix_2 dist_coeffs_2 R T",
        "K1 D1 K2 D2 R T",
        "cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2 R T",
        "camera_matrix_left dist_coeffs_left camera_matrix_right dist_coeffs_right rotation_matrix translation_vector",
    ],
)
def test_opencv_keys_are_known_in_their_common_spellings(tmp_path: Path, names: str) -> None:
    read = load(write_opencv(tmp_path / "c.yaml", names, image_width=WIDTH, image_height=HEIGHT))
    assert read == raw_calibration()


def test_the_format_is_told_by_content_not_by_the_files_name(tmp_path: Path) -> None:
    text = write_opencv(tmp_path / "c.yaml").read_text()
    read = load(write(tmp_path / "calibration", text.removeprefix("%YAML:1.0").lstrip()))
    assert isinstance(read, RawCalibration)
    assert read.left == raw_calibration().left


def test_a_yaml_without_image_size_is_taken_as_the_clips_and_says_so(tmp_path: Path) -> None:
    read = load(write_opencv(tmp_path / "c.yaml"))
    assert (read.width, read.height) == (WIDTH, HEIGHT)
    assert any("no image size" in note for note in read.assumptions)


def test_a_rotation_vector_means_its_rotation(tmp_path: Path) -> None:
    read = load(write_opencv(tmp_path / "c.yaml", R=cv2.Rodrigues(ROTATION)[0]))
    assert isinstance(read, RawCalibration)
    assert np.allclose(read.right_from_left_rotation, ROTATION, atol=1e-12)


def test_a_uniformly_scaled_calibration_sees_the_same_rays_and_says_so(tmp_path: Path) -> None:
    half = load(write(tmp_path / "c.json", json.dumps(RECTIFIED)), WIDTH // 2, HEIGHT // 2)
    assert isinstance(half, RectifiedCalibration)
    assert (half.fx_px, half.cx_px, half.disparity_offset_px) == (70.0, 39.0, 0.125)
    image = np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8)
    (warning,) = rectify(clip_of(image, image), half).warnings
    assert (warning.code, "160x128" in warning.text, "80x64" in warning.text) == ("calibration_scaled", True, True)
    raw = load(write(tmp_path / "r.json", raw_calibration().model_dump_json()), WIDTH // 2, HEIGHT // 2)
    assert isinstance(raw, RawCalibration)
    # OpenCV counts from pixel centres: the image's left edge is -0.5 in both grids.
    assert raw.left.cx_px + 0.5 == pytest.approx((LEFT_K[0, 2] + 0.5) / 2)


WRONG_JSON: dict[str, tuple[dict[str, Any], str]] = {
    "another aspect": ({"height": 100}, "not one uniform scale"),
    "a million times the size": ({"width": WIDTH * 10**6, "height": HEIGHT * 10**6}, "more than 8 times apart"),
    "zero baseline": ({"baseline_mm": 0.0}, "baseline_mm"),
    "negative focal length": ({"fx_px": -140.0}, "fx_px"),
    "not a number": ({"cx_px": float("nan")}, "cx_px"),
    "unknown key": ({"focal": 3.0}, "focal"),
    "unknown kind": ({"model": "fisheye"}, "fisheye"),
    "baseline in metres": ({"baseline_mm": 0.0043}, "metres"),
    "baseline too long": ({"baseline_mm": 4300.0}, "micrometres"),
}


@pytest.mark.parametrize(("changes", "problem"), WRONG_JSON.values(), ids=WRONG_JSON.keys())
def test_a_wrong_rectified_calibration_is_refused_with_its_cause(
    tmp_path: Path, changes: dict[str, Any], problem: str
) -> None:
    path = write(tmp_path / "c.json", json.dumps(RECTIFIED | changes))
    with pytest.raises(InputError, match=problem) as error:
        load(path)
    assert error.value.field == "calibration"
    assert error.value.remedy


WRONG_OPENCV: dict[str, tuple[dict[str, Any], str]] = {
    "no right matrix": ({"M2": None}, "M2"),
    "no translation": ({"T": None}, "no T"),
    "matrix of another shape": ({"M1": np.eye(2)}, "4 numbers"),
    "rotation that scales": ({"R": ROTATION * 1.1}, "not a rotation"),
    "mirrored rotation": ({"R": np.diag([1.0, 1.0, -1.0])}, "not a rotation"),
    "rotation with a nan": ({"R": np.full((3, 3), np.nan)}, "finite"),
    "zero baseline": ({"T": np.zeros(3)}, "baseline is 0"),
    "baseline in metres": ({"T": TRANSLATION_MM / 1000}, "metres"),
    "eyes above each other": ({"T": TRANSLATION_MM[[1, 0, 2]]}, "does not point along x"),
    "eyes swapped": ({"T": -TRANSLATION_MM}, "to the left"),
    "principal point of a larger image": ({"M1": LEFT_K * [[1, 1, 3], [1, 1, 3], [1, 1, 1]]}, "middle half"),
    "odd number of distortion coefficients": ({"D1": np.zeros(7)}, "7 coefficients"),
    "negative size": ({"image_width": -1, "image_height": 4}, "positive"),
}


@pytest.mark.parametrize(("changes", "problem"), WRONG_OPENCV.values(), ids=WRONG_OPENCV.keys())
def test_a_wrong_opencv_calibration_is_refused_with_its_cause(
    tmp_path: Path, changes: dict[str, Any], problem: str
) -> None:
    with pytest.raises(InputError, match=problem) as error:
        load(write_opencv(tmp_path / "c.yaml", **changes))
    assert error.value.field == "calibration"


BROKEN = ("", "{", "[1, 2]", "hello", '{"model": "raw"}', "[StereoLeft]\nres_x=3\n", "%YAML:1.0\n---\nM1: [1, 2\n")


@pytest.mark.parametrize("text", [*BROKEN, "<?xml?><a>"])
def test_a_file_that_is_no_calibration_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError) as error:
        load(write(tmp_path / "c", text))
    assert error.value.field == "calibration"


def test_json_with_endless_digits_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not valid JSON"):
        load(write(tmp_path / "c.json", '{"width": ' + "9" * 5000 + "}"))


def test_a_missing_a_binary_and_a_huge_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x80" * 10)
    (tmp_path / "huge").write_bytes(b" " * 2_000_000)
    for name in ("missing", "binary", "huge"):
        with pytest.raises(InputError) as error:
            load(tmp_path / name)
        assert error.value.field == "calibration"


@pytest.mark.parametrize("changes", [{"R_3": "nan"}, {"T_0": "wide"}, {"res_x": "80"}, {"R_0": "2.0"}])
def test_a_wrong_ini_is_refused(tmp_path: Path, changes: dict[str, str]) -> None:
    with pytest.raises(InputError) as error:
        load(write(tmp_path / "c.ini", ini_text(**changes)))
    assert error.value.field == "calibration"


def test_rectified_clips_pass_through_with_the_files_camera() -> None:
    left = np.full((HEIGHT, WIDTH, 3), 7, np.uint8)
    clip = rectify(clip_of(left, left), parse_calibration(RECTIFIED))
    assert (clip.intrinsics.fx, clip.intrinsics.cx, clip.intrinsics.cy) == (140.0, 78.0, 62.0)
    assert (clip.baseline_mm, clip.disparity_offset_px) == (4.3, 0.25)
    assert next(iter(clip.pairs()))[0] is left
    assert clip.tissue.shape == (1, HEIGHT, WIDTH)
    assert clip.tissue.all()


def test_a_calibration_for_another_size_cannot_rectify_a_clip() -> None:
    image = np.zeros((HEIGHT, WIDTH + 2, 3), np.uint8)
    with pytest.raises(InputError, match="160x128"):
        rectify(clip_of(image, image), parse_calibration(RECTIFIED))


def project(points_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where the raw eyes see points [M, 3] of the left camera, in OpenCV's pixels."""
    zero = np.zeros(3)
    left = cv2.projectPoints(points_mm, zero, zero, LEFT_K, LEFT_D)[0][:, 0]
    right = cv2.projectPoints(points_mm, cv2.Rodrigues(ROTATION)[0], TRANSLATION_MM, RIGHT_K, RIGHT_D)[0][:, 0]
    return left, right


def blobs(points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A dark image with one smooth white blob per point, so that its centre of mass is the point."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = sum(200.0 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 2.0**2)) for px, py in points)
    return np.repeat(np.rint(image).astype(np.uint8)[..., None], 3, axis=2)


def centres(image: NDArray[np.uint8], near: Callable[[int], tuple[float, float]], count: int) -> NDArray[np.float64]:
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    found = []
    for i in range(count):
        px, py = near(i)
        weight = image[..., 0] * (np.hypot(x - px, y - py) < 8.0)
        found.append(((weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()))
    return np.array(found)


def test_raw_eyes_land_on_equal_rows_and_disparity_and_intrinsics_give_back_the_point() -> None:
    points_mm = np.array([[-20.0, -12.0, 60.0], [15.0, -14.0, 70.0], [-14.0, 14.0, 55.0], [18.0, 13.0, 80.0]])
    left, right = project(points_mm)
    clip = rectify(clip_of(blobs(left), blobs(right)), raw_calibration())
    left_image, right_image = next(iter(clip.pairs()))
    camera = clip.intrinsics
    left_rotation = cv2.stereoRectify(
        LEFT_K, LEFT_D, RIGHT_K, RIGHT_D, (WIDTH, HEIGHT), ROTATION, TRANSLATION_MM, flags=0, alpha=0.0
    )[0]
    expected = points_mm @ left_rotation.T  # the rectified left eye has turned by this
    u = camera.fx * expected[:, 0] / expected[:, 2] + camera.cx - 0.5
    v = camera.fy * expected[:, 1] / expected[:, 2] + camera.cy - 0.5
    disparity = camera.fx * clip.baseline_mm / expected[:, 2] + clip.disparity_offset_px
    seen_left = centres(left_image, lambda i: (u[i], v[i]), 4)
    seen_right = centres(right_image, lambda i: (u[i] - disparity[i], v[i]), 4)
    assert np.abs(seen_left - np.stack([u, v], axis=1)).max() < 0.15
    assert np.abs(seen_left[:, 1] - seen_right[:, 1]).max() < 0.15
    assert np.abs(seen_left[:, 0] - seen_right[:, 0] - disparity).max() < 0.2


def test_masks_are_warped_with_the_left_eye() -> None:
    tissue = np.ones((1, HEIGHT, WIDTH), np.bool_)
    tissue[:, :, : WIDTH // 2] = False
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, WIDTH // 2 :] = 255
    clip = rectify(clip_of(image, image, tissue), raw_calibration())
    left = next(iter(clip.pairs()))[0][..., 0]
    assert clip.tissue[0][left == 255].mean() > 0.99
    assert not clip.tissue[0][left == 0].any()


def test_a_rectification_that_cuts_the_view_away_warns_and_in_the_extreme_is_refused() -> None:
    def rolled(angle: float) -> RawCalibration:
        return raw_calibration(right_from_left_rotation=cv2.Rodrigues(np.array([0.0, 0.0, angle]))[0].tolist())

    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    assert rectify(clip_of(image, image), raw_calibration()).warnings == ()
    assert "magnifies" in rectify(clip_of(image, image), rolled(0.2)).warnings[0].text
    with pytest.raises(InputError, match="magnifies"):
        rectify(clip_of(image, image), rolled(0.5))


@pytest.mark.parametrize(
    ("content", "problem", "remedy"),
    [
        (b"\xff\xfe\x00PK\x03\x04", "is not a text file", "StereoLeft"),
        (b'[project]\nname = "x"\ndependencies = [\n  "a>=1",\n]\n', "neither JSON", "StereoLeft"),
        (None, "cannot be read: No such file", "exists"),
    ],
    ids=["an archive", "another text file", "no file"],
)
def test_a_file_that_is_no_calibration_is_named_for_what_it_is(
    content: bytes | None, problem: str, remedy: str, tmp_path: Path
) -> None:
    path = tmp_path / "given.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as refused:
        load_calibration(path, eye_width=640, eye_height=512)
    assert problem in refused.value.problem
    assert remedy in refused.value.remedy
