"""Found masks as a file: the clip that is sent again with it gets the same masks."""

from __future__ import annotations

import dataclasses
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import ClipLimits, DepthClip, StereoClip
from intrasplat.clip.calibration.rectify import rectify
from intrasplat.clip.masks import open_masks, tissue_from_masks
from intrasplat.clip.recorded_masks import as_recorded
from intrasplat.clip.stored import load_clip, save_clip
from intrasplat.instruments import zipped_masks
from intrasplat.intake.calibration.types import RawCalibration, RawEye
from intrasplat.report import Masks
from lab.phantom import PhantomSettings, make_phantom

HEIGHT, WIDTH, FRAMES = 160, 192, 3
FOUND = Masks(source="found", share=0.1, sure=0.9)
EYE = RawEye(fx_px=180.0, fy_px=181.0, cx_px=97.0, cy_px=79.0, distortion=(-0.2, 0.05, 0.001, -0.001, 0.0))


def found_clip() -> DepthClip:
    drawn = make_phantom(PhantomSettings(width=WIDTH, height=HEIGHT, frames=FRAMES, seed=3, tools=("steel",)))
    return dataclasses.replace(drawn.depth_clip(), masks=FOUND)


def sent_again(content: bytes, folder: Path) -> np.ndarray:
    """Tissue [T, H, W] of a clip that is sent with the file as its masks."""
    path = folder / "masks.zip"
    path.write_bytes(content)
    masks = open_masks(path, ClipLimits())
    return tissue_from_masks(masks, (FRAMES, HEIGHT, WIDTH), "auto").tissue


def test_a_clip_that_is_sent_again_with_its_found_masks_has_them(tmp_path: Path) -> None:
    clip = found_clip()
    content = zipped_masks(clip)
    assert content is not None
    assert (sent_again(content, tmp_path) == clip.tissue).all()
    assert zipped_masks(clip) == content


def test_masks_of_a_rectified_clip_lie_in_the_recordings_pixels(tmp_path: Path) -> None:
    recorded = found_clip()
    calibration = RawCalibration(
        model="raw",
        width=WIDTH,
        height=HEIGHT,
        left=EYE,
        right=EYE.model_copy(update={"cx_px": 95.0}),
        right_from_left_rotation=((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        right_from_left_translation_mm=(-4.0, 0.1, 0.0),
    )
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pairs = StereoClip(FRAMES, HEIGHT, WIDTH, lambda: iter([(black, black)] * FRAMES), recorded.tissue, np.arange(3.0))
    rectified = rectify(pairs, calibration)
    assert rectified.rectification is not None
    clip = dataclasses.replace(recorded, tissue=rectified.tissue, rectification=rectified.rectification)
    save_clip(tmp_path / "kept", clip, "this")
    kept = load_clip(tmp_path / "kept", "this")
    assert kept is not None
    assert kept.rectification == rectified.rectification
    content = zipped_masks(kept)
    assert content is not None
    again = rectify(dataclasses.replace(pairs, tissue=sent_again(content, tmp_path)), calibration)
    tool, tool_again, unmoved = ~rectified.tissue, ~again.tissue, ~recorded.tissue
    assert (tool & tool_again).sum() > 0.98 * (tool | tool_again).sum()
    assert (tool & unmoved).sum() < 0.95 * (tool | unmoved).sum()  # rectification moves what is compared


def test_what_rectification_cuts_off_is_masked_as_the_border_is() -> None:
    mask = np.zeros((4, 6), np.bool_)
    mask[1, 0] = True
    x, y = np.meshgrid(np.arange(6, dtype=np.float32) - 2, np.arange(4, dtype=np.float32))
    assert as_recorded(mask, (x, y))[1].tolist() == [True, True, True, False, False, False]


def test_a_frame_that_nobody_looked_at_has_the_nearest_ones_mask(tmp_path: Path) -> None:
    clip = found_clip()
    tissue = clip.tissue.copy()
    tissue[1] = False
    content = zipped_masks(dataclasses.replace(clip, tissue=tissue, skipped=(1,)))
    assert content is not None
    assert (sent_again(content, tmp_path)[1] == clip.tissue[0]).all()


@pytest.mark.parametrize("masks", [None, Masks(source="given", share=0.1), Masks(source="found", share=0.0, sure=1.0)])
def test_there_is_no_file_of_masks_that_were_not_found(masks: Masks | None) -> None:
    assert zipped_masks(dataclasses.replace(found_clip(), masks=masks)) is None


def test_masks_that_take_too_much_room_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("intrasplat.instruments.masks_file.MAX_BYTES", 100)
    assert zipped_masks(found_clip()) is None


def test_the_masks_are_numbered_as_the_frames_are() -> None:
    content = zipped_masks(found_clip())
    assert content is not None
    assert zipfile.ZipFile(io.BytesIO(content)).namelist() == [f"{index:06d}.png" for index in range(FRAMES)]
