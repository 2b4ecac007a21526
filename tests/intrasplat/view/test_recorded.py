"""Recorded frames and their masks: the same picture while a job trains and of its scene."""

from __future__ import annotations

import dataclasses
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip, Eye
from intrasplat.clip.recorded_masks import Rectification
from intrasplat.errors import InputError, SceneError
from intrasplat.names import RECORDED
from intrasplat.picture import RecordedMasks
from intrasplat.report import Masks, RecordedPixels
from intrasplat.scene.recorded_file import EYES, MAX_FRAME_BYTES
from intrasplat.view.recorded import MARK, MAX_MOMENTS, MAX_WIDTH, live_frame, recorded_files, stored_frame

FRAMES = 40


def clip(width: int = 64, height: int = 48, masks: Masks | None = None, frames: int = FRAMES) -> DepthClip:
    """Grey frames, each a step brighter, whose left third is masked."""
    shape = (frames, height, width)
    tissue = np.ones(shape, np.bool_)
    tissue[:, :, : width // 3] = False
    levels = (100 + np.arange(frames) % 100).astype(np.uint8)
    return DepthClip(
        rgb=np.broadcast_to(levels[:, None, None, None], (*shape, 3)).copy(),
        tissue=tissue,
        depth_mm=np.zeros(shape, np.float32),
        depth_confidence=np.zeros(shape, np.uint8),
        intrinsics=Intrinsics(width=width, height=height, fx=60, fy=60, cx=32, cy=24),
        world_from_camera=np.tile(np.eye(4), (frames, 1, 1)),
        frame_times_s=np.arange(frames) / 25,
        masks=masks or Masks(source="found", share=0.33, sure=0.9),
    )


def picture(jpeg: bytes) -> np.ndarray:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR))[..., ::-1].astype(int)


HUGE = bytes.fromhex("ffd8ffc0000b08ffffffff01011100")
"""The head of a JPEG of 65,535 x 65,535 pixels."""


def two_eyes() -> DepthClip:
    """The right eye is 50 levels darker and has its masks on the right."""
    left = clip()
    seen = {each.name: getattr(left, each.name) for each in dataclasses.fields(Eye)}
    seen |= {"rgb": left.rgb - 50, "tissue": left.tissue[:, :, ::-1].copy()}
    return dataclasses.replace(left, right=Eye(**seen))


def kept(tmp_path: Path, of: DepthClip, eyes: int = 1) -> Path:
    for name, content in recorded_files(of, EYES[:eyes], ())[0].items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
    return tmp_path


def mask_of(png: bytes) -> np.ndarray:
    """[h, w] grey; a browser reads 0 as transparent (tests/client/test_compare_in_browser.py)."""
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE))


def test_what_is_masked_is_marked_and_the_rest_is_as_recorded() -> None:
    index, jpeg = live_frame(clip(), 0.5)
    shown = picture(jpeg)
    assert index == 20
    assert shown.shape == (48, 64, 3)
    assert np.abs(shown[:, 40:] - 120).max() <= 3
    assert shown[24, 8, 2] - shown[24, 8, 0] > 60  # towards MARK, which is blue and green
    assert MARK[0] < MARK[2]


@pytest.mark.parametrize(("width", "shown"), [(720, (360, 720)), (1280, (320, 640)), (1920, (320, 640))])
def test_a_large_picture_is_made_smaller_by_a_whole_factor(width: int, shown: tuple[int, int]) -> None:
    assert shown[1] <= MAX_WIDTH
    assert picture(live_frame(clip(width, width // 2, frames=2), 0.0)[1]).shape == (*shown, 3)


@pytest.mark.parametrize(("t", "index"), [(0.0, 0), (0.13, 6), (5.0, FRAMES - 1)])
def test_frames_without_masks_are_passed_over(t: float, index: int) -> None:
    assert live_frame(dataclasses.replace(clip(), skipped=(5,)), t)[0] == index


@pytest.mark.parametrize("masks", RecordedMasks)
@pytest.mark.parametrize("eye", EYES)
def test_a_scene_keeps_every_frame_of_a_short_clip_as_it_was_shown_while_it_trained(
    tmp_path: Path, eye: str, masks: RecordedMasks
) -> None:
    found = two_eyes()
    path = kept(tmp_path, found, 2)
    for index in range(FRAMES):
        shown, content = stored_frame(path, FRAMES, index / FRAMES, eye, masks)  # type: ignore[arg-type]
        live, expected = live_frame(found, index / FRAMES, eye, masks)  # type: ignore[arg-type]
        assert (shown, live) == (index, index)
        if masks is RecordedMasks.MARKED:  # drawn on what the JPEG has kept
            assert np.abs(picture(content) - picture(expected)).mean() < 2
        else:
            assert content == expected


def test_a_mask_is_white_on_instruments_and_of_its_own_eye(tmp_path: Path) -> None:
    path = kept(tmp_path, two_eyes(), 2)
    left, right = (mask_of(stored_frame(path, FRAMES, 0.5, eye, RecordedMasks.ONLY)[1]) for eye in EYES)
    assert (left[:, :21] == 255).all()
    assert (left[:, 21:] == 0).all()
    assert (right == left[:, ::-1]).all()
    assert np.abs(picture(stored_frame(path, FRAMES, 0.5, "right", RecordedMasks.OFF)[1]) - 70).max() <= 2


def test_a_long_clip_is_thinned_and_the_report_says_to_which_frames(tmp_path: Path) -> None:
    count = 3 * MAX_MOMENTS
    long = clip(frames=count, width=16, height=12, masks=Masks(source="given", share=0.33))
    files, told = recorded_files(long, EYES[:1], ())
    assert recorded_files(long, EYES[:1], ()) == (files, told)
    assert len(told.frames) == MAX_MOMENTS
    assert (told.frames[0], told.frames[-1]) == (0, count - 1)
    assert max(np.diff(told.frames)) <= 4
    assert (told.eyes, told.width, told.height, told.masks, told.size_bytes) == (
        ("left",),
        16,
        12,
        True,
        len(files[RECORDED] or b""),
    )
    path = kept(tmp_path, long)
    shown = {stored_frame(path, count, index / count)[0] for index in range(count)}
    assert tuple(sorted(shown)) == told.frames


@pytest.mark.parametrize(("source", "frames"), [("found", 2 * FRAMES - 3), ("given", 2 * FRAMES)])
def test_frames_that_nobody_looked_at_are_kept_where_their_masks_are_known(source: str, frames: int) -> None:
    masks = Masks(source=source, share=0.33)  # type: ignore[arg-type]
    _, told = recorded_files(dataclasses.replace(clip(frames=2 * FRAMES, masks=masks), skipped=(4, 5, 6)), EYES[:1], ())
    assert len(told.frames) == frames


def test_a_clip_without_instruments_keeps_no_masks(tmp_path: Path) -> None:
    bare = clip()
    bare.tissue[:] = True
    assert not recorded_files(bare, EYES[:1], ())[1].masks
    path = kept(tmp_path, bare)
    plain, marked = (
        stored_frame(path, FRAMES, 0.5, "left", each) for each in (RecordedMasks.OFF, RecordedMasks.MARKED)
    )
    assert marked == plain
    with pytest.raises(InputError, match="no masks"):
        stored_frame(path, FRAMES, 0.5, "left", RecordedMasks.ONLY)


@pytest.mark.parametrize("masks", RecordedMasks)
def test_an_eye_that_is_not_there_is_told(tmp_path: Path, masks: RecordedMasks) -> None:
    with pytest.raises(InputError, match="right eye"):
        stored_frame(kept(tmp_path, clip()), FRAMES, 0.5, "right", masks)
    with pytest.raises(InputError, match="right eye"):
        live_frame(clip(), 0.5, "right", masks)


def test_a_scene_without_recorded_frames_is_told_from_a_damaged_one(tmp_path: Path) -> None:
    path = tmp_path / "recorded.zip"
    with pytest.raises(SceneError, match="keeps no recorded frames"):
        stored_frame(tmp_path, FRAMES, 0.0)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("000012.jpg", b"of an earlier program")
    with pytest.raises(SceneError, match="keeps no recorded frames"):
        stored_frame(tmp_path, FRAMES, 0.0)


@pytest.mark.parametrize("content", [b"", b"PK", b"x" * 100])
def test_a_damaged_file_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "recorded.zip"
    path.write_bytes(content)
    with pytest.raises(SceneError, match="cannot be read"):
        stored_frame(tmp_path, FRAMES, 0.0)


@pytest.mark.parametrize(("jpeg", "png"), [(b"", b""), (b"JPEG", b""), (None, b"PNG"), (None, None), (HUGE, None)])
def test_a_damaged_picture_or_a_mask_of_another_size_is_told(
    tmp_path: Path, jpeg: bytes | None, png: bytes | None
) -> None:
    path = tmp_path / "recorded.zip"
    other = live_frame(clip(32, 24), 0.0, "left", RecordedMasks.ONLY)[1]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("left/000000.jpg", live_frame(clip(), 0.0)[1] if jpeg is None else jpeg)
        archive.writestr("left/000000.png", other if png is None else png)
    with pytest.raises(SceneError, match="recorded frame of this scene"):
        stored_frame(tmp_path, FRAMES, 0.0)


def test_a_file_that_would_fill_the_memory_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "recorded.zip"
    for how, size in ((zipfile.ZIP_DEFLATED, 10), (zipfile.ZIP_STORED, MAX_FRAME_BYTES + 1)):
        with zipfile.ZipFile(path, "w", how) as archive:
            archive.writestr("left/000000.jpg", bytes(size))
        with pytest.raises(SceneError, match="cannot be read"):
            stored_frame(tmp_path, FRAMES, 0.0)


def test_the_report_says_which_recorded_pixel_a_frame_shows() -> None:
    """Here without distortion, which the page's own test has (tests/client/test_brush_in_browser.py)."""
    turned = cv2.Rodrigues(np.array([0.02, -0.05, 0.03]))[0]
    done = Rectification(
        camera=((60.0, 0.0, 31.0), (0.0, 61.0, 22.0), (0.0, 0.0, 1.0)),
        distortion=(),
        rotation=tuple(map(tuple, turned.tolist())),
        projection=((58.0, 0.0, 30.0, 0.0), (0.0, 58.0, 25.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
    )
    pixels = recorded_files(dataclasses.replace(clip(), rectification=done), EYES[:1], ())[1].pixels
    assert pixels is not None
    x, y = np.meshgrid(np.arange(pixels.width), np.arange(pixels.height))
    rays = np.reshape(pixels.rays, (3, 3)) @ np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    found = (np.reshape(pixels.camera, (3, 3)) @ (rays / rays[2]))[:2].reshape(2, *x.shape)
    moved = [np.array(each) for each in (done.camera, np.zeros(5), done.rotation, done.projection)]
    maps = cv2.initUndistortRectifyMap(*moved, (pixels.width, pixels.height), cv2.CV_32FC1)
    np.testing.assert_allclose(found, maps, atol=1e-3)
    assert np.abs(maps[0] - x).max() > 2
    plain = recorded_files(clip(2 * MAX_WIDTH, frames=1), EYES[:1], ())[1]
    assert plain.width == MAX_WIDTH
    assert plain.pixels == RecordedPixels(width=2 * MAX_WIDTH, height=48)
