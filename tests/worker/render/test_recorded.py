"""Recorded frames with marked masks: the same picture while a job trains and of its scene."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from contract.wire.errors import SceneError
from contract.wire.report import Masks
from worker.input.camera import Intrinsics
from worker.input.clip import DepthClip
from worker.render.recorded import MARK, MAX_KEPT, MAX_WIDTH, marked_frame, marked_frames, stored_frame

FRAMES = 40


def clip(width: int = 64, height: int = 48, masks: Masks | None = None) -> DepthClip:
    """Grey frames, each a step brighter, whose left third is masked."""
    shape = (FRAMES, height, width)
    tissue = np.ones(shape, np.bool_)
    tissue[:, :, : width // 3] = False
    levels = 100 + np.arange(FRAMES, dtype=np.uint8)
    return DepthClip(
        rgb=np.broadcast_to(levels[:, None, None, None], (*shape, 3)).copy(),
        tissue=tissue,
        depth_mm=np.zeros(shape, np.float32),
        depth_confidence=np.zeros(shape, np.uint8),
        intrinsics=Intrinsics(width=width, height=height, fx=60, fy=60, cx=32, cy=24),
        world_from_camera=np.tile(np.eye(4), (FRAMES, 1, 1)),
        frame_times_s=np.arange(FRAMES) / 25,
        masks=masks or Masks(source="found", share=0.33, sure=0.9),
    )


def picture(jpeg: bytes) -> np.ndarray:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR))[..., ::-1].astype(int)


def test_what_is_masked_is_marked_and_the_rest_is_as_recorded() -> None:
    index, jpeg = marked_frame(clip(), 0.5)
    shown = picture(jpeg)
    assert index == 20
    assert shown.shape == (48, 64, 3)
    assert np.abs(shown[:, 40:] - 120).max() <= 3
    assert shown[24, 8, 2] - shown[24, 8, 0] > 60  # towards MARK, which is blue and green
    assert MARK[0] < MARK[2]


def test_a_large_picture_is_made_smaller() -> None:
    assert picture(marked_frame(clip(960, 480), 0.0)[1]).shape == (MAX_WIDTH // 2, MAX_WIDTH, 3)


@pytest.mark.parametrize(("t", "index"), [(0.0, 0), (0.13, 6), (5.0, FRAMES - 1)])
def test_frames_without_masks_are_passed_over(t: float, index: int) -> None:
    assert marked_frame(dataclasses.replace(clip(), left_out=(5,)), t)[0] == index


def test_a_scene_keeps_some_of_the_same_pictures(tmp_path: Path) -> None:
    path, found = tmp_path / "recorded.zip", clip()
    content = marked_frames(found)
    assert content is not None
    assert marked_frames(found) == content
    path.write_bytes(content)
    shown = dict(stored_frame(path, index / FRAMES, FRAMES) for index in range(FRAMES))
    assert len(shown) == MAX_KEPT
    assert {0, FRAMES - 1} <= shown.keys()
    assert all(marked_frame(found, index / FRAMES) == (index, jpeg) for index, jpeg in shown.items())


def test_a_scene_whose_masks_were_given_keeps_none(tmp_path: Path) -> None:
    assert marked_frames(clip(masks=Masks(source="given", share=0.33))) is None
    with pytest.raises(SceneError, match="keeps no recorded frames"):
        stored_frame(tmp_path / "recorded.zip", 0.0, FRAMES)


@pytest.mark.parametrize("content", [b"", b"PK", b"x" * 100])
def test_a_damaged_file_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "recorded.zip"
    path.write_bytes(content)
    with pytest.raises(SceneError, match="cannot be read"):
        stored_frame(path, 0.0, FRAMES)
