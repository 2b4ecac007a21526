"""Stereo video: three codecs, two packings, two files, and everything that can be wrong with them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import ClipLimits, StereoClip, open_clip, video
from intrasplat.clip.video import open_video
from intrasplat.errors import InputError, LimitError
from intrasplat.intake.limits import CLIP_BYTES_PER_PIXEL
from tests.intrasplat.clips import open_with

DATA = Path(__file__).parents[2] / "data"
SBS_H264 = DATA / "stereo_sbs_h264.mp4"
TB_HEVC = DATA / "stereo_tb_hevc.mov"
REAL_DATA = Path(os.environ.get("INTRASPLAT_DATA", Path(__file__).parents[3].parent / "shared/data"))
CLIP_BYTES = 12 * 96 * 80 * CLIP_BYTES_PER_PIXEL  # of the twelve frames in tests/data, once they are reconstructed
LOSSY_LEVELS = 8.0  # mean error of strongly compressed 8-bit frames


def stereo(path, *args, **options) -> StereoClip:
    clip = open_with(path, *args, **options)
    assert isinstance(clip, StereoClip)
    return clip


@pytest.mark.parametrize(("path", "words"), [(SBS_H264, "side by side"), (TB_HEVC, "top-bottom")])
def test_h264_and_hevc_clips_open_with_their_packing_found(path: Path, words: str) -> None:
    clip = stereo(path)
    assert (clip.frame_count, clip.height, clip.width) == (12, 80, 96)
    assert any(words in assumption.text for assumption in clip.assumptions)
    pairs = list(clip.pairs())
    assert len(pairs) == 12
    for left, right in pairs:
        assert left.shape == right.shape == (80, 96, 3)
        assert left.dtype == np.uint8
        # the right eye sees the texture four pixels further left
        assert np.abs(left[:, 4:].astype(float) - right[:, :-4]).mean() < LOSSY_LEVELS


def test_times_come_from_the_container() -> None:
    np.testing.assert_allclose(stereo(SBS_H264).frame_times_s, np.arange(12) / 25, atol=1e-6)


def test_frames_of_varying_length_keep_their_times() -> None:
    """Matroska promises 12 frames by duration and nominal rate; 8 of varying length are all there are."""
    clip = stereo(DATA / "stereo_sbs_varying.mkv")
    assert clip.frame_count == 8
    np.testing.assert_allclose(clip.frame_times_s, [0, 0.04, 0.12, 0.16, 0.24, 0.28, 0.36, 0.40], atol=1e-6)


def test_frames_hidden_by_an_edit_list_are_not_missing() -> None:
    clip = stereo(DATA / "stereo_sbs_trimmed.mp4")
    assert clip.frame_count == 7
    whole = list(stereo(SBS_H264).pairs())
    np.testing.assert_array_equal(next(clip.pairs())[0], whole[5][0])


def test_a_stream_that_declares_no_length_warns() -> None:
    clip = stereo(DATA / "stereo_sbs_live.webm")
    assert clip.frame_count == 12
    assert "a missing end would not be noticed" in clip.warnings[0].text


def test_a_cut_clip_of_varying_frames_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.mkv"
    path.write_bytes((DATA / "stereo_sbs_varying.mkv").read_bytes()[:2600])
    with pytest.raises(InputError, match="ends after"):
        open_clip(path)


def test_pairs_start_again_from_the_first_frame() -> None:
    clip = stereo(SBS_H264)
    half_read = clip.pairs()
    next(half_read), next(half_read)
    first, again = next(clip.pairs()), next(clip.pairs())
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])


def test_frames_that_were_kept_are_those_that_are_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = list(open_video(SBS_H264, "clip", ClipLimits()).frames())
    for most_bytes in (0, kept[0].nbytes * 3):
        monkeypatch.setattr(video, "MAX_CACHE_BYTES", most_bytes)
        anew = open_video(SBS_H264, "clip", ClipLimits())
        assert anew.cached is None
        for frame, other in zip(kept, anew.frames(), strict=True):
            np.testing.assert_array_equal(frame, other)


def test_frames_are_rgb(studio) -> None:
    red = np.zeros((3, 64, 160, 3), dtype=np.uint8)
    red[..., 0] = 200
    left, _ = next(stereo(studio.video("red.webm", red), layout="sbs").pairs())
    assert left[..., 0].mean() > 150
    assert left[..., 1:].mean() < 60


@pytest.mark.parametrize("suffix", ["webm", "mkv", "mp4"])
def test_vp9_opens_in_each_container(studio, suffix: str) -> None:
    left, right = studio.eyes()
    clip = stereo(studio.video(f"clip.{suffix}", np.concatenate([left, right], axis=2)))
    shown_left, shown_right = next(clip.pairs())
    assert np.abs(shown_left.astype(float) - left[0]).mean() < LOSSY_LEVELS
    assert np.abs(shown_right.astype(float) - right[0]).mean() < LOSSY_LEVELS


def test_a_told_packing_wins_over_what_the_frames_look_like() -> None:
    clip = stereo(SBS_H264, layout="tb")
    assert (clip.height, clip.width) == (40, 192)


def test_content_tells_the_packing_where_the_shape_misleads(studio) -> None:
    """144x80 in all: side by side would give well-shaped eyes of 72x80, but it holds 144x40 top-bottom."""
    left, right = studio.eyes(height=40, width=144)
    clip = stereo(studio.video("squeezed.webm", np.concatenate([left, right], axis=1)))
    assert (clip.height, clip.width) == (40, 144)


def test_two_files_are_the_two_eyes(studio) -> None:
    left, right = studio.eyes()
    clip = stereo(studio.video("a.webm", left), studio.video("b.webm", right))
    assert (clip.frame_count, clip.height, clip.width) == (6, 80, 96)
    shown_left, shown_right = next(clip.pairs())
    assert np.abs(shown_left.astype(float) - left[0]).mean() < LOSSY_LEVELS
    assert np.abs(shown_right.astype(float) - right[0]).mean() < LOSSY_LEVELS


def test_a_zip_with_one_video_opens_and_leaves_nothing_behind(studio, tmp_path: Path, monkeypatch) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    folder = tmp_path / "clip"
    folder.mkdir()
    shutil.copy(SBS_H264, folder)
    clip = stereo(studio.zip(folder))
    assert sum(1 for _ in clip.pairs()) == 12
    del clip
    assert list(scratch.iterdir()) == []


def test_an_odd_middle_column_belongs_to_neither_eye(studio) -> None:
    left, right = studio.eyes()
    middle = np.zeros((6, 80, 1, 3), dtype=np.uint8)
    folder = studio.images("packed/{}.png", np.concatenate([left, middle, right], axis=2))
    clip = stereo(folder, layout="sbs")
    assert (clip.height, clip.width) == (80, 96)
    assert any("odd middle column" in assumption.text for assumption in clip.assumptions)
    shown_left, shown_right = next(clip.pairs())
    np.testing.assert_array_equal(shown_left, left[0])
    np.testing.assert_array_equal(shown_right, right[0])


def test_one_picture_for_one_eye_is_not_taken_for_stereo(studio) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (3, 20, 32, 3), dtype=np.uint8)
    mono = np.repeat(np.repeat(frames, 8, axis=1), 8, axis=2)
    with pytest.raises(InputError, match="does not look like two eyes") as caught:
        open_clip(studio.video("mono.webm", mono))
    assert "second file" in caught.value.remedy


def test_frames_without_detail_are_split_by_shape(studio) -> None:
    clip = stereo(studio.video("grey.webm", np.full((2, 80, 192, 3), 90, dtype=np.uint8)))
    assert (clip.height, clip.width) == (80, 96)


def test_frames_without_detail_or_plausible_shape_ask_for_the_layout(studio) -> None:
    with pytest.raises(InputError, match="side by side or top-bottom") as caught:
        open_clip(studio.video("grey.webm", np.full((2, 64, 512, 3), 90, dtype=np.uint8)))
    assert caught.value.field == "options.layout"


def test_a_video_cut_in_half_is_refused(studio, tmp_path: Path) -> None:
    left, right = studio.eyes(frames=24)
    whole = studio.video("clip.webm", np.concatenate([left, right], axis=2))
    cut = tmp_path / "cut.webm"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(InputError, match="ends after") as caught:
        open_clip(cut)
    assert caught.value.field == "clip"


def test_an_mp4_whose_media_data_is_missing_is_refused(tmp_path: Path) -> None:
    data = bytearray(SBS_H264.read_bytes())
    start = data.index(b"mdat") + 4
    data[start + 1500 : start + 5000] = bytes(3500)
    path = tmp_path / "holes.mp4"
    path.write_bytes(data)
    with pytest.raises(InputError, match="has no header"):
        open_clip(path)


def test_an_mp4_cut_before_its_index_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.mp4"
    path.write_bytes(SBS_H264.read_bytes()[:3000])
    with pytest.raises(InputError, match="ends after the file does"):
        open_clip(path)


def test_other_codecs_are_refused_by_name(studio) -> None:
    left, right = studio.eyes()
    path = studio.video("clip.mp4", np.concatenate([left, right], axis=2), codec="mp4v")
    with pytest.raises(InputError, match="MPEG-4 part 2") as caught:
        open_clip(path)
    assert "H.264, HEVC, VP9 or Motion JPEG" in caught.value.remedy


def test_a_codec_hidden_in_an_accepted_container_is_refused(studio) -> None:
    left, right = studio.eyes()
    path = studio.video("clip.mkv", np.concatenate([left, right], axis=2), codec="FFV1")
    with pytest.raises(InputError, match="FFV1"):
        open_clip(path)


@pytest.mark.parametrize("name", ["notes.txt", "clip.mp4", "clip.avi"])
def test_a_file_that_is_no_video_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"RIFF this is no video that anyone could decode" * 10)
    with pytest.raises(InputError, match="is not an mp4, mov, mkv or webm file"):
        open_clip(path)


def test_an_empty_file_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").touch()
    with pytest.raises(InputError, match="0 bytes"):
        open_clip(tmp_path / "clip.mp4")
    with pytest.raises(InputError, match="does not exist"):
        open_clip(tmp_path / "nowhere.mp4")
    os.mkfifo(tmp_path / "pipe.mp4")
    with pytest.raises(InputError, match="not a readable file"):
        open_clip(tmp_path / "pipe.mp4")


def test_eyes_of_different_length_are_refused(studio) -> None:
    left, right = studio.eyes()
    with pytest.raises(InputError, match="right eye has 5 frames, the left 6") as caught:
        open_clip(studio.video("a.webm", left), studio.video("b.webm", right[:5]))
    assert caught.value.field == "right"


@pytest.mark.parametrize(("left_hz", "right_hz"), [(25.0, 50.0), (30.0, 25.0), (60.0, 50.0)])
def test_eyes_of_different_rates_are_refused(studio, left_hz: float, right_hz: float) -> None:
    left, right = studio.eyes()
    with pytest.raises(InputError, match=f"right eye has {right_hz:g} frames a second, the left {left_hz:g}") as caught:
        open_clip(studio.video("a.mp4", left, rate_hz=left_hz), studio.video("b.mp4", right, rate_hz=right_hz))
    assert caught.value.field == "right"


def test_eyes_in_different_containers_have_one_rate(studio) -> None:
    left, right = studio.eyes()
    clip = stereo(studio.video("a.mp4", left, rate_hz=120), right=studio.video("b.webm", right, rate_hz=120))
    assert clip.frame_count == 6


def test_eyes_of_different_size_are_refused(studio) -> None:
    left, right = studio.eyes()
    with pytest.raises(InputError, match="right eye is 80x80 pixels, the left 96x80"):
        open_clip(studio.video("a.webm", left), studio.video("b.webm", right[:, :, :80]))


@pytest.mark.parametrize(
    ("limits", "problem"),
    [
        (ClipLimits(frames=11), "the limit is 11"),
        (ClipLimits(pixels_per_frame=192 * 80 - 1), "192x80 pixels"),
        (ClipLimits(clip_bytes=CLIP_BYTES - 1), "holds 11"),
    ],
)
def test_clips_over_a_limit_are_refused(limits: ClipLimits, problem: str) -> None:
    with pytest.raises(LimitError, match=problem):
        open_clip(SBS_H264, limits=limits)


@pytest.mark.parametrize("limits", [ClipLimits(frames=11), ClipLimits(clip_bytes=CLIP_BYTES - 1)])
def test_limits_hold_while_decoding_where_the_header_says_nothing(limits: ClipLimits) -> None:
    with pytest.raises(LimitError):
        open_clip(DATA / "stereo_sbs_live.webm", limits=limits)


def test_a_clip_that_just_fits_is_accepted(studio) -> None:
    limits = ClipLimits(clip_bytes=CLIP_BYTES)
    assert stereo(SBS_H264, limits=limits).frame_count == 12
    left, right = (studio.video(name, eye) for name, eye in zip(("a.webm", "b.webm"), studio.eyes(12), strict=True))
    assert stereo(left, right=right, limits=limits).frame_count == 12
    with pytest.raises(LimitError, match="96x80 pixels"):
        open_clip(left, right, limits=ClipLimits(clip_bytes=CLIP_BYTES - 1))


def test_layouts_that_do_not_fit_a_video_are_refused() -> None:
    for layout in ("endonerf", "stereomis", "frames"):
        with pytest.raises(InputError, match="folder or zip"):
            open_with(SBS_H264, layout=layout)
    with pytest.raises(InputError, match="given: 'mono'"):
        open_with(SBS_H264, layout="mono")
    with pytest.raises(InputError, match="does not go with a second file"):
        open_with(SBS_H264, SBS_H264, layout="sbs")


@pytest.mark.skipif(not REAL_DATA.is_dir(), reason="needs INTRASPLAT_DATA")
def test_real_stereo_clips_open_without_being_told_anything() -> None:
    clip = stereo(REAL_DATA / "d4d_stereo/stereo_sbs.mp4", masks=REAL_DATA / "d4d_stereo/tool_masks.zip")
    assert (clip.frame_count, clip.height, clip.width) == (96, 540, 674)
    assert clip.tissue is not None
    assert 0.85 < clip.tissue.mean() < 0.95
    raw = stereo(REAL_DATA / "surgt_raw/video.mp4")
    assert (raw.frame_count, raw.height, raw.width) == (10, 1024, 1280)
    assert "side by side" in raw.assumptions[0].text
