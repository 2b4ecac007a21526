"""A field of view that the caller gives: read, checked, rectified, and taken in place of the search."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import intrasplat as isp
from intrasplat.__main__ import main
from intrasplat.clip import ClipLimits, StereoClip
from intrasplat.clip.calibration import rectify
from intrasplat.clip.field_of_view import find_fields
from intrasplat.clip.given_field import read_field, with_field
from intrasplat.commands.exits import ExitCode
from intrasplat.decode import StereoRecording, decode_clip
from intrasplat.errors import InputError, LimitError
from tests.intrasplat.clip.conftest import Studio
from tests.intrasplat.clip.test_calibration import raw_calibration
from tests.intrasplat.clip.test_field_of_view import agreement, disc, eyes_with, outside_as, tissue
from tests.intrasplat.test_spoilt_frames import HEIGHT, WIDTH, drawn, recorded, round_field

Mask = NDArray[np.bool_]


def written(path: Path, inside: Mask, white: int = 255) -> Path:
    assert cv2.imwrite(str(path), np.where(inside, white, 0).astype(np.uint16 if white > 255 else np.uint8))
    return path


def stereo(height: int = HEIGHT, width: int = WIDTH) -> StereoClip:
    frame = np.zeros((height, width, 3), np.uint8)
    return StereoClip(1, height, width, lambda: iter([(frame, frame)]), None, np.zeros(1))


def refusal(path_or_mask: Path | Mask) -> InputError:
    picture = path_or_mask if isinstance(path_or_mask, np.ndarray) else read_field(path_or_mask, ClipLimits())
    with pytest.raises(InputError) as caught:
        with_field(stereo(), picture)
    assert (caught.value.field, bool(caught.value.remedy)) == ("fov_mask", True)
    return caught.value


@pytest.mark.parametrize("white", [1, 255, 65535])
def test_all_that_is_not_black_is_inside(tmp_path: Path, white: int) -> None:
    field = round_field(30)
    path = written(tmp_path / "field.png", field, white)
    np.testing.assert_array_equal(read_field(path, ClipLimits()), field)


def test_colours_count_and_alpha_does_not(tmp_path: Path) -> None:
    field = round_field(30)
    pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    pixels[field, 2], pixels[..., 3] = 200, 255
    assert cv2.imwrite(str(tmp_path / "red.png"), pixels)
    np.testing.assert_array_equal(read_field(tmp_path / "red.png", ClipLimits()), field)


def test_what_is_no_png_or_too_large_is_refused(tmp_path: Path) -> None:
    whole = written(tmp_path / "field.png", round_field(30)).read_bytes()
    bad = {"none.png": None, "cut.png": whole[:40], "jpeg.png": b"\xff\xd8\xff\xe0" + bytes(60), "empty.png": b""}
    for name, content in bad.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError) as caught:
            read_field(tmp_path / name, ClipLimits())
        assert caught.value.field == "fov_mask", name
    with pytest.raises(LimitError):
        read_field(tmp_path / "field.png", ClipLimits(pixels_per_frame=100))


def test_a_wrong_size_and_black_are_refused_with_both_sizes_and_a_remedy() -> None:
    wrong = refusal(np.ones((HEIGHT, WIDTH - 1), np.bool_))
    assert f"{WIDTH - 1}x{HEIGHT}" in wrong.problem
    assert f"{WIDTH}x{HEIGHT}" in wrong.problem
    assert "black" in refusal(np.zeros((HEIGHT, WIDTH), np.bool_)).problem
    half = np.concatenate([round_field(30), np.zeros((HEIGHT, WIDTH), np.bool_)], axis=1)
    assert "right eye" in refusal(half).problem


@pytest.mark.parametrize(("axis", "count"), [(None, 1), (0, 2), (1, 2)])
def test_one_eye_or_both_as_frames_are_packed(axis: int | None, count: int) -> None:
    left, right = round_field(30), round_field(20)
    fields = with_field(stereo(), left if axis is None else np.concatenate([left, right], axis=axis)).given_fields
    assert len(fields) == count
    for given, expected in zip(fields, (left, right), strict=False):
        np.testing.assert_array_equal(given, expected)


def test_the_left_field_is_as_given_and_the_right_one_is_found() -> None:
    left = outside_as(tissue(), disc(50, 85), 0.0)
    right = outside_as(np.roll(tissue(), -10, axis=2), disc(50, 75), 0.0)
    fields = find_fields([left, right], range(10), "auto", given=[disc(30, 85)])
    assert fields.left is not None
    assert fields.right is not None
    np.testing.assert_array_equal(fields.left, disc(30, 85))
    assert agreement(fields.right, disc(50, 75)) > 0.88
    assert (fields.entry.source, fields.entry.shape) == ("given", "round")
    assert "as given" in fields.notices[0].text
    both = find_fields([left, right], range(10), "auto", given=[disc(30), disc(20)])
    assert both.right is not None
    np.testing.assert_array_equal(both.right, disc(20))


def test_labels_leave_the_right_field_alone() -> None:
    label = np.zeros((14, 40, 3), np.uint8)
    cv2.putText(label, "12:34", (1, 11), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255))
    eyes = eyes_with(label)
    fields = find_fields(eyes, range(10), "auto", given=[np.ones(eyes[0].shape[1:3], np.bool_)])
    assert fields.left is None  # white all over: the whole picture
    assert fields.right is not None
    assert not fields.right[6:14, 6:40].any()


def test_the_whole_picture_and_a_given_field_exclude_each_other() -> None:
    with pytest.raises(InputError) as caught:
        find_fields([tissue()], range(10), "all", given=[disc(30)])
    assert (caught.value.field, "Leave one" in caught.value.remedy) == ("fov_mask", True)


def test_it_is_rectified_as_the_frames_are() -> None:
    calibration = raw_calibration()
    inside = np.zeros((calibration.height, calibration.width), np.bool_)
    inside[inside.shape[0] // 4 : -inside.shape[0] // 4, inside.shape[1] // 3 : -inside.shape[1] // 3] = True
    frame = np.repeat(np.where(inside, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
    recording = StereoClip(1, *inside.shape, lambda: iter([(frame, frame)]), None, np.zeros(1))
    clip = rectify(with_field(recording, np.concatenate([inside, inside], axis=1)), calibration)
    for field, picture in zip(clip.given_fields, next(iter(clip.pairs())), strict=True):
        assert agreement(field, picture[..., 0] > 127) > 0.97
        assert not np.array_equal(field, inside)
    corner = np.zeros_like(inside)
    corner[0, 0] = True
    with pytest.raises(InputError, match="rectification"):
        rectify(with_field(recording, corner), calibration)


def test_the_decoding_process_reads_it(studio: Studio) -> None:
    video = studio.video("clip.webm", np.concatenate(studio.eyes(), axis=2))
    rectified = {"model": "rectified", "width": 96, "height": 80, "fx_px": 90, "fy_px": 90, "cx_px": 48, "cy_px": 40}
    calibration = studio.root / "calibration.json"
    calibration.write_text(json.dumps(rectified | {"baseline_mm": 4}))
    field = written(studio.root / "field.png", round_field(30))
    decoded = decode_clip(video, calibration=calibration, fov_mask=field)
    assert isinstance(decoded, StereoRecording)
    np.testing.assert_array_equal(decoded.clip.given_fields, [round_field(30)])
    with pytest.raises(InputError) as caught:
        decode_clip(video, calibration=calibration, fov_mask=written(studio.root / "s.png", round_field(30)[:-2]))
    assert (caught.value.field, "96x78" in caught.value.problem) == ("fov_mask", True)
    one_eye = decode_clip(studio.endonerf(), fov_mask=written(studio.root / "e.png", round_field(30)[:64, :80]))
    assert not isinstance(one_eye, StereoRecording)
    np.testing.assert_array_equal(one_eye.field_of_view, round_field(30)[:64, :80])


def read(given: dict[str, NDArray[Any]], fov_mask: Path | Mask) -> isp.Clip:
    calibration = drawn().calibration.model_dump(mode="json")
    return isp.read_clip(given["left"], given["right"], calibration=calibration, fov_mask=fov_mask)


def test_outside_a_given_field_there_is_nothing(tmp_path: Path) -> None:
    field = round_field(30)
    for fov_mask in (field, written(tmp_path / "field.png", field)):
        clip = read(recorded(), fov_mask).with_depth()
        assert clip.fov is not None
        assert (clip.fov.source, clip.fov.share) == ("given", pytest.approx(field.mean()))
        assert not clip.tissue[:, ~field].any()
        assert not clip.depth_mm[:, ~field].any()
    with pytest.raises(isp.InputError, match="whole picture") as caught:
        isp.reconstruct(read(recorded(), field), method="fast", iterations=4, fov="all", device="cpu")
    assert caught.value.field == "fov_mask"
    with pytest.raises(isp.InputError) as caught:
        read(recorded(), field.astype(np.uint8))  # type: ignore[arg-type]
    assert caught.value.field == "fov_mask"


def test_files_take_a_picture_or_an_array_and_the_report_says_given(studio: Studio, capsys: Any) -> None:
    folder, field = studio.endonerf(frames=9), round_field(30)[:64, :80]
    path = written(studio.root / "field.png", field)
    clip = isp.read_clip(folder, fov_mask=field).with_depth()
    assert clip.fov is not None
    assert clip.fov.source == "given"
    assert not clip.tissue[:, ~field].any()
    out = studio.root / "scene"
    command = ["reconstruct", folder, "--fov-mask", path, "--device", "cpu", "--preset", "fast", "--iterations", "4"]
    assert main([*map(str, command), "--out", str(out)]) == ExitCode.OK
    entry = isp.load(out).report.field_of_view
    assert entry is not None
    assert (entry.source, entry.share) == ("given", pytest.approx(field.mean()))
    again = [*map(str, command), "--out", str(studio.root / "other"), "--fov", "all"]
    assert main(again) == ExitCode.BAD_INPUT
    assert "fov_mask" in capsys.readouterr().err
