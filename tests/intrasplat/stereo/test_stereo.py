"""Depth from synthetic rectified pairs whose disparity is known exactly.

Pairs are drawn from one smooth random texture: the right eye sees it as it is, the left eye shifted by the disparity.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip, StereoClip, held_out_frames, open_clip
from intrasplat.clip.calibration import RectifiedClip, load_calibration, rectify
from intrasplat.clip.types import PIXELS
from intrasplat.errors import Cancelled, InputError
from intrasplat.intake.calibration.types import StereoCalibration, parse_calibration
from intrasplat.machine.hooks import Hooks, Progress
from intrasplat.options import ClipOptions
from intrasplat.stereo import estimate_depth

WIDTH, HEIGHT = 240, 144
FX_PX, BASELINE_MM, OFFSET_PX = 220.0, 4.0, 0.25
DRAWN_BEYOND_PX = 120  # texture drawn beyond the image, so that shifting it leaves no border

Image = NDArray[np.float32]


def slanted(near_px: float = 16.0, far_px: float = 8.0, width: int = WIDTH, height: int = HEIGHT) -> Image:
    """Disparity of a plane, far at the top left and near at the bottom right."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    nearness: Image = 0.4 * x / width + 0.6 * y / height
    return far_px + (near_px - far_px) * nearness


def texture(height: int, width: int, seed: int) -> Image:
    """Grey levels with detail of several sizes, as tissue has."""
    noise = np.random.default_rng(seed)
    image = np.full((height, width), 110.0, np.float32)
    for sigma_px, contrast in ((1.2, 18.0), (3.0, 15.0), (10.0, 25.0)):
        layer = cv2.GaussianBlur(noise.standard_normal((height, width)).astype(np.float32), (0, 0), sigma_px)
        image += contrast * layer / layer.std()
    return image


def draw_pair(
    disparity: Image, seed: int = 0, row_shift_px: float = 0.0, noise: float = 1.0
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Left and right RGB; a right point lies row_shift_px lower than the left one."""
    height, width = disparity.shape
    margin = DRAWN_BEYOND_PX
    drawn = texture(height + 2 * margin, width + 2 * margin, seed)
    y, x = np.mgrid[:height, :width].astype(np.float32) + np.float32(margin)
    left = cv2.remap(drawn, x - disparity, y, cv2.INTER_CUBIC)
    right = cv2.remap(drawn, x, y - np.float32(row_shift_px), cv2.INTER_CUBIC)
    sensor = np.random.default_rng(seed + 1)
    eyes = [np.clip(eye + noise * sensor.standard_normal(eye.shape), 0, 255).round() for eye in (left, right)]
    coloured = [np.stack([eye, eye * 0.7, eye * 0.6], axis=-1).astype(np.uint8) for eye in eyes]
    return coloured[0], coloured[1]


def clip_of(
    pairs: list[tuple[NDArray[np.uint8], NDArray[np.uint8]]],
    *,
    offset_px: float = OFFSET_PX,
    tissue: NDArray[np.bool_] | None = None,
) -> RectifiedClip:
    height, width = pairs[0][0].shape[:2]
    if tissue is None:
        tissue = np.broadcast_to(np.True_, (len(pairs), height, width))
    camera = Intrinsics(width=width, height=height, fx=FX_PX, fy=FX_PX, cx=width / 2, cy=height / 2)
    times_s = np.arange(len(pairs)) / 30
    return RectifiedClip(len(pairs), camera, BASELINE_MM, offset_px, lambda: iter(pairs), tissue, times_s)


def depth_of(disparity: Image, offset_px: float = OFFSET_PX) -> Image:
    return FX_PX * BASELINE_MM / (disparity - np.float32(offset_px))


def errors_px(clip: DepthClip, disparity: Image, frame: int = 0, offset_px: float = OFFSET_PX) -> NDArray[np.float64]:
    """Signed error of the disparity that the depth means, at valid pixels."""
    valid = clip.depth_mm[frame] > 0
    estimated = FX_PX * BASELINE_MM / clip.depth_mm[frame][valid] + offset_px
    return np.asarray(estimated - disparity[valid], dtype=np.float64)


@pytest.mark.parametrize("size", [(240, 144), (241, 143), (523, 131)], ids=["small", "odd", "wide enough for half"])
def test_a_slanted_plane_is_found_to_a_tenth_of_a_pixel_and_without_bias(size: tuple[int, int]) -> None:
    disparity = slanted(width=size[0], height=size[1])
    clip = estimate_depth(clip_of([draw_pair(disparity)]))
    error = errors_px(clip, disparity)
    assert clip.depth_mm.shape == clip.depth_confidence.shape == (1, size[1], size[0])
    assert np.median(np.abs(error)) < 0.1
    assert np.percentile(np.abs(error), 90) < 0.35
    assert abs(np.median(error)) < 0.04
    visible = np.arange(size[0]) - disparity >= 0
    assert (clip.depth_mm[0] > 0)[visible].mean() > 0.95


def test_points_that_only_the_left_eye_sees_have_little_confidence() -> None:
    disparity = slanted()
    clip = estimate_depth(clip_of([draw_pair(disparity)]))
    unseen = np.arange(WIDTH) - disparity < -1.0
    assert unseen.any()
    assert np.percentile(clip.depth_confidence[0][unseen], 95) < 64
    assert (clip.depth_confidence[0][clip.depth_mm[0] == 0] == 0).all()
    assert (clip.depth_confidence[0][clip.depth_mm[0] > 0] > 0).all()


@pytest.mark.parametrize("row_shift_px", [-6.0, -1.5, 2.25, 7.0])
def test_a_vertical_misalignment_is_measured_corrected_and_reported(row_shift_px: float) -> None:
    disparity = slanted()
    clip = estimate_depth(clip_of([draw_pair(disparity, row_shift_px=row_shift_px)]))
    assert clip.measurements["vertical_misalignment_px"] == pytest.approx(row_shift_px, abs=0.1)
    assert clip.measurements["vertical_residual_px"] < 0.3
    assert any("rows of left and right differed" in warning.text for warning in clip.warnings)
    assert np.median(np.abs(errors_px(clip, disparity))) < 0.12


def test_aligned_eyes_give_no_warning() -> None:
    clip = estimate_depth(clip_of([draw_pair(slanted())]))
    assert clip.warnings == ()
    assert abs(clip.measurements["vertical_misalignment_px"]) < 0.1


def test_what_no_picture_can_confirm_is_named_as_an_assumption() -> None:
    clip = estimate_depth(clip_of([draw_pair(slanted())]))
    assert any(f"baseline of {BASELINE_MM:g} mm" in each.text for each in clip.assumptions)


def test_a_misalignment_beyond_eight_pixels_is_refused() -> None:
    with pytest.raises(InputError, match=r"differ by 14\.\d px") as error:
        estimate_depth(clip_of([draw_pair(slanted(), row_shift_px=14.0)]))
    assert error.value.field == "calibration"


def raw_calibration(right_eye_lower_px: float) -> StereoCalibration:
    """Two eyes alike but for the right one's principal point, which lies lower: recorded rows differ by as much."""
    eye = {"fx_px": FX_PX, "fy_px": FX_PX, "cx_px": (WIDTH - 1) / 2, "cy_px": (HEIGHT - 1) / 2}
    value = {
        "model": "raw",
        "width": WIDTH,
        "height": HEIGHT,
        "left": eye,
        "right": eye | {"cy_px": eye["cy_px"] + right_eye_lower_px},
        "right_from_left_rotation": np.eye(3).tolist(),
        "right_from_left_translation_mm": [-BASELINE_MM, 0.0, 0.0],
    }
    return parse_calibration(value)


def recorded(row_shift_px: float) -> StereoClip:
    pair = draw_pair(slanted(), row_shift_px=row_shift_px)
    return StereoClip(1, HEIGHT, WIDTH, lambda: iter([pair]), None, np.zeros(1))


@pytest.mark.parametrize("lower_px", [-3.0, 5.0, 12.0])
def test_frames_that_are_rectified_already_are_refused_with_a_raw_calibration(lower_px: float) -> None:
    calibration = raw_calibration(lower_px)
    as_recorded = estimate_depth(rectify(recorded(lower_px), calibration))
    assert abs(as_recorded.measurements["vertical_misalignment_px"]) < 0.2
    assert "frames: as recorded, rectified by the calibration" in [each.text for each in as_recorded.assumptions]
    with pytest.raises(InputError, match="the frames are rectified already") as error:
        estimate_depth(rectify(recorded(0.0), calibration))
    assert (error.value.field, "model rectified" in error.value.remedy) == ("calibration", True)


def test_a_small_misalignment_is_not_mistaken_for_frames_that_are_rectified_already() -> None:
    clip = estimate_depth(rectify(recorded(0.0), raw_calibration(1.5)))
    assert clip.measurements["vertical_misalignment_px"] == pytest.approx(-1.5, abs=0.1)
    clip = estimate_depth(rectify(recorded(5.0 + 3.0), raw_calibration(5.0)))
    assert clip.measurements["vertical_misalignment_px"] == pytest.approx(3.0, abs=0.2)  # rectifying magnifies a little


def test_noise_costs_accuracy_gently() -> None:
    disparity = slanted()
    clip = estimate_depth(clip_of([draw_pair(disparity, noise=6.0)]))
    assert np.median(np.abs(errors_px(clip, disparity))) < 0.2
    assert clip.measurements["depth_valid_share"] > 0.8


def test_the_offset_is_the_disparity_of_infinity_even_when_disparities_are_negative() -> None:
    disparity = slanted() - 30.0
    offset_px = OFFSET_PX - 30.0
    clip = estimate_depth(clip_of([draw_pair(disparity)], offset_px=offset_px))
    relative = np.abs(clip.depth_mm[0] / depth_of(disparity, offset_px) - 1)[clip.depth_mm[0] > 0]
    assert np.median(relative) < 0.015


def test_the_searched_range_follows_the_scene() -> None:
    near = estimate_depth(clip_of([draw_pair(slanted(48.0, 40.0))]))
    far = estimate_depth(clip_of([draw_pair(slanted(12.0, 6.0))]))
    assert near.measurements["min_disparity_px"] > far.measurements["max_disparity_px"]
    assert 6.0 < near.measurements["max_disparity_px"] - near.measurements["min_disparity_px"] < 24.0


def test_a_tissue_that_moves_during_the_clip_stays_inside_the_range() -> None:
    planes = [slanted(10.0 + 2 * i, 6.0 + 2 * i) for i in range(7)]
    clip = estimate_depth(clip_of([draw_pair(plane, seed=i) for i, plane in enumerate(planes)]))
    for i, plane in enumerate(planes):
        assert np.median(np.abs(errors_px(clip, plane, i))) < 0.12


def test_depth_jumps_stay_sharp_and_hidden_points_are_not_trusted() -> None:
    disparity = np.full((HEIGHT, WIDTH), 8.0, np.float32)
    disparity[40:100, 100:170] = 16.0
    clip = estimate_depth(clip_of([draw_pair(disparity)]))
    error = np.abs(FX_PX * BASELINE_MM / np.maximum(clip.depth_mm[0], 1.0) + OFFSET_PX - disparity)
    assert np.median(error[50:90, 110:160]) < 0.12
    trusted = clip.depth_confidence[0] >= 200
    assert (error[trusted] < 1.0).mean() > 0.97


def test_the_clip_keeps_what_training_reads() -> None:
    pairs = [draw_pair(slanted(), seed=i) for i in range(3)]
    tissue = np.ones((3, HEIGHT, WIDTH), np.bool_)
    tissue[:, :20] = False
    clip = estimate_depth(clip_of(pairs, tissue=tissue))
    assert np.array_equal(clip.rgb, np.stack([left for left, _ in pairs]))
    assert np.array_equal(clip.tissue, tissue)
    assert (clip.depth_mm.dtype.name, clip.depth_confidence.dtype.name) == ("float32", "uint8")
    assert np.array_equal(clip.world_from_camera, np.tile(np.eye(4), (3, 1, 1)))


def test_the_same_clip_gives_the_same_bits() -> None:
    pairs = [draw_pair(slanted(), seed=i) for i in range(3)]
    first, second = estimate_depth(clip_of(pairs)), estimate_depth(clip_of(pairs))
    assert first.depth_mm.tobytes() == second.depth_mm.tobytes()
    assert first.depth_confidence.tobytes() == second.depth_confidence.tobytes()


@pytest.mark.parametrize("holdout", ["every8", "0,4,9"])
def test_held_out_frames_change_no_bit_of_another_frames_depth(holdout: str) -> None:
    """The held-out pairs become another scene: nearer, misaligned, and other pictures."""
    count = 10
    held_out = held_out_frames(count, holdout)
    train = [i for i in range(count) if i not in held_out]
    pairs = [draw_pair(slanted(10.0 + i, 6.0 + i), seed=i) for i in range(count)]
    poisoned = [
        draw_pair(slanted(60.0, 40.0), seed=90 + i, row_shift_px=5.0) if i in held_out else pair
        for i, pair in enumerate(pairs)
    ]
    clean, dirty = (estimate_depth(clip_of(each), measured_frames=train) for each in (pairs, poisoned))
    assert np.array_equal(clean.depth_mm[train], dirty.depth_mm[train])
    assert np.array_equal(clean.depth_confidence[train], dirty.depth_confidence[train])
    for name in ("vertical_misalignment_px", "vertical_residual_px", "min_disparity_px", "max_disparity_px"):
        assert clean.measurements[name] == dirty.measurements[name]
    assert not np.array_equal(clean.depth_mm[held_out], dirty.depth_mm[held_out])


def test_the_first_measured_frame_is_handed_over_as_it_stays() -> None:
    seen: list[DepthClip] = []
    clip = clip_of([draw_pair(slanted(), seed=i) for i in range(4)])
    whole = estimate_depth(clip, Hooks(on_first_moment=seen.append), measured_frames=[1, 2])
    (moment,) = seen
    assert moment.frame_count == 1
    assert moment.frame_times_s[0] == whole.frame_times_s[1]
    assert moment.right is not None
    assert whole.right is not None
    for shown, eye in ((moment, whole), (moment.right, whole.right)):
        for name in (*PIXELS, "world_from_camera"):
            np.testing.assert_array_equal(getattr(shown, name)[0], getattr(eye, name)[1])
        assert shown.intrinsics == eye.intrinsics


@pytest.mark.parametrize("measured", [[], [3], [-1, 0]])
def test_measuring_on_frames_that_do_not_exist_is_an_error_of_the_caller(measured: list[int]) -> None:
    with pytest.raises(ValueError, match="measured_frames"):
        estimate_depth(clip_of([draw_pair(slanted())] * 2), measured_frames=measured)


def test_swapped_eyes_are_refused_with_the_remedy() -> None:
    left, right = draw_pair(slanted())
    with pytest.raises(InputError, match="swapped") as error:
        estimate_depth(clip_of([(right, left)]))
    assert error.value.field == "clip"


def test_one_eye_shown_twice_is_refused() -> None:
    left, _ = draw_pair(slanted())
    with pytest.raises(InputError, match="same picture"):
        estimate_depth(clip_of([(left, left)]))


def unrelated() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    return draw_pair(slanted(), seed=1)[0], draw_pair(slanted(), seed=5)[1]


def blank() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    grey = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    return grey, grey


@pytest.mark.parametrize("pair", [unrelated, blank])
def test_a_clip_without_any_depth_is_refused(
    pair: Callable[[], tuple[NDArray[np.uint8], NDArray[np.uint8]]],
) -> None:
    with pytest.raises(InputError) as error:
        estimate_depth(clip_of([pair()]))
    assert error.value.field == "clip"


def test_tissue_without_any_depth_is_refused() -> None:
    tissue = np.zeros((1, HEIGHT, WIDTH), np.bool_)
    tissue[:, :, :4] = True  # the right eye never sees this strip
    with pytest.raises(InputError, match="of tissue pixels have a depth to rely on"):
        estimate_depth(clip_of([draw_pair(slanted())], tissue=tissue))


def test_a_source_that_ends_early_is_refused() -> None:
    pairs = [draw_pair(slanted())]
    clip = clip_of([*pairs, *pairs])
    short = RectifiedClip(**{**vars(clip), "pairs": lambda: iter(pairs)})
    with pytest.raises(InputError, match="ended after 1 of 2"):
        estimate_depth(short)


def test_progress_rises_to_one_and_names_its_stage() -> None:
    seen: list[Progress] = []
    estimate_depth(clip_of([draw_pair(slanted(), seed=i) for i in range(3)]), Hooks(on_progress=seen.append))
    fractions = [progress.fraction for progress in seen]
    assert {progress.stage for progress in seen} == {"stereo"}
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


@pytest.mark.parametrize(
    "asked",
    [0, 3, 5],
    ids=["while decoding", "at the end of decoding", "while matching"],
)
def test_a_stop_is_obeyed_in_every_part(asked: int) -> None:
    questions: list[None] = []

    def should_stop() -> bool:
        questions.append(None)
        return len(questions) > asked

    with pytest.raises(Cancelled):
        estimate_depth(clip_of([draw_pair(slanted(), seed=i) for i in range(4)]), Hooks(should_stop=should_stop))


DATA = Path(os.environ.get("INTRASPLAT_DATA", "../shared/data"))
REAL_FRAMES = 4
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="INTRASPLAT_DATA names no folder with the recordings")


def first_frames(clip: StereoClip, calibration: Path) -> RectifiedClip:
    def pairs() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.uint8]]]:
        return islice(clip.pairs(), REAL_FRAMES)

    tissue = None if clip.tissue is None else clip.tissue[:REAL_FRAMES]
    times_s = clip.frame_times_s[:REAL_FRAMES]
    short = replace(clip, frame_count=REAL_FRAMES, pairs=pairs, tissue=tissue, frame_times_s=times_s)
    return rectify(short, load_calibration(calibration, eye_width=clip.width, eye_height=clip.height))


@needs_data
def test_a_real_recording_agrees_with_another_groups_stereo_depth() -> None:
    folder = DATA / "d4d_stereo"
    masks = folder / "tool_masks.zip"
    clip = open_clip(folder / "stereo_sbs.mp4", masks=masks, options=ClipOptions(layout="sbs", mask_polarity="tool"))
    assert isinstance(clip, StereoClip)
    depth = estimate_depth(first_frames(clip, folder / "calibration.json"))
    differences: list[NDArray[np.float32]] = []
    for i, (ours, tissue) in enumerate(zip(depth.depth_mm, depth.tissue, strict=True)):
        reference = cv2.imread(str(DATA / f"d4d_endonerf/depth/frame-{i:06d}.depth.png"), cv2.IMREAD_UNCHANGED)
        assert reference is not None
        size = reference.shape[::-1]
        resized = cv2.resize(ours * tissue, size, interpolation=cv2.INTER_NEAREST)
        differences.append(np.abs(resized - reference)[(resized > 0) & (reference > 0)])
    assert np.median(np.concatenate(differences)) < 1.5
    assert np.percentile(np.concatenate(differences), 90) < 5.0
    assert depth.measurements["depth_valid_share"] > 0.9


@needs_data
def test_a_raw_recording_lands_on_equal_rows() -> None:
    clip = open_clip(DATA / "surgt_raw/video.mp4", options=ClipOptions(layout="sbs"))
    assert isinstance(clip, StereoClip)
    depth = estimate_depth(first_frames(clip, DATA / "surgt_raw/calibration.yaml"))
    assert depth.measurements["vertical_residual_px"] < 0.5
    assert abs(depth.measurements["vertical_misalignment_px"]) < 1.0
    assert depth.measurements["depth_valid_share"] > 0.8


def test_damaged_frames_are_neither_measured_nor_matched_and_change_no_bit_of_the_others() -> None:
    sound = [draw_pair(slanted(), seed) for seed in range(4)]
    noise = np.random.default_rng(9).integers(0, 256, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
    pairs = [sound[0], (noise[0], noise[1]), *sound[1:]]
    depth = estimate_depth(replace(clip_of(pairs), damaged=(1,)))
    assert depth.skipped == (1,)
    np.testing.assert_array_equal(depth.depth_mm[[0, 2, 3, 4]], estimate_depth(clip_of(sound)).depth_mm)
