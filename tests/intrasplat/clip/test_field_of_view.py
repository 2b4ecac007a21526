"""The field of view: round fields, borders, bars and labels are found, dark tissue and whole pictures stay."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.clip.field_of_view import find_field, find_fields, find_labels, shape_of
from intrasplat.clip.shown import with_shown_parts
from intrasplat.errors import InputError
from intrasplat.names import Fov
from intrasplat.options import ReconstructionOptions
from tests.intrasplat.clips import plane_clip

H, W = 120, 160
Rgb = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def tissue(count: int = 10, seed: int = 0) -> Rgb:
    """[T, H, W, 3] a texture that moves by a pixel a frame."""
    rng = np.random.default_rng(seed)
    wide = cv2.GaussianBlur(rng.uniform(60, 200, (H, W + count, 3)).astype(np.float32), (0, 0), 2)
    wide = 120 + 3 * (wide - wide.mean())
    return np.stack([np.clip(wide[:, i : i + W], 45, 255) for i in range(count)]).astype(np.uint8)


def disc(radius_px: float, x: float = W / 2, y: float = H / 2) -> Mask:
    rows, columns = np.mgrid[:H, :W]
    return np.asarray(np.hypot(columns - x, rows - y) < radius_px)


def box(top: int, bottom: int, left: int, right: int) -> Mask:
    inside = np.zeros((H, W), np.bool_)
    inside[top:bottom, left:right] = True
    return inside


def outside_as(pictures: Rgb, inside: Mask, levels: NDArray[np.float64] | float) -> Rgb:
    return np.where(inside[..., None], pictures, np.clip(levels, 0, 255)).astype(np.uint8)


def agreement(found: Mask, truth: Mask) -> float:
    """Intersection over union."""
    return float((found & truth).sum() / (found | truth).sum())


@pytest.mark.parametrize(
    ("inside", "shape"),
    [
        (disc(55), "round"),
        (disc(70, x=70), "round"),
        (box(10, 110, 30, 150), "rectangular"),
        (box(0, H, 20, 140), "rectangular"),
        (box(15, 105, 0, W), "rectangular"),
        (box(0, H, 0, 120), "rectangular"),
    ],
)
@pytest.mark.parametrize("black", [0.0, 16.0, "noise"])
def test_a_black_border_is_outside(inside: Mask, shape: str, black: float | str) -> None:
    level = np.random.default_rng(1).normal(2, 4, (10, H, W, 3)) if black == "noise" else float(black)
    found = find_field(outside_as(tissue(), inside, level))
    assert agreement(found, inside) > 0.88
    assert (found & ~inside).mean() < 0.006
    assert shape_of(found) == shape


def test_bars_of_any_colour_are_outside() -> None:
    inside = box(0, H, 24, 136)
    pictures = tissue()
    pictures[:, ~inside] = (30, 90, 200)
    assert agreement(find_field(pictures), inside) > 0.88


def test_a_whole_picture_stays_whole_with_dark_tissue_and_dark_corners() -> None:
    pictures = tissue()
    assert find_field(pictures).all()
    pictures[:, 40:70, 60:100] = 3  # a cavity
    assert find_field(pictures).all()
    pictures[:, 0, :] = pictures[:, -1, :] = 0  # a codec's dark line
    assert find_field(pictures).mean() > 0.97


def test_a_shadow_at_the_rim_of_a_round_field_is_tissue() -> None:
    inside = disc(55)
    pictures = outside_as(tissue(), inside, 0.0)
    pictures[:, 50:70, 100:140] = 2
    found = find_field(pictures)
    assert found[60, 110]
    assert agreement(found, inside) > 0.9


def test_a_soft_rim_is_left_out() -> None:
    rows, columns = np.mgrid[:H, :W]
    gain = np.clip((58 - np.hypot(columns - W / 2, rows - H / 2)) / 6, 0, 1)
    pictures = (tissue() * gain[..., None]).astype(np.uint8)
    found = find_field(pictures)
    assert np.percentile(gain[found], 2) > 0.4
    assert agreement(found, disc(52)) > 0.85


def test_text_in_the_border_and_flashes_change_nothing() -> None:
    inside = disc(50)
    pictures = outside_as(tissue(12), inside, 0.0)
    pictures[:, 5:12, 4:30:3] = 220
    pictures[4] = 255
    assert agreement(find_field(pictures), inside) > 0.88


def test_a_dark_clip_with_a_light_has_no_field() -> None:
    pictures = np.zeros((6, H, W, 3), np.uint8)
    assert find_field(pictures).all()
    pictures[:, 50:60, 50:60] = 200
    assert find_field(pictures).all()


def eyes_with(label: Rgb | None) -> tuple[Rgb, Rgb]:
    left = tissue()
    right = np.roll(left, -6, axis=2)
    for eye in (left, right):
        if label is not None:
            eye[:, 4 : 4 + label.shape[0], 4 : 4 + label.shape[1]] = label
    return left, right


def test_a_label_that_both_eyes_show_at_the_same_place_is_outside_and_textured_tissue_is_not() -> None:
    label = np.zeros((14, 40, 3), np.uint8)
    cv2.putText(label, "12:34", (1, 11), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255))
    left, right = eyes_with(label)
    found = find_labels([(left[0], right[0])], np.ones((H, W), np.bool_))
    assert found[6:14, 6:40].mean() > 0.9
    assert found[30:].sum() == 0
    fields = find_fields(eyes_with(label), range(10), "auto")
    assert fields.left is not None
    assert not fields.left[6:14, 6:40].any()
    assert fields.entry.label_share > 0.01
    assert find_fields(eyes_with(None), range(10), "auto").left is None
    assert find_fields(eyes_with(label), range(10), "auto", may_coincide=True).left is None


def test_text_over_the_tissue_is_outside_and_its_changing_digits_do_not_hide_it() -> None:
    eyes = [np.stack([cv2.resize(each, (3 * W, 3 * H)) for each in eye]) for eye in eyes_with(None)]
    for eye in eyes:
        for index, picture in enumerate(eye):
            cv2.putText(picture, f"REC 12:3{index % 10}", (8, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255))
    field = find_fields(eyes, range(10), "auto").left
    assert field is not None
    strokes = (np.stack(eyes).min(axis=(0, 1, 4)) == 255) & (np.arange(3 * W) < 60)
    assert strokes.sum() > 100
    assert field[strokes].mean() < 0.1
    assert field[30:].all()


def test_each_eye_has_its_own_field_and_the_report_says_so() -> None:
    left = outside_as(tissue(), disc(50, 85), 0.0)
    right = outside_as(np.roll(tissue(), -10, axis=2), disc(50, 75), 0.0)
    fields = find_fields([left, right], range(10), "auto")
    assert fields.left is not None
    assert fields.right is not None
    assert agreement(fields.left, disc(50, 85)) > 0.88
    assert agreement(fields.right, disc(50, 75)) > 0.88
    assert (fields.entry.source, fields.entry.shape) == ("found", "round")
    assert fields.entry.share == pytest.approx(fields.left.mean())
    (notice,) = fields.notices
    assert "field of view: round" in notice.text


def test_all_leaves_the_whole_picture() -> None:
    fields = find_fields([outside_as(tissue(), disc(50), 0.0)], range(10), "all")
    assert (fields.left, fields.right, fields.notices) == (None, None, ())
    assert (fields.entry.source, fields.entry.share) == ("all", 1.0)


def test_held_out_frames_decide_nothing() -> None:
    pictures = outside_as(tissue(), disc(50), 0.0)
    train = [0, 2, 3, 4, 5, 6, 7, 8]
    other = pictures.copy()
    other[[1, 9]] = 255
    one, two = (find_fields([each], train, "auto").left for each in (pictures, other))
    np.testing.assert_array_equal(one, two)


def test_a_field_that_is_hardly_wider_than_its_rim_stays() -> None:
    inside = box(58, 63, 0, W)
    found = find_field(outside_as(tissue(), inside, 0.0))
    assert found.any()
    assert not found[:50].any()


def clip_in(field: NDArray[np.bool_], *, black: int | None = None, covered: int | None = None) -> DepthClip:
    """A clip whose field of view is this [H, W], with noise outside, a black frame, and one that masks cover."""
    clip = plane_clip(10)
    noise = np.random.default_rng(0).integers(0, 3, clip.rgb.shape).astype(np.uint8)
    rgb, shown = np.where(field[..., None], clip.rgb, noise), clip.tissue.copy()
    if black is not None:
        rgb[black] = noise[black]
    if covered is not None:
        shown[covered] &= ~field
    return replace(clip, rgb=rgb, tissue=shown)


def small_field() -> NDArray[np.bool_]:
    height, width = plane_clip(10).tissue.shape[1:]
    y, x = np.mgrid[:height, :width]
    return np.asarray((x - width / 2) ** 2 + (y - height / 2) ** 2 < (0.3 * height) ** 2)


def shown_parts(clip: DepthClip, fov: Fov = "auto") -> DepthClip:
    return with_shown_parts(clip, ReconstructionOptions(fov=fov, holdout="none", use_frames="all"))


def test_a_frame_whose_field_is_covered_by_masks_is_left_out() -> None:
    assert shown_parts(clip_in(small_field(), covered=4)).skipped == (4,)


@pytest.mark.parametrize("fov", ["auto", "all"])
def test_a_black_frame_is_found_in_a_small_field(fov: Fov) -> None:
    assert shown_parts(clip_in(small_field(), black=4), fov).skipped == (4,)


def test_a_given_field_without_tissue_is_refused() -> None:
    field = small_field()
    covered = replace(clip_in(field), tissue=np.tile(~field, (10, 1, 1)), field_of_view=field)
    with pytest.raises(InputError) as refused:
        shown_parts(covered)
    assert refused.value.field == "fov_mask"
