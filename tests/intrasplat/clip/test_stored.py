"""A clip with depth that was kept in a folder comes back as it was, or not at all."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import DepthClip, Eye
from intrasplat.clip.stored import MANIFEST, load_clip, save_clip
from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import RightEye
from tests.intrasplat.phantoms import phantom_clip

REGISTRATION = RightEye(
    moved_px=1.5, lower_px=0.5, pitch_deg=0.1, yaw_deg=0.2, roll_deg=0.3, zoom=0.01,
    left_from_right=tuple(float(each) for each in np.eye(4).ravel()), fx_px=90, fy_px=91, cx_px=48, cy_px=40,
    residual_px=0.2, gain=(1.0, 1.0, 1.0), offset=(0.0, 0.0, 0.0), colour_correlation=0.9,
)  # fmt: skip


def clip_of(eyes: int) -> DepthClip:
    """A clip with something in every field."""
    told = {
        "skipped": (2, 5),
        "assumptions": (Notice.info(NoticeCode.DECODING, "it was decoded"),),
        "warnings": (Notice.warning(NoticeCode.TIME_TOO_SHORT, "too short"),),
        "measurements": {"valid_share": 0.5},
    }
    clip = dataclasses.replace(phantom_clip(), **told)
    if eyes == 1:
        return clip
    other = phantom_clip("pull")
    right = Eye(**{field.name: getattr(other, field.name) for field in dataclasses.fields(Eye)})
    return dataclasses.replace(clip, right=right, registration=REGISTRATION)


def assert_same(found: object, expected: object) -> None:
    """Every field is equal, arrays by type and bits."""
    assert type(found) is type(expected)
    if dataclasses.is_dataclass(expected):
        for field in dataclasses.fields(expected):
            assert_same(getattr(found, field.name), getattr(expected, field.name))
    elif isinstance(expected, np.ndarray):
        assert isinstance(found, np.ndarray)
        assert found.dtype == expected.dtype
        assert np.array_equal(found, expected)
    else:
        assert found == expected


@pytest.mark.parametrize("eyes", [1, 2])
def test_a_kept_clip_comes_back_with_every_field(eyes: int, tmp_path: Path) -> None:
    clip = clip_of(eyes)
    save_clip(tmp_path / "kept", clip, "of this file")
    loaded = load_clip(tmp_path / "kept", "of this file")
    assert loaded is not None
    assert_same(loaded, clip)
    for path in (tmp_path / "kept").iterdir():
        path.unlink()
    assert_same(loaded, clip)


def test_a_clip_made_of_something_else_is_not_taken(tmp_path: Path) -> None:
    save_clip(tmp_path, clip_of(1), "of this file")
    assert load_clip(tmp_path, "of another file") is None
    assert load_clip(tmp_path / "nothing", "of this file") is None


@pytest.mark.parametrize("name", [MANIFEST, "left_rgb.npy", "left_depth_mm.npy"])
@pytest.mark.parametrize("content", [None, b"", b"{}", b"half"])
def test_a_folder_that_is_not_whole_holds_nothing(name: str, content: bytes | None, tmp_path: Path) -> None:
    save_clip(tmp_path, clip_of(1), "of this file")
    (tmp_path / name).unlink()
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert load_clip(tmp_path, "of this file") is None


def test_keeping_a_clip_stops_when_told_to_and_leaves_nothing(tmp_path: Path) -> None:
    asked = iter([False] * 5 + [True])
    save_clip(tmp_path / "kept", clip_of(1), "of this file", lambda: next(asked))
    assert not (tmp_path / "kept").exists()
