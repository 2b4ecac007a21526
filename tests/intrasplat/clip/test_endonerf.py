"""The EndoNeRF layout: depth, masks and poses, good and bad."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.clip import ClipLimits, DepthClip, open_clip
from intrasplat.errors import InputError, LimitError
from intrasplat.intake.limits import CLIP_BYTES_PER_PIXEL
from tests.intrasplat.clips import open_with


def depth_clip(path: Path, **options) -> DepthClip:
    clip = open_with(path, **options)
    assert isinstance(clip, DepthClip)
    return clip


def turn(axis: int, degrees: float) -> NDArray[np.float64]:
    """Rotation [3, 3] about x, y or z."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.eye(3)
    first, second = [k for k in range(3) if k != axis]
    rotation[[first, second], [first, second]] = cosine
    rotation[first, second], rotation[second, first] = -sine, sine
    return rotation


@pytest.mark.parametrize("zipped", [False, True])
def test_a_folder_and_its_zip_give_the_same_clip(studio, zipped: bool) -> None:
    folder = studio.endonerf()
    clip = depth_clip(studio.zip(folder, prefix="scene/") if zipped else folder)
    assert clip.rgb.shape == (3, 64, 80, 3)
    np.testing.assert_array_equal(clip.rgb, studio.eyes(3, 64, 80)[0])
    np.testing.assert_array_equal(clip.tissue, ~studio.tool(3, 64, 80))
    assert clip.depth_mm.dtype == np.float32
    assert clip.depth_mm[0, 10, 10] == 60
    assert (clip.depth_mm[:, :4, :4] == 0).all()
    np.testing.assert_array_equal(clip.depth_confidence, np.where(clip.depth_mm > 0, 255, 0))
    assert clip.depth_confidence.dtype == np.uint8
    assert clip.intrinsics.numbers() == {"width": 80, "height": 64, "fx": 100, "fy": 100, "cx": 40, "cy": 32}
    np.testing.assert_array_equal(clip.world_from_camera, np.tile(np.eye(4), (3, 1, 1)))
    np.testing.assert_allclose(clip.frame_times_s, np.arange(3) / 30)
    assert any("white is tool" in assumption.text for assumption in clip.assumptions)
    assert clip.warnings == ()


def test_16_bit_depth_is_millimetres(studio) -> None:
    folder = studio.endonerf()
    studio.images("endonerf/depth/frame-{}.depth.png", np.full((3, 64, 80), 312, dtype=np.uint16))
    assert (depth_clip(folder).depth_mm == 312).all()


def test_one_frame_of_odd_size_is_a_clip(studio) -> None:
    clip = depth_clip(studio.endonerf(1, 33, 51))
    assert clip.rgb.shape == (1, 33, 51, 3)
    assert clip.t.tolist() == [0.0]


def test_without_a_masks_folder_every_pixel_is_tissue(studio) -> None:
    folder = studio.endonerf()
    for mask in (folder / "masks").iterdir():
        mask.unlink()
    clip = depth_clip(folder)
    assert clip.tissue.all()
    assert any("none given" in assumption.text for assumption in clip.assumptions)


def test_given_masks_replace_the_folders_own(studio) -> None:
    other = studio.tool(3, 64, 80)[:, ::-1]
    clip = depth_clip(studio.endonerf(), masks=studio.masks("other", other))
    np.testing.assert_array_equal(clip.tissue, ~other)


@pytest.mark.parametrize("convention", ["opengl", "llff"])
def test_a_moving_camera_is_expressed_in_the_camera_of_frame_0(studio, convention: str) -> None:
    """Stored poses are built from known OpenCV poses by the definition of each convention, then read back."""
    folder = studio.endonerf()
    opencv = np.tile(np.eye(4), (3, 1, 1))
    for frame in range(3):
        opencv[frame, :3, :3] = turn(0, 20 + 5 * frame) @ turn(1, 10 * frame) @ turn(2, 30)
        opencv[frame, :3, 3] = 7 + frame, -2 * frame, 3
    right, down, forward = (opencv[:, :3, k] for k in range(3))
    columns = (right, -down, -forward) if convention == "opengl" else (down, right, -forward)
    studio.poses("endonerf", np.stack([*columns, opencv[:, :3, 3]], axis=2), 64, 80)
    clip = depth_clip(folder, pose_convention=convention)
    np.testing.assert_allclose(clip.world_from_camera, np.linalg.inv(opencv[0]) @ opencv, atol=1e-12)
    assert any(f"{convention} camera-to-world, moving camera" in assumption.text for assumption in clip.assumptions)


def test_moving_right_in_the_file_is_plus_x_and_backing_off_is_minus_z(studio) -> None:
    folder = studio.endonerf()
    matrices = np.tile(np.eye(3, 4), (3, 1, 1))
    matrices[1, 0, 3], matrices[2, :, 3] = 5.0, (0.0, 4.0, 2.0)
    studio.poses("endonerf", matrices, 64, 80)
    moved = depth_clip(folder).world_from_camera[:, :3, 3]
    np.testing.assert_allclose(moved, [[0, 0, 0], [5, 0, 0], [0, -4, -2]], atol=1e-12)


def bad_poses(problem: str) -> NDArray[np.float64]:
    matrices = np.tile(np.eye(3, 4), (3, 1, 1))
    if problem == "NaN":
        matrices[1, 2, 3] = np.nan
    elif problem == "scaled":
        matrices[2, :, :3] *= 1.01
    elif problem == "sheared":
        matrices[2, 0, 1] = 0.01
    elif problem == "mirrored":
        matrices[2, 0, 0] = -1
    return matrices[:2] if problem == "too few" else matrices


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        ("NaN", "NaN or infinity in frame 1"),
        ("scaled", "not rigid: the 3x3 part of frame 2 is not a rotation"),
        ("sheared", "not rigid: the 3x3 part of frame 2 is not a rotation"),
        ("mirrored", "not rigid: the 3x3 part of frame 2 is mirrored"),
        ("too few", "2 poses for 3 images"),
    ],
)
def test_bad_poses_are_refused_by_frame(studio, problem: str, message: str) -> None:
    folder = studio.endonerf()
    studio.poses("endonerf", bad_poses(problem), 64, 80)
    with pytest.raises(InputError, match=message) as caught:
        open_clip(folder)
    assert caught.value.field == "clip"


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((3, 15)), r"has shape \[3, 15\]"),
        (np.zeros(17), r"has shape \[17\]"),
        (np.array([{"pickled": "object"}]), "not a readable array"),
        (np.array([["text"] * 17] * 3), "not a readable array"),
        (np.zeros((3, 17)), r"\(H, W, f\) = \(0, 0, 0\)"),
    ],
)
def test_arrays_that_are_no_poses_are_refused(studio, array: NDArray[np.generic], message: str) -> None:
    folder = studio.endonerf()
    np.save(folder / "poses_bounds.npy", array, allow_pickle=True)
    with pytest.raises(InputError, match=message):
        open_clip(folder)


def test_a_cut_or_lying_poses_file_is_refused(studio) -> None:
    path = studio.endonerf() / "poses_bounds.npy"
    whole = path.read_bytes()
    for data in (b"", whole[:40], whole[:-8], whole.replace(b"(3, 17)", b"(9, 17)")):
        path.write_bytes(data)
        with pytest.raises(InputError, match="not a readable array"):
            open_clip(path.parent)


def test_poses_for_another_size_or_with_zoom_are_refused(studio) -> None:
    folder = studio.endonerf()
    studio.poses("endonerf", np.tile(np.eye(3, 4), (3, 1, 1)), 128, 160)
    with pytest.raises(InputError, match="says 160x128 pixels, the images are 80x64"):
        open_clip(folder)
    studio.endonerf()
    rows = np.load(folder / "poses_bounds.npy")
    rows[2, 14] = 120.0
    np.save(folder / "poses_bounds.npy", rows)
    with pytest.raises(InputError, match="in frame 2"):
        open_clip(folder)


@pytest.mark.parametrize("folder", ["images", "depth"])
def test_a_missing_folder_is_named(studio, folder: str) -> None:
    path = studio.endonerf()
    for image in (path / folder).iterdir():
        image.unlink()
    with pytest.raises(InputError, match=f"no images in {folder}/"):
        open_clip(path)


def test_missing_poses_are_named(studio) -> None:
    folder = studio.endonerf()
    (folder / "poses_bounds.npy").unlink()
    with pytest.raises(InputError, match=r"has no poses_bounds.npy"):
        open_clip(folder)


def test_fewer_depth_images_than_frames_are_refused(studio) -> None:
    folder = studio.endonerf()
    (folder / "depth/frame-000001.depth.png").unlink()
    with pytest.raises(InputError, match=r"there are 2 files like .* for 3"):
        open_clip(folder)


def test_depth_of_other_frames_is_refused(studio) -> None:
    folder = studio.endonerf()
    (folder / "depth/frame-000001.depth.png").rename(folder / "depth/frame-000007.depth.png")
    with pytest.raises(InputError, match="their numbers differ"):
        open_clip(folder)


def test_depth_of_another_size_is_refused(studio) -> None:
    folder = studio.endonerf()
    studio.images("endonerf/depth/frame-{}.depth.png", np.full((3, 32, 40), 60, dtype=np.uint8))
    with pytest.raises(InputError, match="depth is 40x32 pixels, the images are 80x64"):
        open_clip(folder)


def test_colour_mapped_depth_is_refused(studio) -> None:
    folder = studio.endonerf()
    studio.images("endonerf/depth/frame-{}.depth.png", studio.eyes(3, 64, 80)[0])
    with pytest.raises(InputError, match="colour picture"):
        open_clip(folder)


def test_no_valid_depth_is_refused(studio) -> None:
    folder = studio.endonerf()
    studio.images("endonerf/depth/frame-{}.depth.png", np.zeros((3, 64, 80), dtype=np.uint8))
    with pytest.raises(InputError, match="no valid depth anywhere"):
        open_clip(folder)
    on_tool = np.where(studio.tool(3, 64, 80), np.uint8(60), np.uint8(0))
    studio.images("endonerf/depth/frame-{}.depth.png", on_tool)
    with pytest.raises(InputError, match="no valid depth on tissue"):
        open_clip(folder)


@pytest.mark.parametrize(("depth_mm", "warning"), [(2, "median is 2.0 mm"), (2000, "median is 2000.0 mm")])
def test_depth_in_other_units_is_warned_about(studio, depth_mm: int, warning: str) -> None:
    folder = studio.endonerf()
    studio.images("endonerf/depth/frame-{}.depth.png", np.full((3, 64, 80), depth_mm, dtype=np.uint16))
    assert warning in depth_clip(folder).warnings[0].text


def test_mostly_missing_depth_is_warned_about(studio) -> None:
    folder = studio.endonerf()
    depth = np.zeros((3, 64, 80), dtype=np.uint8)
    depth[:, :, :20] = 60
    studio.images("endonerf/depth/frame-{}.depth.png", depth)
    assert any("of the tissue pixels have one" in warning.text for warning in depth_clip(folder).warnings)


def test_a_damaged_image_is_named(studio) -> None:
    path = studio.endonerf() / "images/frame-000002.color.png"
    data = bytearray(path.read_bytes())
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"frame-000002.color.png is damaged or cut short"):
        open_clip(path.parents[1])


def test_a_clip_over_the_limits_is_refused_before_it_is_decoded(studio) -> None:
    folder = studio.endonerf()
    with pytest.raises(LimitError, match="the limit is 2"):
        open_clip(folder, limits=ClipLimits(frames=2))
    needed = 3 * 64 * 80 * CLIP_BYTES_PER_PIXEL
    with pytest.raises(LimitError, match=r"3 frames of 80x64 pixels.* holds 2\. Cut it to 2 frames"):
        open_clip(folder, limits=ClipLimits(decoded_bytes=needed - 1))
    open_clip(folder, limits=ClipLimits(decoded_bytes=needed))


def test_unknown_choices_are_refused(studio) -> None:
    folder = studio.endonerf()
    with pytest.raises(InputError, match="'opengl' or 'llff'"):
        open_with(folder, pose_convention="opencv")
    with pytest.raises(InputError, match="'auto', 'tool' or 'tissue'"):
        open_with(folder, mask_polarity="white")
