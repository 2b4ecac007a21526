"""Left and right frames in folders and zips, the StereoMIS layout, and the search for a calibration."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from intrasplat.clip import ClipLimits, StereoClip, find_calibration, open_clip
from intrasplat.errors import InputError, LimitError
from tests.intrasplat.clips import open_with

LIVE = Path(__file__).parents[2] / "data/stereo_sbs_live.webm"  # declares no length
PATTERNS = [
    ("clip/left/{}.png", "clip/right/{}.png"),
    ("clip/{}l.png", "clip/{}r.png"),
    ("clip/{}_left.png", "clip/{}_right.png"),
    ("clip/left_{}.png", "clip/right_{}.png"),
]


def write_pairs(studio, patterns: tuple[str, str] = PATTERNS[0], frames: int = 3, **size: int) -> Path:
    left, right = studio.eyes(frames, **size)
    studio.images(patterns[0], left)
    studio.images(patterns[1], right)
    return studio.root / "clip"


@pytest.mark.parametrize("patterns", PATTERNS)
@pytest.mark.parametrize("zipped", [False, True])
def test_left_and_right_frames_are_told_by_their_names(studio, patterns: tuple[str, str], zipped: bool) -> None:
    folder = write_pairs(studio, patterns)
    clip = open_clip(studio.zip(folder, prefix="wrapping/") if zipped else folder)
    assert isinstance(clip, StereoClip)
    left, right = studio.eyes(3)
    for index, (shown_left, shown_right) in enumerate(clip.pairs()):
        np.testing.assert_array_equal(shown_left, left[index])
        np.testing.assert_array_equal(shown_right, right[index])
    np.testing.assert_allclose(clip.frame_times_s, np.arange(3) / 30)
    assert any("30 frames a second" in assumption.text for assumption in clip.assumptions)


def test_two_folders_are_the_two_eyes(studio) -> None:
    folder = write_pairs(studio)
    clip = open_clip(folder / "left", folder / "right")
    assert isinstance(clip, StereoClip)
    np.testing.assert_array_equal(next(clip.pairs())[1], studio.eyes(3)[1][0])


def test_packed_frames_and_a_single_packed_picture_are_split_by_content(studio) -> None:
    left, right = studio.eyes(3)
    folder = studio.images("packed/{}.png", np.concatenate([left, right], axis=1))
    for path, frames in ((folder, 3), (folder / "000001.png", 1)):
        clip = open_clip(path)
        assert isinstance(clip, StereoClip)
        assert (clip.frame_count, clip.height, clip.width) == (frames, 80, 96)
    np.testing.assert_array_equal(next(clip.pairs())[1], right[1])


def test_two_single_pictures_are_a_clip_of_one_frame(studio) -> None:
    left, right = studio.eyes(1)
    clip = open_clip(studio.image("a.png", left[0]), studio.image("b.png", right[0]))
    assert isinstance(clip, StereoClip)
    np.testing.assert_array_equal(next(clip.pairs())[1], right[0])


def test_frame_10_comes_after_frame_9(studio) -> None:
    left, right = studio.eyes(11, height=32, width=32)
    for index in range(11):
        studio.image(f"clip/left/{index}.png", left[index])
        studio.image(f"clip/right/{index}.png", right[index])
    shown = [pair[0] for pair in open_clip(studio.root / "clip").pairs()]
    np.testing.assert_array_equal(np.stack(shown), left)


@pytest.mark.parametrize(
    "size", [{"height": 65, "width": 97}, {"height": 480, "width": 64}, {"height": 33, "width": 301}]
)
def test_odd_sizes_and_any_aspect_are_accepted(studio, size: dict[str, int]) -> None:
    clip = open_clip(write_pairs(studio, frames=1, **size))
    assert (clip.frame_count, clip.height, clip.width) == (1, size["height"], size["width"])
    assert next(clip.pairs())[0].shape == (size["height"], size["width"], 3)


def test_grey_16_bit_and_transparent_frames_become_rgb(studio) -> None:
    left = studio.eyes(1)[0][0]
    grey = left[:, :, 0]
    studio.image("clip/left/0.png", grey)
    studio.image("clip/right/0.png", left.astype(np.uint16) * 257)
    studio.image("clip/left/1.png", left)
    cv2.imwrite(str(studio.root / "clip/right/1.png"), np.dstack([left[:, :, ::-1], grey]))
    (first_left, first_right), (_, second_right) = open_clip(studio.root / "clip").pairs()
    np.testing.assert_array_equal(first_left, np.repeat(grey[:, :, None], 3, axis=2))
    np.testing.assert_array_equal(first_right, left)
    np.testing.assert_array_equal(second_right, left)


def test_jpeg_frames_are_accepted(studio) -> None:
    clip = open_clip(write_pairs(studio, ("clip/left/{}.jpg", "clip/right/{}.jpg"), height=50, width=70))
    assert (clip.height, clip.width) == (50, 70)
    assert np.abs(next(clip.pairs())[0].astype(float) - studio.eyes(3, 50, 70)[0][0]).mean() < 30


def test_a_frame_without_its_other_eye_is_refused_by_name(studio) -> None:
    folder = write_pairs(studio)
    (folder / "right/000001.png").unlink()
    with pytest.raises(InputError, match=r"left/000001.png has no frame of the right eye"):
        open_clip(folder)


def test_a_frame_whose_eye_cannot_be_told_is_refused(studio) -> None:
    folder = write_pairs(studio)
    studio.image("clip/extra.png", studio.eyes(1)[0][0])
    with pytest.raises(InputError, match=r"extra.png names neither the left nor the right eye"):
        open_clip(folder)


def test_frames_of_different_sizes_are_refused_by_name(studio) -> None:
    folder = write_pairs(studio)
    studio.image("clip/left/000002.png", studio.eyes(1, height=40)[0][0])
    with pytest.raises(InputError, match=r"left/000002.png is 96x40 pixels"):
        open_clip(folder)


def test_a_damaged_frame_is_refused_when_it_is_reached(studio) -> None:
    folder = write_pairs(studio)
    path = folder / "right/000001.png"
    path.write_bytes(path.read_bytes()[:-200])
    pairs = open_clip(folder).pairs()
    next(pairs)
    with pytest.raises(InputError, match=r"right/000001.png is damaged or cut short"):
        next(pairs)


@pytest.mark.parametrize(("content", "problem"), [(b"", "0 bytes"), (b"not an image", "not a PNG or JPEG")])
def test_a_file_that_is_no_image_is_refused(studio, content: bytes, problem: str) -> None:
    folder = write_pairs(studio)
    (folder / "left/000000.png").write_bytes(content)
    with pytest.raises(InputError, match=problem):
        open_clip(folder)


def test_a_folder_without_frames_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(InputError, match="neither a video nor frames"):
        open_clip(tmp_path)


def test_a_huge_picture_is_refused_from_its_header(studio) -> None:
    folder = write_pairs(studio)
    for side in ("left", "right"):
        for path in (folder / side).iterdir():
            data = bytearray(path.read_bytes())
            data[16:24] = (100_000).to_bytes(4, "big") * 2
            path.write_bytes(data)
    with pytest.raises(LimitError, match="100000x100000 pixels"):
        open_clip(folder)


def test_too_many_frames_are_refused(studio) -> None:
    with pytest.raises(LimitError, match="has 3 frames or more; the limit is 2"):
        open_clip(write_pairs(studio), limits=ClipLimits(frames=2))


def stereomis(studio) -> Path:
    folder = write_pairs(studio, ("clip/{}l.png", "clip/{}r.png"))
    (folder / "StereoCalibration.ini").write_text("[StereoLeft]\n")
    tissue = ~studio.tool(3)
    studio.images("clip/masks/{}l.png", np.where(tissue, np.uint8(255), np.uint8(0)))
    return folder


@pytest.mark.parametrize("zipped", [False, True])
def test_stereomis_masks_are_white_on_tissue(studio, zipped: bool) -> None:
    folder = stereomis(studio)
    clip = open_clip(studio.zip(folder, prefix="P1/") if zipped else folder)
    assert isinstance(clip, StereoClip)
    np.testing.assert_array_equal(clip.tissue, ~studio.tool(3))
    assert any("StereoMIS" in assumption.text for assumption in clip.assumptions)


def test_a_stereomis_video_is_top_bottom(studio) -> None:
    left, right = studio.eyes()
    (studio.root / "P1").mkdir()
    studio.video("P1/part.mp4", np.concatenate([left, right], axis=1))
    (studio.root / "P1/StereoCalibration.ini").write_text("[StereoLeft]\n")
    clip = open_clip(studio.root / "P1")
    assert (clip.height, clip.width) == (80, 96)
    assert clip.assumptions[0].text.startswith("layout: StereoMIS, top-bottom, left eye on top")


def test_two_videos_in_a_folder_are_told_by_their_names(studio) -> None:
    left, right = studio.eyes()
    (studio.root / "clip").mkdir()
    studio.video("clip/right.webm", right)
    studio.video("clip/left.webm", left)
    shown_left, shown_right = next(open_clip(studio.root / "clip").pairs())
    assert np.abs(shown_left.astype(float) - left[0]).mean() < np.abs(shown_left.astype(float) - right[0]).mean()
    assert np.abs(shown_right.astype(float) - right[0]).mean() < np.abs(shown_right.astype(float) - left[0]).mean()
    studio.video("clip/third.webm", right)
    with pytest.raises(InputError, match="holds 3 videos"):
        open_clip(studio.root / "clip")


def test_a_calibration_is_found_in_a_folder_and_in_a_zip(studio, tmp_path: Path) -> None:
    folder = stereomis(studio)
    assert find_calibration(folder) == folder / "StereoCalibration.ini"
    found = find_calibration(studio.zip(folder), scratch=tmp_path)
    assert found is not None
    assert found.read_text() == "[StereoLeft]\n"
    assert found.suffix == ".ini"


@pytest.mark.parametrize("pattern", ["{eye}/smith_{{}}.png", "{eye}_smith_{{}}.png", "smith_{{}}{eye}.png"])
@pytest.mark.parametrize("calibration", ["smith.txt", "StereoCalibration.ini"])
def test_what_is_said_of_a_clip_repeats_no_name_of_its_files(studio, pattern: str, calibration: str) -> None:
    """They may name a patient, and the report is passed on."""
    folder = write_pairs(studio, ("clip/" + pattern.format(eye="left"), "clip/" + pattern.format(eye="right")))
    (folder / calibration).write_text("[StereoLeft]")
    studio.masks("clip/masks/smith", studio.tool(3))
    clip = open_with(studio.zip(folder, prefix="smith/"), mask_polarity="tool")
    assert clip.assumptions
    assert not any("smith" in said.text for said in clip.assumptions + clip.warnings)


def test_what_is_said_of_videos_repeats_no_name_of_their_files(studio) -> None:
    folder = studio.root / "smith"
    folder.mkdir()
    for eye in ("left", "right"):
        shutil.copy(LIVE, folder / f"smith_{eye}.webm")
    clip = open_clip(studio.zip(folder))
    assert len(clip.warnings) == 2
    assert not any("smith" in said.text for said in clip.assumptions + clip.warnings)


def test_no_calibration_is_none_and_two_are_an_error(studio) -> None:
    folder = write_pairs(studio)
    assert find_calibration(folder) is None
    assert find_calibration(folder / "left/000000.png") is None
    (folder / "calibration.json").write_text("{}")
    assert find_calibration(folder) == folder / "calibration.json"
    (folder / "calibration.yaml").write_text("")
    with pytest.raises(InputError, match=r"calibration.json, calibration.yaml"):
        find_calibration(folder)
