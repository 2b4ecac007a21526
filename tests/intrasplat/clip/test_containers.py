"""Containers as recorders and editors write them: clocks, length, rotation, pixel aspect, damage in the middle."""

from __future__ import annotations

import struct
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import ClipLimits, StereoClip
from intrasplat.clip.damage import PacketLog, Sample, frames_to_show
from intrasplat.clip.frame_times import frame_times
from intrasplat.clip.video import VideoFile, open_video
from intrasplat.errors import InputError
from intrasplat.notices import NoticeCode
from tests.intrasplat.clip.recorder import Frames, damaged, record
from tests.intrasplat.clips import open_with

FRAMES = 24


@pytest.fixture
def frames(studio) -> Frames:
    left, right = studio.eyes(FRAMES, 80, 100)
    return np.concatenate([left, right], axis=2)


def opened(path: Path) -> VideoFile:
    return open_video(path, "clip", ClipLimits())


def told(video: VideoFile, code: NoticeCode) -> list[str]:
    return [each.text for each in video.notices if each.code is code]


@pytest.mark.parametrize("suffix", ["mkv", "mp4"])
@pytest.mark.parametrize("start_ms", [300, 36_000_000])
def test_a_clock_may_start_anywhere(tmp_path: Path, frames: Frames, suffix: str, start_ms: int) -> None:
    times_ms = [start_ms + 40 * index for index in range(FRAMES)]
    video = opened(record(tmp_path / f"clip.{suffix}", frames, times_ms=times_ms))
    assert video.frame_count == FRAMES
    np.testing.assert_allclose(video.frame_times_s, np.arange(FRAMES) / 25, atol=2e-3)
    assert video.notices == ()


def test_matroska_whose_sound_goes_on_is_whole(tmp_path: Path, frames: Frames) -> None:
    path = record(tmp_path / "clip.mkv", frames)
    data = path.read_bytes()
    at = data.index(b"\x44\x89\x88") + 3
    path.write_bytes(data[:at] + struct.pack(">d", 9000.0) + data[at + 8 :])
    assert opened(path).frame_count == FRAMES


@pytest.mark.parametrize("kept", [0.5, 0.98])
@pytest.mark.parametrize("suffix", ["mkv", "mp4"])
def test_a_file_that_was_cut_is_refused(tmp_path: Path, frames: Frames, suffix: str, kept: float) -> None:
    path = record(tmp_path / f"clip.{suffix}", frames, options={"movflags": "faststart"})
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(InputError, match="ends after") as caught:
        opened(path)
    assert caught.value.field == "clip"


def test_time_stamps_that_jump_are_bridged(tmp_path: Path, frames: Frames) -> None:
    times_ms = [40 * index + (3_600_000 if index >= 12 else 0) for index in range(FRAMES)]
    video = opened(record(tmp_path / "clip.mkv", frames, times_ms=times_ms))
    np.testing.assert_allclose(video.frame_times_s, np.arange(FRAMES) / 25, atol=2e-3)
    assert "jump 1 times, first after frame 11" in told(video, NoticeCode.FRAME_TIMES)[0]


def test_frame_times_fall_back_step_by_step() -> None:
    pause, notices = frame_times([0.0, 0.04, 4.0, 4.04], 25.0, "clip")
    np.testing.assert_allclose(pause, [0, 0.04, 4.0, 4.04])
    assert notices == ()
    falling, notices = frame_times([5.0, 5.04, 5.08, 0.0, 0.04, 0.08], 25.0, "clip")
    np.testing.assert_allclose(falling, np.arange(6) / 25)
    assert "after frame 2" in notices[0].text
    same, notices = frame_times([None] * 3, 50.0, "clip")
    np.testing.assert_allclose(same, [0, 0.02, 0.04])
    assert "50 frames a second" in notices[0].text
    assert frame_times([1.0, 1.0, 1.0], None, "clip") == (None, ())
    assert frame_times([7.0], 25.0, "clip")[0] == [0.0]


@pytest.mark.parametrize("rotation_deg", [180, 90])
def test_a_video_that_players_turn_is_used_as_recorded(tmp_path: Path, frames: Frames, rotation_deg: int) -> None:
    video = opened(record(tmp_path / "turned.mp4", frames, rotation_deg=rotation_deg))
    assert (video.height, video.width) == frames.shape[1:3]
    assert np.abs(next(video.frames()).astype(float) - frames[0]).mean() < 4
    assert "as recorded" in told(video, NoticeCode.ROTATION)[0]


@pytest.mark.parametrize(("suffix", "codec"), [("mp4", "libx264"), ("mkv", "libx264"), ("mov", "libx265")])
def test_damaged_frames_are_left_out_up_to_the_next_keyframe(
    tmp_path: Path, frames: Frames, suffix: str, codec: str
) -> None:
    options = {"bf": "0", "x265-params": "bframes=0:keyint=8:log-level=none"}
    whole = record(tmp_path / f"clip.{suffix}", frames, codec=codec, keyframes=8, options=options)
    sound = list(opened(whole).frames())
    video = opened(damaged(whole, 11))
    assert video.frame_count == FRAMES
    assert video.damaged == (11, 12, 13, 14, 15)
    assert "frames 11 to 15 of 24 are damaged" in told(video, NoticeCode.DAMAGED_FRAMES)[0]
    for index, frame in enumerate(video.frames()):
        np.testing.assert_array_equal(frame, sound[10 if index in video.damaged else index])


def test_damage_of_either_eye_and_of_masks_leaves_the_frame_out(tmp_path: Path, studio) -> None:
    left, right = studio.eyes(FRAMES, 80, 100)
    tool = np.repeat(np.where(studio.tool(FRAMES, 80, 100), np.uint8(255), np.uint8(0))[..., None], 3, axis=3)
    shot = {"keyframes": 4, "options": {"bf": "0"}}
    paths = [
        damaged(record(tmp_path / f"{name}.mp4", each, **shot), packet)
        for name, each, packet in (("left", left, 3), ("right", right, 10), ("masks", tool, 18))
    ]
    clip = open_with(paths[0], right=paths[1], masks=paths[2])
    assert isinstance(clip, StereoClip)
    assert clip.damaged == (3, 10, 11, 18, 19)
    words = [each.text.split(":")[0] for each in clip.warnings if each.code is NoticeCode.DAMAGED_FRAMES]
    assert words == ["clip", "right", "masks"]


def test_a_video_that_is_mostly_damaged_is_refused(tmp_path: Path, frames: Frames) -> None:
    whole = record(tmp_path / "clip.mp4", frames, options={"bf": "0"})
    with pytest.raises(InputError, match=r"21 of the 24 frames of .* are damaged"):
        opened(damaged(whole, 3))


def test_frames_that_refer_to_damage_across_a_keyframe_are_left_out() -> None:
    """Decoded 0 3 1 2, then keyframe 6 with 4 and 5 before it: frame 3 is lost."""
    log = PacketLog([Sample(time, time in (0, 6), False) for time in (0, 3, 1, 2, 6, 4, 5, 7)], failures=1)
    shown = frames_to_show([0, 1, 2, 4, 5, 6, 7], [], log)
    assert shown.damaged == (1, 2, 3, 4, 5)
    assert shown.sources == (0, 0, 0, 0, 0, 0, 5, 6)


def test_packets_that_are_fields_or_lie_before_the_first_keyframe_are_not_missing() -> None:
    fields = PacketLog([Sample(time, time == 0, False) for time in range(8)])
    assert frames_to_show([0, 2, 4, 6], [], fields).damaged == ()
    cut = PacketLog([Sample(time, time == 3, False) for time in range(8)])
    assert frames_to_show([3, 4, 5, 6, 7], [], cut).damaged == ()
    assert frames_to_show([3, 4, 6, 7], [], cut).damaged == (2, 3, 4)


def test_the_first_frames_may_be_damaged() -> None:
    log = PacketLog([Sample(time, time in (0, 2), False) for time in range(4)], failures=1)
    shown = frames_to_show([1, 2, 3], [], log)
    assert (shown.damaged, shown.sources) == ((0, 1), (1, 1, 1, 2))


def test_pixels_that_are_not_square_are_told(tmp_path: Path, frames: Frames) -> None:
    video = opened(record(tmp_path / "half.mp4", frames, pixel_aspect=Fraction(2, 1)))
    assert video.pixel_aspect == 2
    assert "2 times as wide as high" in told(video, NoticeCode.PIXEL_ASPECT)[0]
    assert opened(record(tmp_path / "wild.mp4", frames, pixel_aspect=Fraction(50, 1))).pixel_aspect == 1


def test_colours_that_cannot_be_converted_are_an_error(tmp_path: Path, frames: Frames) -> None:
    path = record(tmp_path / "ycgco.mp4", frames, options={"colorspace": "ycgco"})
    with pytest.raises(InputError, match="matrix 8") as caught:
        opened(path)
    assert "BT.709" in caught.value.remedy


def test_pyav_is_loaded_with_the_first_video_and_not_before() -> None:
    code = "import sys, intrasplat.clip, intrasplat.decode; sys.exit('av' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
