"""Masks: where they come from, what white means, and when nobody can tell."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import StereoClip, open_clip
from intrasplat.errors import InputError
from intrasplat.notices import Notice
from tests.intrasplat.clips import open_with


@pytest.fixture
def frames(studio) -> Path:
    """Six stereo frames without masks."""
    left, right = studio.eyes()
    studio.images("clip/left/{}.png", left)
    studio.images("clip/right/{}.png", right)
    return studio.root / "clip"


def texts(notices: Iterable[Notice]) -> list[str]:
    return [notice.text for notice in notices]


def tissue_of(path: Path, **options) -> NDArray[np.bool_]:
    clip = open_with(path, **options)
    assert isinstance(clip, StereoClip)
    assert clip.tissue is not None
    return clip.tissue


def test_without_masks_there_is_no_tissue_map_and_the_clip_says_so(frames: Path) -> None:
    clip = open_clip(frames)
    assert isinstance(clip, StereoClip)
    assert clip.tissue is None
    assert "masks: none given, every pixel is tissue" in texts(clip.assumptions)


def test_folder_zip_and_video_of_masks_agree(studio, frames: Path) -> None:
    tool = studio.tool()
    folder = studio.masks("masks", tool)
    video = studio.video("masks.webm", np.repeat(np.where(tool, np.uint8(255), np.uint8(0))[..., None], 3, axis=3))
    for masks in (folder, studio.zip(folder, "masks.zip"), studio.zip(folder, "deep.zip", "some/folder/")):
        np.testing.assert_array_equal(tissue_of(frames, masks=masks), ~tool)
    assert (tissue_of(frames, masks=video) != ~tool).mean() < 0.01


def test_masks_that_lie_beside_the_frames_are_used(studio, frames: Path) -> None:
    studio.masks("clip/masks", studio.tool())
    np.testing.assert_array_equal(tissue_of(frames), ~studio.tool())


@pytest.mark.parametrize("white", ["tool", "tissue"])
def test_the_class_on_the_border_with_the_smaller_area_is_the_tool(studio, frames: Path, white: str) -> None:
    tool = studio.tool()
    masks = studio.masks("masks", tool if white == "tool" else ~tool)
    clip = open_clip(frames, masks=masks)
    np.testing.assert_array_equal(clip.tissue, ~tool)
    assert any(f"white is {white}" in assumption.text for assumption in clip.assumptions)


def test_what_was_told_wins_over_the_look(studio, frames: Path) -> None:
    clip = open_with(frames, masks=studio.masks("masks", studio.tool()), mask_polarity="tissue")
    np.testing.assert_array_equal(clip.tissue, studio.tool())
    assert "masks: white is tissue (as specified)" in texts(clip.assumptions)


def test_a_small_class_that_touches_no_border_asks_for_the_polarity(studio, frames: Path) -> None:
    island = np.zeros((6, 80, 96), dtype=np.bool_)
    island[:, 30:50, 30:50] = True
    for marked in (island, ~island):
        with pytest.raises(InputError, match="cannot tell whether white or black") as caught:
            open_clip(frames, masks=studio.masks("masks", marked))
        assert "mask_polarity" in caught.value.remedy


def test_classes_of_like_area_ask_for_the_polarity(studio, frames: Path) -> None:
    half = np.zeros((6, 80, 96), dtype=np.bool_)
    half[:, :40] = True
    with pytest.raises(InputError, match="cannot tell whether white or black"):
        open_clip(frames, masks=studio.masks("masks", half))


def test_masks_that_contradict_their_layout_ask_for_the_polarity(studio) -> None:
    folder = studio.endonerf()
    studio.masks("endonerf/masks", ~studio.tool(3, 64, 80))
    with pytest.raises(InputError, match="the masks look inverted"):
        open_clip(folder)
    np.testing.assert_array_equal(tissue_of_depth(folder, "tissue"), ~studio.tool(3, 64, 80))


def tissue_of_depth(folder: Path, polarity: str) -> NDArray[np.bool_]:
    return open_with(folder, mask_polarity=polarity).tissue


@pytest.mark.parametrize("white", [False, True])
def test_masks_that_mark_nothing_are_refused(studio, frames: Path, white: bool) -> None:
    masks = studio.masks("masks", np.full((6, 80, 96), white))
    with pytest.raises(InputError, match="nothing is marked") as caught:
        open_clip(frames, masks=masks)
    assert caught.value.field == "masks"


def test_told_masks_may_mark_no_tool_but_not_everything(studio, frames: Path) -> None:
    masks = studio.masks("masks", np.zeros((6, 80, 96), dtype=np.bool_))
    clip = open_with(frames, masks=masks, mask_polarity="tool")
    assert clip.tissue is not None
    assert clip.tissue.all()
    assert "the masks mark no instrument in any frame" in texts(clip.warnings)
    with pytest.raises(InputError, match="every pixel of every mask is tool"):
        open_with(frames, masks=masks, mask_polarity="tissue")


def test_grey_edges_are_cut_at_half(studio, frames: Path) -> None:
    tool = studio.tool()
    grey = np.where(tool, np.uint8(128), np.uint8(127))
    np.testing.assert_array_equal(tissue_of(frames, masks=studio.images("masks/{}.png", grey)), ~tool)


def test_coloured_and_16_bit_masks_are_read(studio, frames: Path) -> None:
    tool = studio.tool()
    red = np.zeros((6, 80, 96, 3), dtype=np.uint8)
    red[..., 0] = np.where(tool, 255, 0)
    np.testing.assert_array_equal(tissue_of(frames, masks=studio.images("red/{}.png", red)), ~tool)
    deep = np.where(tool, np.uint16(65535), np.uint16(0))
    np.testing.assert_array_equal(tissue_of(frames, masks=studio.images("deep/{}.png", deep)), ~tool)


def test_masks_of_another_count_or_size_are_refused(studio, frames: Path) -> None:
    with pytest.raises(InputError, match="5 masks for 6 frames"):
        open_clip(frames, masks=studio.masks("few", studio.tool(5)))
    with pytest.raises(InputError, match="masks are 48x40 pixels, the left eye is 96x80"):
        open_clip(frames, masks=studio.masks("small", studio.tool(6, 40, 48)))


def test_masks_that_do_not_fit_are_refused_before_they_are_decoded(studio, frames: Path) -> None:
    """Their pixels are cut off, which nobody notices: number and size stand in the headers."""
    for name, shape in (("few", (5, 80, 96)), ("small", (6, 40, 48))):
        folder = studio.masks(name, studio.tool(*shape))
        for path in folder.iterdir():
            path.write_bytes(path.read_bytes()[:40])
        with pytest.raises(InputError, match=r"5 masks for 6 frames|48x40 pixels"):
            open_clip(frames, masks=folder)
    endonerf = studio.endonerf(frames=3)
    for masks in (studio.root / "few", studio.root / "small"):
        with pytest.raises(InputError, match="masks for 3 frames"):
            open_clip(endonerf, masks=masks)


def test_masks_that_are_missing_or_unreadable_are_refused(frames: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist") as caught:
        open_clip(frames, masks=tmp_path / "nowhere")
    assert caught.value.field == "masks"
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="holds no PNG or JPEG images"):
        open_clip(frames, masks=tmp_path / "none")


def right_tool(studio) -> NDArray[np.bool_]:
    """The tool as the right eye sees it: farther left, and cut off by the border."""
    return np.roll(studio.tool(), -8, axis=2) & (np.arange(96) < 88)


def masked(path: Path, **options) -> StereoClip:
    clip = open_with(path, **options)
    assert isinstance(clip, StereoClip)
    return clip


def test_masks_of_the_left_eye_alone_leave_the_right_eye_to_stereo(studio, frames: Path) -> None:
    clip = masked(frames, masks=studio.masks("masks", studio.tool()))
    assert clip.tissue_right is None
    assert "masks of the right eye: the left eye's, moved by depth" in texts(clip.assumptions)


@pytest.mark.parametrize("packing", ["sbs", "tb"])
@pytest.mark.parametrize("odd", [0, 1])
def test_masks_packed_like_a_stereo_frame_are_those_of_both_eyes(studio, frames: Path, packing: str, odd: int) -> None:
    tools = (studio.tool(), right_tool(studio))
    axis = 2 if packing == "sbs" else 1
    middle = np.ones((6, 80, odd) if packing == "sbs" else (6, odd, 96), np.bool_)
    packed = np.concatenate([tools[0], middle, tools[1]], axis=axis)
    clip = masked(frames, masks=studio.masks("masks", packed))
    np.testing.assert_array_equal(clip.tissue, ~tools[0])
    np.testing.assert_array_equal(clip.tissue_right, ~tools[1])
    assert "masks of the right eye: as given" in texts(clip.assumptions)


def test_a_video_of_packed_masks_is_of_both_eyes(studio, frames: Path) -> None:
    packed = np.concatenate([studio.tool(), right_tool(studio)], axis=2)
    white = np.repeat(np.where(packed, np.uint8(255), np.uint8(0))[..., None], 3, axis=3)
    clip = masked(frames, masks=studio.video("masks.webm", white))
    assert clip.tissue_right is not None
    assert (clip.tissue_right != ~right_tool(studio)).mean() < 0.01


def mask_video(studio, name: str, tool: NDArray[np.bool_]) -> Path:
    return studio.video(name, np.repeat(np.where(tool, np.uint8(255), np.uint8(0))[..., None], 3, axis=3))


@pytest.mark.parametrize("names", [("left.webm", "right.webm"), ("tool_l.webm", "tool_r.webm")])
@pytest.mark.parametrize("kind", ["zip", "folder", "beside"])
def test_two_videos_of_masks_named_left_and_right_are_of_both_eyes(
    studio, frames: Path, names: tuple[str, str], kind: str
) -> None:
    folder = "clip/masks" if kind == "beside" else "given"
    for name, tool in zip(names, (studio.tool(), right_tool(studio)), strict=True):
        mask_video(studio, f"{folder}/{name}", tool)
    given = {"zip": lambda: studio.zip(studio.root / "given", "masks.zip"), "folder": lambda: studio.root / "given"}
    clip = masked(frames) if kind == "beside" else masked(frames, masks=given[kind]())
    assert clip.tissue is not None
    assert clip.tissue_right is not None
    assert (clip.tissue != ~studio.tool()).mean() < 0.01
    assert (clip.tissue_right != ~right_tool(studio)).mean() < 0.01
    assert "masks of the right eye: as given" in texts(clip.assumptions)


@pytest.mark.parametrize(
    "names", [("a.webm", "b.webm"), ("left.webm", "right.webm", "more.webm"), ("left_a.webm", "left_b.webm")]
)
def test_several_videos_of_masks_that_name_no_pair_of_eyes_are_refused(studio, frames: Path, names) -> None:
    for name in names:
        mask_video(studio, f"given/{name}", studio.tool())
    with pytest.raises(InputError, match=f"holds {len(names)} videos") as caught:
        open_clip(frames, masks=studio.root / "given")
    assert caught.value.field == "masks"
    assert "two named left and right" in caught.value.remedy


def test_videos_of_masks_that_differ_in_number_or_size_are_refused(studio, frames: Path) -> None:
    mask_video(studio, "few/left.webm", studio.tool())
    mask_video(studio, "few/right.webm", studio.tool(5))
    with pytest.raises(InputError, match="there are 5 masks of the right eye for 6 frames"):
        open_clip(frames, masks=studio.root / "few")
    mask_video(studio, "small/left.webm", studio.tool())
    mask_video(studio, "small/right.webm", studio.tool(6, 64, 80))
    with pytest.raises(InputError, match="masks are 80x64 pixels, the right eye is 96x80"):
        open_clip(frames, masks=studio.root / "small")


@pytest.mark.parametrize("pattern", ["{eye}/{number}.png", "{number}{letter}.png", "{number}_{eye}.png"])
@pytest.mark.parametrize("beside", [False, True])
def test_masks_whose_names_name_both_eyes_are_of_both(studio, frames: Path, pattern: str, beside: bool) -> None:
    folder = "clip/masks/" if beside else "given/"
    for eye, tool in (("left", studio.tool()), ("right", right_tool(studio))):
        studio.masks_named(folder + pattern.format(eye=eye, letter=eye[0], number="{}"), tool)
    clip = masked(frames) if beside else masked(frames, masks=studio.root / "given")
    np.testing.assert_array_equal(clip.tissue, ~studio.tool())
    np.testing.assert_array_equal(clip.tissue_right, ~right_tool(studio))


def test_the_left_eye_decides_what_white_means_in_both(studio, frames: Path) -> None:
    """In the right eye the tool covers most of the picture: by its look it would be tissue."""
    large = np.ones((6, 80, 96), np.bool_)
    large[:, 60:, 60:] = False
    clip = masked(frames, masks=studio.masks("masks", np.concatenate([studio.tool(), large], axis=2)))
    np.testing.assert_array_equal(clip.tissue_right, ~large)


def test_a_right_eye_without_any_tissue_is_refused(studio, frames: Path) -> None:
    packed = np.concatenate([studio.tool(), np.ones((6, 80, 96), np.bool_)], axis=2)
    with pytest.raises(InputError, match="every pixel of every mask of the right eye is tool"):
        open_clip(frames, masks=studio.masks("masks", packed))


def test_masks_of_the_eyes_that_differ_in_number_or_size_are_refused(studio, frames: Path) -> None:
    studio.masks_named("few/left/{}.png", studio.tool())
    studio.masks_named("few/right/{}.png", studio.tool(5))
    with pytest.raises(InputError, match="there are 5 files like right/"):
        open_clip(frames, masks=studio.root / "few")
    studio.masks_named("small/left/{}.png", studio.tool())
    studio.masks_named("small/right/{}.png", studio.tool(6, 40, 48))
    with pytest.raises(InputError, match="masks are 48x40 pixels, the right eye is 96x80"):
        open_clip(frames, masks=studio.root / "small")


def test_a_clip_of_one_eye_takes_the_left_masks_alone(studio) -> None:
    folder = studio.endonerf()
    for eye, tool in (("left", studio.tool(3, 64, 80)), ("right", ~studio.tool(3, 64, 80))):
        studio.masks_named(f"given/{eye}/{{}}.png", tool)
    clip = open_with(folder, masks=studio.root / "given")
    np.testing.assert_array_equal(clip.tissue, ~studio.tool(3, 64, 80))
    packed = np.concatenate([studio.tool(3, 64, 80)] * 2, axis=2)
    with pytest.raises(InputError, match="the masks are 160x64 pixels, the left eye is 80x64"):
        open_with(folder, masks=studio.masks("packed", packed))
