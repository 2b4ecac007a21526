"""Masks of several levels: the parts of an instrument are instrument, and what may be an organ is asked about."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import StereoClip
from intrasplat.errors import InputError
from intrasplat.notices import NoticeCode
from tests.intrasplat.clips import open_with


@pytest.fixture
def frames(studio) -> Path:
    """Six stereo frames without masks."""
    left, right = studio.eyes()
    studio.images("clip/left/{}.png", left)
    studio.images("clip/right/{}.png", right)
    return studio.root / "clip"


def parts(studio, *levels: int, tissue: int = 0) -> NDArray[np.uint8]:
    """The studio's tool in pieces from the border to its tip, each of one level [T, H, W]."""
    tool = studio.tool()
    pieces = np.minimum(np.arange(tool.shape[2]) * len(levels) // 48, len(levels) - 1)
    return np.where(tool, np.array(levels, np.uint8)[pieces], np.uint8(tissue))


def read(path: Path, masks: Path, **options: object) -> StereoClip:
    clip = open_with(path, masks=masks, **options)
    assert isinstance(clip, StereoClip)
    return clip


def told(clip: StereoClip) -> list[str]:
    return [each.text for each in clip.warnings if each.code is NoticeCode.MASK_LEVELS]


LEVELS = {
    "shaft 255, jaw 100": (255, 100),
    "shaft 100, jaw 255": (100, 255),
    "EndoVis 2017 as released": (10, 20, 30, 40),
    "EndoVis 2017 as trained on": (85, 170, 255),
    "class ids": (1, 2, 3),
}


@pytest.mark.parametrize("levels", LEVELS.values(), ids=LEVELS)
@pytest.mark.parametrize("polarity", ["auto", "tool"])
def test_every_level_of_an_instrument_is_instrument(
    studio, frames: Path, levels: tuple[int, ...], polarity: str
) -> None:
    clip = read(frames, studio.images("masks/{}.png", parts(studio, *levels)), mask_polarity=polarity)
    np.testing.assert_array_equal(clip.tissue, ~studio.tool())
    listed = ", ".join(map(str, sorted(levels)))
    assert f"levels {listed} are instrument, 0 is tissue" in told(clip)[0]


@pytest.mark.parametrize("polarity", ["auto", "tissue"])
def test_where_the_highest_level_is_tissue_all_others_are_instrument(studio, frames: Path, polarity: str) -> None:
    masks = studio.images("masks/{}.png", parts(studio, 0, 100, 180, tissue=255))
    clip = read(frames, masks, mask_polarity=polarity)
    np.testing.assert_array_equal(clip.tissue, ~studio.tool())
    assert "levels 0, 100, 180 are instrument, 255 is tissue" in told(clip)[0]


@pytest.mark.parametrize("level", [1, 40, 100])
def test_one_low_level_is_the_instrument_and_no_warning(studio, frames: Path, level: int) -> None:
    clip = read(frames, studio.images("masks/{}.png", parts(studio, level)))
    np.testing.assert_array_equal(clip.tissue, ~studio.tool())
    assert told(clip) == []
    assert any(f"masks: level {level} is instrument, 0 is tissue" in each.text for each in clip.assumptions)


def test_labels_in_16_bits_and_in_colours_are_read(studio, frames: Path) -> None:
    deep = studio.images("deep/{}.png", parts(studio, 1, 2, 3).astype(np.uint16))
    np.testing.assert_array_equal(read(frames, deep).tissue, ~studio.tool())
    palette = np.zeros((4, 3), np.uint8)
    palette[1:] = (0, 255, 0), (0, 255, 255), (125, 255, 12)  # shaft, clasper, wrist of EndoVis 2018
    clip = read(frames, studio.images("colours/{}.png", palette[parts(studio, 1, 2, 3)]))
    np.testing.assert_array_equal(clip.tissue, ~studio.tool())
    assert "4 classes" in told(clip)[0]
    assert "all colours but black are instrument" in told(clip)[0]


def test_edges_that_a_coder_or_resizing_made_are_no_levels(studio, frames: Path) -> None:
    tool = np.where(studio.tool(), np.uint8(255), np.uint8(0))
    soft = np.stack([cv2.resize(cv2.resize(each, (24, 20)), (96, 80), interpolation=cv2.INTER_CUBIC) for each in tool])
    for name in ("masks/{}.png", "masks_jpeg/{}.jpg"):
        clip = read(frames, studio.images(name, soft))
        assert told(clip) == []
        assert clip.tissue is not None
        assert (clip.tissue == studio.tool()).mean() < 0.02


def test_lossy_masks_have_levels_too(studio, frames: Path) -> None:
    clip = read(frames, studio.images("masks/{}.jpg", parts(studio, 100, 255)))
    assert clip.tissue is not None
    assert (clip.tissue == studio.tool()).mean() < 0.02
    assert len(told(clip)) == 1


def test_many_classes_may_have_organs_among_them_and_are_asked_about(studio, frames: Path) -> None:
    masks = studio.images("masks/{}.png", parts(studio, 1, 2, 3, 4, 5, 6))
    with pytest.raises(InputError, match="7 classes, perhaps organs among them") as caught:
        read(frames, masks)
    assert caught.value.field == "masks"
    np.testing.assert_array_equal(read(frames, masks, mask_polarity="tool").tissue, ~studio.tool())


def test_levels_of_which_none_fills_most_of_the_picture_are_asked_about(studio, frames: Path) -> None:
    """A black border around tissue of 128, with an instrument of 255."""
    masks = parts(studio, 255, tissue=128)
    masks[:, 50:] = 0
    with pytest.raises(InputError, match=r"cannot tell which levels mark .*0 \(.*128 \(.*255 \(") as caught:
        read(frames, studio.images("masks/{}.png", masks))
    assert "mask_polarity" in caught.value.remedy


def test_a_layout_with_parts_keeps_its_rule(studio) -> None:
    folder = studio.endonerf()
    tool = studio.tool(3, 64, 80)
    jaws = tool & (np.arange(80) > 20)
    studio.images("endonerf/masks/{}.png", np.where(jaws, np.uint8(100), np.where(tool, np.uint8(255), np.uint8(0))))
    np.testing.assert_array_equal(open_with(folder).tissue, ~tool)
