"""Interlaced video: found by its pictures, whatever the container says, and deinterlaced."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from intrasplat.clip import ClipLimits
from intrasplat.clip.video import VideoFile, open_video
from intrasplat.notices import NoticeCode
from tests.intrasplat.clip.recorder import Frames, record, telecined, woven
from tests.intrasplat.clips import open_with

CODED_INTERLACED = {"flags": "+ilme+ildct", "x264-params": "tff=1"}
HEIGHT, WIDTH = 96, 160


def film(frames: int, step_px: float = 3.0) -> Frames:
    """A blotchy texture that moves to the right, RGB [T, H, W, 3]."""
    noise = np.random.default_rng(5).integers(30, 226, (HEIGHT // 6, 2 * WIDTH // 6), dtype=np.uint8)
    grey = cv2.resize(noise, (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    shifts = [np.float32([[1, 0, index * step_px - WIDTH / 2], [0, 1, 0]]) for index in range(frames)]
    moved = [cv2.warpAffine(grey, shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT) for shift in shifts]
    return np.repeat(np.stack(moved)[..., None], 3, axis=3)


def masks(frames: int) -> Frames:
    """A tool that moves in from the left, white, RGB [T, H, W, 3]."""
    shown = np.zeros((frames, HEIGHT, WIDTH, 3), np.uint8)
    for index, mask in enumerate(shown):
        mask[30:70, : 20 + 4 * index] = 255
    return shown


def opened(path: Path) -> VideoFile:
    return open_video(path, "clip", ClipLimits())


def said(video: VideoFile) -> list[str]:
    return [each.text for each in video.notices if each.code is NoticeCode.INTERLACED]


def psnr_db(video: VideoFile, truth: Frames) -> float:
    shown = np.stack(list(video.frames()))
    assert shown.shape == truth.shape
    return float(10 * np.log10(255**2 / np.mean((shown.astype(float) - truth) ** 2)))


@pytest.mark.parametrize("order", ["tff", "bff"])
@pytest.mark.parametrize("options", [CODED_INTERLACED, {}], ids=["coded as interlaced", "coded as progressive"])
def test_fields_are_found_whatever_the_container_says(tmp_path: Path, order: str, options: dict[str, str]) -> None:
    whole = film(24)
    video = opened(record(tmp_path / "fields.mp4", woven(whole, order), options=options))
    combed = float(10 * np.log10(255**2 / np.mean((woven(whole, order).astype(float) - whole[0::2]) ** 2)))
    assert psnr_db(video, whole[0::2]) > combed + 4  # at the moment of the first field
    assert "12 of 12 were deinterlaced" in said(video)[0]
    assert video.interlacing is not None
    assert video.interlacing.order == order


@pytest.mark.parametrize("step_px", [0.0, 0.4, 6.0])
def test_progressive_frames_that_are_coded_as_interlaced_stay(tmp_path: Path, step_px: float) -> None:
    whole = film(12, step_px)
    video = opened(record(tmp_path / "psf.mp4", whole, options=CODED_INTERLACED))
    assert video.interlacing is None
    assert psnr_db(video, whole) > 36
    assert "each frame shows one moment" in said(video)[0]


@pytest.mark.parametrize("noise", [0, 6, 15])
def test_progressive_frames_stay_bit_for_bit_with_noise_and_vertical_motion(tmp_path: Path, noise: int) -> None:
    random = np.random.default_rng(1)
    rolled = np.stack([np.roll(frame, index, axis=0) for index, frame in enumerate(film(12))])
    noisy = np.clip(rolled + random.normal(0, noise, rolled.shape), 0, 255).astype(np.uint8)
    video = opened(record(tmp_path / "plain.mkv", noisy))
    assert video.interlacing is None
    assert said(video) == []


def test_telecined_film_is_deinterlaced_where_it_combs(tmp_path: Path) -> None:
    video = opened(record(tmp_path / "telecine.mp4", telecined(film(24, 5.0))))
    assert video.interlacing is not None
    assert sorted(video.interlacing.frames) == [5 * group + each for group in range(6) for each in (2, 3)]
    assert "12 of 30 were deinterlaced" in said(video)[0]
    frames = list(video.frames())
    assert np.abs(frames[0].astype(float) - film(1)[0]).mean() < 3


def test_a_video_that_turns_interlaced_is_deinterlaced_from_there_on(tmp_path: Path) -> None:
    whole = film(32)
    mixed = np.concatenate([whole[:16:2], woven(whole[16:])])
    video = opened(record(tmp_path / "mixed.mp4", mixed))
    assert video.interlacing is not None
    assert sorted(video.interlacing.frames) == list(range(8, 16))


def test_masks_as_interlaced_video_are_rebuilt_and_say_so(tmp_path: Path) -> None:
    left = film(24)
    clip = record(tmp_path / "clip.mp4", np.concatenate([left[0::2], left[0::2]], axis=2))
    truth = masks(24)
    for options in ({}, CODED_INTERLACED):
        path = record(tmp_path / "masks.mp4", woven(truth), options=options)
        opened_clip = open_with(clip, masks=path, layout="sbs")
        assert opened_clip.tissue is not None
        wrong = (opened_clip.tissue == (truth[0::2, :, :, 0] >= 128)).mean()
        assert wrong < 0.01
        assert any(each.text.startswith("masks: interlaced video") for each in opened_clip.assumptions)


def test_fields_in_ten_bits_are_found(tmp_path: Path) -> None:
    video = opened(record(tmp_path / "ten.mp4", woven(film(16)), codec="libx265", pixel_format="yuv420p10le"))
    assert video.interlacing is not None
    assert len(video.interlacing.frames) == 8
