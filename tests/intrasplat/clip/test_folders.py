"""Folders, zips and names as programs and people make them, and pictures with bytes after their end."""

from __future__ import annotations

import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from intrasplat.clip import StereoClip, open_clip
from intrasplat.clip.files import natural_key
from intrasplat.clip.naming import check_aligned, eye_folders
from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.sniff import check_file


def check_eyes(studio, path: Path, frames: int = 3) -> None:
    """The clip has the studio's pictures for each eye, in order."""
    clip = open_clip(path)
    assert isinstance(clip, StereoClip)
    for index, shown in enumerate(clip.pairs()):
        for eye, given in zip(shown, studio.eyes(frames), strict=True):
            np.testing.assert_array_equal(eye, given[index])
    assert clip.frame_count == frames


def write_eyes(studio, left: str, right: str) -> Path:
    for pattern, eye in zip((left, right), studio.eyes(3), strict=True):
        studio.images("clip/" + pattern, eye)
    (studio.root / "clip/calibration.json").write_text("{}")
    return studio.root / "clip"


FOLDERS = [
    ("L", "R"),
    ("Left", "Right"),
    ("left_frames", "right_frames"),
    ("left_rgb", "right_rgb"),
    ("LeftImages", "RightImages"),
    ("rgb.left", "rgb.right"),
    ("cam_l", "cam_r"),
    ("image01", "image02"),
    ("image_02", "image_03"),
    ("cam0", "cam1"),
    ("mav0/cam0/data", "mav0/cam1/data"),
    ("left_kidney/left", "left_kidney/right"),
]


@pytest.mark.parametrize(("left", "right"), FOLDERS)
def test_the_eyes_folders_are_known_by_their_pair(studio, left: str, right: str) -> None:
    check_eyes(studio, write_eyes(studio, f"{left}/frame{{}}.png", f"{right}/frame{{}}.png"))


def test_masks_in_the_eyes_folders_are_of_both_eyes(studio) -> None:
    folder = write_eyes(studio, "L/{}.png", "R/{}.png")
    for eye in "LR":
        studio.masks(f"clip/masks/{eye}", studio.tool(3))
    clip = open_clip(folder)
    assert isinstance(clip, StereoClip)
    np.testing.assert_array_equal(clip.tissue_right, ~studio.tool(3))


@pytest.mark.parametrize("folder", ["right_nephrectomy", "cam1", "L", "image01"])
def test_a_folder_without_its_pair_is_no_eyes(studio, folder: str) -> None:
    left, right = studio.eyes(3)
    studio.images(f"clip/{folder}/{{}}.png", np.concatenate([left, right], axis=2))
    (studio.root / "clip/calibration.json").write_text("{}")
    check_eyes(studio, studio.root / "clip")


def test_folders_of_masks_and_depth_and_three_cameras_are_no_eyes() -> None:
    names = (
        "left_masks/0.png",
        "right_masks/0.png",
        "depth_l/0.png",
        "depth_r/0.png",
        *(f"cam{i}/0.png" for i in "012"),
    )
    assert eye_folders(names) == {"left": "left", "right": "right"}


@pytest.mark.parametrize(("left", "right"), [("L", "R"), ("cam0", "cam1"), ("video_left", "video_right")])
def test_two_videos_are_known_by_their_pair(studio, left: str, right: str) -> None:
    for name, eye in zip((left, right), studio.eyes(3), strict=True):
        studio.video(f"clip/{name}.webm", eye)
    clip = open_clip(studio.root / "clip")
    assert isinstance(clip, StereoClip)
    for shown, given in zip(next(clip.pairs()), studio.eyes(3), strict=True):
        assert np.abs(shown.astype(float) - given[0]).mean() < 12


def test_frames_that_repeat_their_folders_name_are_paired(studio) -> None:
    check_eyes(studio, write_eyes(studio, "cam0/cam0_{}.png", "cam1/cam1_{}.png"))


def test_folders_of_masks_alone_are_pairs(studio) -> None:
    folder = write_eyes(studio, "left/{}.png", "right/{}.png")
    for eye in ("left", "right"):
        studio.masks(f"clip/masks/{eye}_mask", studio.tool(3))
    clip = open_clip(folder)
    assert isinstance(clip, StereoClip)
    np.testing.assert_array_equal(clip.tissue_right, ~studio.tool(3))


def test_what_names_no_eye_is_told_the_folders_that_do(studio) -> None:
    folder = write_eyes(studio, "left/{}.png", "right/{}.png")
    studio.image("clip/other/0.png", studio.eyes(1)[0][0])
    with pytest.raises(InputError, match="names neither") as caught:
        open_clip(folder)
    assert "image01/ and image02/" in caught.value.remedy


def backslashed(studio, folder: Path) -> Path:
    """The folder in a zip as .NET wrote it: backslashes, also at the end of folders."""
    path = studio.root / "clip.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in [folder, *sorted(folder.rglob("*"))]:
            entry = zipfile.ZipInfo("placeholder")
            name = str(file.relative_to(folder.parent)).replace("/", "\\") + ("\\" if file.is_dir() else "")
            entry.filename = entry.orig_filename = name
            archive.writestr(entry, b"" if file.is_dir() else file.read_bytes())
    return path


@pytest.mark.parametrize(
    ("left", "right"), [("left", "right"), ("left_frames", "right_frames"), ("deep/er/L", "deep/er/R")]
)
def test_backslashes_of_windows_are_folders(studio, left: str, right: str) -> None:
    path = backslashed(studio, write_eyes(studio, f"{left}/{{}}.png", f"{right}/{{}}.png"))
    check_file(path, "clip", ClipLimits())
    check_eyes(studio, path)


@pytest.mark.parametrize("name", ["3²{}", "x{}⅓", "٣{}", "0" * 30 + "{}", "{}" + "9" * 200])
def test_any_name_can_be_sorted(studio, name: str) -> None:
    check_eyes(studio, write_eyes(studio, f"left/{name}.png", f"right/{name}.png"))


def test_numbers_sort_by_their_value_and_none_is_too_long() -> None:
    names = ["a10", "a9", "a010", "3²1", "3²", "9" * 5000, "10", "1" + "0" * 5000]
    assert sorted(names, key=natural_key) == ["3²", "3²1", "10", "9" * 5000, "1" + "0" * 5000, "a9", "a10", "a010"]
    check_aligned("clip", ("9" * 5000, "9" * 5001), ("1", "2"))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize(
    "tail", [bytes(100), b"\xff\xd9" * 99, b"motion photo" * 1000], ids=["zeros", "ends", "a film"]
)
def test_bytes_after_the_end_of_a_picture_do_not_count(studio, suffix: str, tail: bytes) -> None:
    folder = write_eyes(studio, "left/{}" + suffix, "right/{}" + suffix)
    before = [pair[0] for pair in open_clip(folder).pairs()]
    for path in folder.glob("*/*" + suffix):
        path.write_bytes(path.read_bytes() + tail)
    for shown, given in zip(open_clip(folder).pairs(), before, strict=True):
        np.testing.assert_array_equal(shown[0], given)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_picture_without_its_end_is_still_refused(studio, suffix: str) -> None:
    """Also if a thumbnail in its head has an end of its own."""
    folder = write_eyes(studio, "left/{}" + suffix, "right/{}" + suffix)
    thumbnail = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes()
    for path in folder.glob("*/*" + suffix):
        data = path.read_bytes()
        if suffix == ".jpg":
            data = data[:2] + b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + data[2:]
        path.write_bytes(data[:-500])
    with pytest.raises(InputError, match="damaged or cut short"):
        next(open_clip(folder).pairs())
