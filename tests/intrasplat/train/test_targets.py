"""What the rasteriser compares with is the clip: every pixel, in the optimiser's unit, and nothing in the padding."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip
from intrasplat.errors import InputError
from intrasplat.splat.cpu import padded
from intrasplat.splat.layout import POSE
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.step import camera_vector
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS, TrainingFrames, camera_in_units, units_per_mm
from tests.helpers import assert_close
from tests.intrasplat.clips import HEIGHT, WIDTH, plane_clip

TRAIN = [0, 2, 3]


@pytest.fixture(scope="module")
def clip() -> DepthClip:
    """A plane with a hole in its depth."""
    made = plane_clip(4, step_mm=0.5)
    made.depth_mm[:, 20:24, 40:50] = 0
    return made


def test_the_median_depth_of_the_training_frames_is_the_unit(clip: DepthClip) -> None:
    measured = np.concatenate([clip.depth_mm[i][clip.tissue[i] & (clip.depth_mm[i] > 0)] for i in TRAIN])
    assert np.median(measured) * units_per_mm(clip, TRAIN) == pytest.approx(MEDIAN_DEPTH_UNITS, rel=0.01)


def test_held_out_frames_do_not_enter_the_unit(clip: DepthClip) -> None:
    depth_mm = clip.depth_mm.copy()
    depth_mm[1] *= 7
    changed = dataclasses.replace(clip, depth_mm=depth_mm)
    assert units_per_mm(changed, TRAIN) == units_per_mm(clip, TRAIN)


def test_a_single_pixel_with_depth_is_enough_for_the_unit(clip: DepthClip) -> None:
    depth_mm = np.zeros_like(clip.depth_mm)
    depth_mm[2, 41, 51] = 30
    assert units_per_mm(dataclasses.replace(clip, depth_mm=depth_mm), TRAIN) == pytest.approx(2)


def test_a_clip_without_depth_on_tissue_is_refused(clip: DepthClip) -> None:
    with pytest.raises(InputError, match="mask polarity"):
        units_per_mm(dataclasses.replace(clip, depth_mm=np.where(clip.tissue, 0, clip.depth_mm)), TRAIN)


def test_a_target_holds_the_frames_colour_tissue_and_inverse_depth(clip: DepthClip) -> None:
    scale = 1.7
    frames = TrainingFrames(clip, TRAIN, scale)
    stride = padded(WIDTH)
    for index in TRAIN:
        target = frames.frame(index).target
        rgb = target.rgb.reshape(3, HEIGHT, stride)
        weight, inverse = (each.reshape(HEIGHT, stride) for each in (target.weight, target.inverse_depth))
        np.testing.assert_array_equal(rgb[:, :, :WIDTH], clip.rgb[index].transpose(2, 0, 1))
        np.testing.assert_array_equal(weight[:, :WIDTH] == 255, clip.tissue[index])
        measured = clip.tissue[index] & (clip.depth_mm[index] > 0)
        np.testing.assert_array_equal(inverse[:, :WIDTH] > 0, measured)
        assert_close(inverse[:, :WIDTH][measured], 1 / (clip.depth_mm[index][measured] * scale))
        assert not weight[:, WIDTH:].any()
        assert not inverse[:, WIDTH:].any()


def test_a_picture_is_the_frame_without_padding(clip: DepthClip) -> None:
    frames = TrainingFrames(clip, TRAIN, 1.7)
    for index in TRAIN:
        rgb, tissue = frames.picture(index)
        assert rgb.dtype == np.uint8
        assert tissue.dtype == np.bool_
        np.testing.assert_array_equal(rgb, clip.rgb[index])
        np.testing.assert_array_equal(tissue, clip.tissue[index])


def test_there_is_no_picture_of_a_held_out_frame(clip: DepthClip) -> None:
    with pytest.raises(KeyError):
        TrainingFrames(clip, TRAIN, 1.7).picture(1)


def test_each_loss_is_a_mean_over_its_own_pixels(clip: DepthClip) -> None:
    frames = TrainingFrames(clip, TRAIN, 1.0)
    loss = LossSettings(colour_weight=2.0, depth_weight=0.5, colour_huber_delta=0.02)
    for index in TRAIN:
        tissue = int(clip.tissue[index].sum())
        measured = int((clip.tissue[index] & (clip.depth_mm[index] > 0)).sum())
        assert measured < tissue
        colour, depth, colour_slope, _, normalised = frames.frame(index).loss_settings(loss)
        assert colour * 3 * tissue == pytest.approx(2.0)
        assert depth * measured == pytest.approx(0.5)
        assert colour_slope == pytest.approx(1 / 0.02)
        assert normalised == 1


def test_a_frame_without_tissue_divides_by_nothing(clip: DepthClip) -> None:
    tissue = clip.tissue.copy()
    tissue[2] = False
    frames = TrainingFrames(dataclasses.replace(clip, tissue=tissue), TRAIN, 1.0)
    assert np.isfinite(frames.frame(2).loss_settings(LossSettings())).all()


def test_a_point_in_mm_and_in_units_lands_on_the_same_pixel() -> None:
    intrinsics = Intrinsics(width=64, height=48, fx=80.0, fy=75.0, cx=31.0, cy=25.0)
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [3.0, -2.0, 5.0]
    scale, point_mm = 0.8, np.array([4.0, 1.0, 70.0])
    x, y, z = np.linalg.inv(pose)[:3] @ [*point_mm, 1]
    camera = camera_vector(camera_in_units(intrinsics, pose, scale))
    extrinsic = camera[POSE:].reshape(3, 4)
    seen = extrinsic[:, :3] @ (point_mm * scale) + extrinsic[:, 3]
    assert_close(seen / scale, np.array([x, y, z]))
    assert_close(camera[:4], np.array([80.0, 75.0, 31.0, 25.0]))


def test_the_digest_knows_every_training_pixel_and_no_held_out_one(clip: DepthClip) -> None:
    digest = TrainingFrames(clip, TRAIN, 1.0).digest()
    assert TrainingFrames(clip, TRAIN, 1.0).digest() == digest
    assert TrainingFrames(clip, [0, 1, 3], 1.0).digest() != digest
    assert TrainingFrames(clip, TRAIN, 1.1).digest() != digest
    for layer in ("rgb", "depth_mm"):
        held_out, taught = (getattr(clip, layer).copy() for _ in range(2))
        held_out[1] = 9
        taught[3, 40, 60] += 1
        assert TrainingFrames(dataclasses.replace(clip, **{layer: held_out}), TRAIN, 1.0).digest() == digest
        assert TrainingFrames(dataclasses.replace(clip, **{layer: taught}), TRAIN, 1.0).digest() != digest
