"""Renders of a scene: held within the clip, honest about what was never seen, the same from disk as from memory."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from intrasplat.camera import Intrinsics
from intrasplat.errors import InputError
from intrasplat.methods.registry import PRESETS
from intrasplat.names import LABORATORY_PRESETS
from intrasplat.notices import Notice, NoticeCode
from intrasplat.outcome import scene_of, snapshot_of
from intrasplat.pose import parse_pose
from intrasplat.scene.checkpoint import load_scene, save_scene
from intrasplat.scene.scene import POSE_WARNINGS, TrainedScene
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.train.run import Run
from intrasplat.view.camera import endoscope_pose, pose_of
from intrasplat.view.confidence import followed
from intrasplat.view.frame import View
from intrasplat.view.lenses import judged_camera
from intrasplat.view.render import ViewRequest, frame_in_parts, render_frame
from intrasplat.view.renderer import renderer_of
from lab.phantom import orbit_pose
from tests.helpers import assert_close
from tests.intrasplat.phantoms import FRAMES, HEIGHT, WIDTH, phantom_clip, prepared, trained, view
from tests.intrasplat.scenes import random_scene

LAST = (FRAMES - 1) / FRAMES


def made(preset: str = "fast", *, moving_camera: bool = False, iterations: int = 20) -> tuple[Run, TrainedScene]:
    """A run and its scene, in which the motion counts as followed, though the clip is short and breathes fast."""
    clip = phantom_clip(moving_camera=moving_camera)
    run, _ = prepared(clip, preset, iterations=iterations)
    run.motion_error = None
    trained(run)
    return run, scene_of(run)


@pytest.fixture(scope="module")
def scene() -> TrainedScene:
    return made()[1]


def shifted(right_mm: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    pose = np.eye(4)
    pose[0, 3] = right_mm
    return pose


@pytest.mark.parametrize("t", [-0.5, 1.0, 1e6])
def test_a_time_outside_the_clip_shows_its_first_or_last_frame_and_warns(scene: TrainedScene, t: float) -> None:
    frame = render_frame(scene, t)
    np.testing.assert_array_equal(frame.rgb, render_frame(scene, 0.0 if t < 0 else LAST).rgb)
    assert any("outside the clip" in warning.text for warning in frame.warnings)


def test_the_endoscopes_own_view_needs_no_warning(scene: TrainedScene) -> None:
    assert render_frame(scene, 0.4).warnings == ()


def test_every_view_repeats_that_the_clips_poses_are_in_doubt(tmp_path: Path) -> None:
    doubts = tuple(Notice.warning(code, f"{code} is so.") for code in sorted(POSE_WARNINGS))
    other = Notice.warning(NoticeCode.BLOOD, "It is red.")
    clip = dataclasses.replace(phantom_clip(), warnings=(other, *doubts))
    run, _ = prepared(clip, "fast", iterations=2)
    trained(run)
    save_scene(tmp_path / "scene", scene_of(run))
    assert snapshot_of(run).pose_warnings == doubts
    assert load_scene(tmp_path / "scene").pose_warnings == doubts
    beside = render_frame(load_scene(tmp_path / "scene"), 0.4, orbit_pose(3, 0)).warnings
    assert [each for each in beside if each.code in POSE_WARNINGS] == list(doubts)
    assert other not in beside


@pytest.mark.parametrize(("trust", "warns"), [(0.5, False), (0.05, True)])
def test_tissue_that_is_hardly_trusted_is_a_reason_to_warn(scene: TrainedScene, trust: float, warns: bool) -> None:
    frame = render_frame(dataclasses.replace(scene, seen=torch.full_like(scene.seen, trust)), 0.4)
    assert [warning.code for warning in frame.warnings] == [NoticeCode.HARDLY_SEEN] * warns


@pytest.mark.parametrize("size", [(97, 81), (33, 17), (8, 8), (200, 150)])
def test_every_layer_has_the_asked_size(scene: TrainedScene, size: tuple[int, int]) -> None:
    width, height = size
    frame = render_frame(scene, 0.3, None, scene.intrinsics.resized(width, height))
    assert (frame.rgb.shape, frame.rgb.dtype.name) == ((height, width, 3), "uint8")
    for layer in (frame.depth_mm, frame.confidence):
        assert (layer.shape, layer.dtype.name) == ((height, width), "float32")
    assert frame.confidence.min() >= 0
    assert frame.confidence.max() <= 1
    assert np.isfinite(frame.depth_mm).all()
    solid = frame.depth_mm > 0
    assert solid.mean() > 0.9
    assert not frame.confidence[~solid].any()


def test_confidence_falls_between_training_times_where_motion_was_not_followed(scene: TrainedScene) -> None:
    unfollowed = dataclasses.replace(scene, settings={"motion_error": (3 * 0.03 * 255) ** 2})
    before, after = scene.trained_t[3:5]
    assert after - before == pytest.approx(1 / FRAMES)
    for share, factor in ((0.0, 1.0), (0.25, 1 / 3.25), (0.5, 1 / 4), (1.0, 1.0)):
        t = before + share * (after - before)
        sure, unsure = render_frame(scene, t), render_frame(unfollowed, t)
        np.testing.assert_array_equal(unsure.rgb, sure.rgb)
        np.testing.assert_allclose(unsure.confidence, factor * sure.confidence, rtol=1e-4)
        is_guessed = NoticeCode.MOTION_GUESSED in {each.code for each in unsure.warnings}
        assert is_guessed == (factor < 1)
    assert followed(unfollowed, LAST) == (1.0 if scene.trained_t[-1] == LAST else 0.25)


def test_what_a_scene_says_of_its_motion_is_checked(scene: TrainedScene) -> None:
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="motion_error"):
            _ = dataclasses.replace(scene, settings={"motion_error": wrong}).motion_error


@pytest.fixture(scope="module")
def doubted(scene: TrainedScene) -> TrainedScene:
    """Of its Gaussians, no frame saw those at the left, and those at the right were hardly seen."""
    column = scene.gaussians.mean[:, 0]
    seen = torch.where(column < -15, torch.tensor(0.0), torch.where(column > 0, torch.tensor(0.05), scene.seen))
    return dataclasses.replace(scene, seen=seen)


@pytest.mark.parametrize("scale", [0.15, 0.25, 0.5, 0.75, 1.5, 2, 4])
@pytest.mark.parametrize("orbit", [None, (10, -5)])
def test_a_view_is_trusted_alike_in_pictures_of_every_size(
    doubted: TrainedScene, orbit: tuple[float, float] | None, scale: float
) -> None:
    pose, camera = None if orbit is None else orbit_pose(*orbit), doubted.intrinsics
    own = render_frame(doubted, 0.5, pose)
    other = render_frame(doubted, 0.5, pose, camera.resized(round(scale * WIDTH), round(scale * HEIGHT)))
    assert {NoticeCode.UNSEEN, NoticeCode.HARDLY_SEEN} <= {each.code for each in own.warnings}
    assert [each.code for each in other.warnings] == [each.code for each in own.warnings]
    assert other.unseen_share == pytest.approx(own.unseen_share, abs=0 if scale < 1 else 0.004)
    assert other.unseen.mean() == pytest.approx(own.unseen_share, abs=0.03 if scale < 0.5 else 0.015)
    assert other.confidence.mean() == pytest.approx(own.confidence.mean(), abs=0.01)
    assert not other.confidence[other.depth_mm == 0].any()


def test_a_part_of_the_view_is_trusted_as_the_whole_view_is(doubted: TrainedScene) -> None:
    camera, whole = doubted.intrinsics, render_frame(doubted, 0.5, orbit_pose(10, -5))
    part = camera.resized(2 * WIDTH, 2 * HEIGHT).cut(WIDTH, HEIGHT // 2, WIDTH // 2, HEIGHT)
    shown = render_frame(doubted, 0.5, orbit_pose(10, -5), part)
    rows, columns = slice(HEIGHT // 4, 3 * HEIGHT // 4), slice(WIDTH // 2, 3 * WIDTH // 4)
    assert shown.confidence.mean() == pytest.approx(whole.confidence[rows, columns].mean(), abs=0.02)


def test_a_smaller_picture_is_as_bright_as_the_recording_and_its_depth_is_a_mean(scene: TrainedScene) -> None:
    own = render_frame(scene, 0.5)
    small = render_frame(scene, 0.5, None, scene.intrinsics.resized(WIDTH // 4, HEIGHT // 4))
    blocks = (HEIGHT // 4, 4, WIDTH // 4, 4)
    assert np.abs(own.rgb.reshape(*blocks, 3).mean((1, 3)) - small.rgb).max() <= 1
    solid = (own.depth_mm > 0).reshape(blocks).all((1, 3))
    assert solid.mean() > 0.9
    assert_close(small.depth_mm[solid], own.depth_mm.reshape(blocks).mean((1, 3))[solid], relative=1e-4)


@pytest.mark.parametrize(
    ("clip", "asked", "judged"),
    [
        ((640, 512), (160, 128), (640, 512)),
        ((640, 512), (1920, 1536), (640, 512)),
        ((3840, 2160), (160, 90), (1930, 1086)),
        ((3840, 2160), (2880, 1620), (2880, 1620)),
        ((3840, 2160), (2461, 1384), (2461, 1384)),
    ],
)
def test_a_view_is_judged_in_the_recordings_pixels_as_far_as_they_are_not_too_many(
    clip: tuple[int, int], asked: tuple[int, int], judged: tuple[int, int]
) -> None:
    own = Intrinsics(width=clip[0], height=clip[1], fx=500.3, fy=501.0, cx=300.0, cy=250.0)
    found = judged_camera(own.resized(*asked), own)
    assert (found.width, found.height) == judged
    wide = dataclasses.replace(own, fx=own.fx / 100, fy=own.fy / 100)
    assert judged_camera(wide, own).width * judged_camera(wide, own).height <= max(1 << 21, clip[0] * clip[1])


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("orbit", [None, (10, -5)])
def test_a_larger_picture_is_the_recordings_one_between_its_pixels_too(
    scene: TrainedScene, orbit: tuple[float, float] | None, scale: int
) -> None:
    pose = None if orbit is None else orbit_pose(*orbit)
    own = render_frame(scene, 0.5, pose)
    large = render_frame(scene, 0.5, pose, scene.intrinsics.resized(scale * WIDTH, scale * HEIGHT))
    averaged = large.rgb.reshape(HEIGHT, scale, WIDTH, scale, 3).mean((1, 3))
    assert 10 * np.log10(255**2 / np.square(averaged - own.rgb).mean()) > 42  # 33 dB where needles come out
    assert abs(averaged.mean() - own.rgb.mean()) < 0.5
    assert large.unseen_share == pytest.approx(own.unseen_share, abs=0.005)


def test_another_camera_looks_at_the_same_tissue(scene: TrainedScene) -> None:
    camera = scene.intrinsics
    right_half = Intrinsics(
        width=WIDTH // 2, height=HEIGHT, fx=camera.fx, fy=camera.fy, cx=camera.cx - WIDTH // 2, cy=camera.cy
    )
    whole, half = render_frame(scene, 0.5), render_frame(scene, 0.5, None, right_half)
    assert_close(half.rgb, whole.rgb[:, WIDTH // 2 :], absolute=1, relative=0)
    assert_close(half.depth_mm, whole.depth_mm[:, WIDTH // 2 :], relative=1e-4)


def test_depth_is_in_mm(scene: TrainedScene) -> None:
    clip = phantom_clip()
    for index in (1, 9):  # held out
        tissue = clip.tissue[index]
        error_mm = np.abs(render_frame(scene, float(clip.t[index])).depth_mm - clip.depth_mm[index])[tissue]
        assert np.median(error_mm) < 2


def test_confidence_falls_with_the_distance_from_the_endoscope(scene: TrainedScene) -> None:
    depth_mm = 60 / scene.units_per_mm
    means = [render_frame(scene, 0.5, shifted(share * depth_mm)).confidence for share in (0, 0.1, 0.2, 0.3, 0.6)]
    levels = [float(np.median(each[each > 0])) for each in means]
    assert levels == sorted(levels, reverse=True)
    assert levels[0] > 0.5
    assert levels[-1] < levels[0] / 2  # 30 degrees aside


def codes_from(scene: TrainedScene, orbit: str) -> set[NoticeCode]:
    return {warning.code for warning in render_frame(scene, 0.5, pose_of(scene, parse_pose(orbit))).warnings}


@pytest.mark.parametrize(("orbit", "is_far"), [("15,0,1", False), ("-25,0,1", True), ("0,25,2", True)])
def test_a_view_from_far_beside_the_endoscope_warns(scene: TrainedScene, orbit: str, is_far: bool) -> None:
    assert (NoticeCode.POSE_FAR in codes_from(scene, f"orbit:{orbit}")) is is_far


def test_a_view_along_the_surface_names_no_figure(scene: TrainedScene) -> None:
    texts = [each.text for each in render_frame(scene, 0.5, pose_of(scene, parse_pose("orbit:90,0,1"))).warnings]
    assert texts[0].startswith("This view looks from more than 60 degrees beside the endoscope")
    assert all("more than 100 times" in text for text in texts if "enlarged" in text)


def test_a_view_shifted_aside_warns_at_the_angle_of_an_orbit(scene: TrainedScene) -> None:
    depth_mm = 60 / scene.units_per_mm
    for share, is_far in ((0.3, False), (0.45, True)):
        warnings = render_frame(scene, 0.5, shifted(share * depth_mm)).warnings
        assert (NoticeCode.POSE_FAR in [each.code for each in warnings]) is is_far


def test_coming_straight_nearer_or_farther_is_no_guess_and_a_great_enlargement_is_named(scene: TrainedScene) -> None:
    for zoom in (0.6, 1.5, 2.12, 3.9):
        assert not {NoticeCode.POSE_FAR, NoticeCode.ENLARGED} & codes_from(scene, f"orbit:0,0,{zoom}")
    near = codes_from(scene, "orbit:0,0,6")
    assert NoticeCode.ENLARGED in near
    assert NoticeCode.POSE_FAR not in near


def test_a_view_of_nothing_is_empty_and_says_so(scene: TrainedScene) -> None:
    away = np.eye(4)
    away[:3, :3] = np.diag([-1.0, 1.0, -1.0])  # turned about
    frame = render_frame(scene, 0.5, away)
    assert not frame.depth_mm.any()
    assert not frame.confidence.any()
    assert frame.unseen.all()
    assert NoticeCode.UNSEEN in [warning.code for warning in frame.warnings]


@pytest.mark.parametrize("preset", [*PRESETS, *LABORATORY_PRESETS])
def test_a_stored_scene_renders_as_the_model_did(preset: str, tmp_path: Path) -> None:
    run, scene = made(preset)
    save_scene(tmp_path, scene)
    stored = load_scene(tmp_path)
    for index in (0, 5, 11):
        shown = view(run, index)
        frame = render_frame(stored, index / FRAMES)
        assert np.abs(np.clip(shown.rgb, 0, 1) * 255 - frame.rgb).max() <= 1
        assert_close(frame.depth_mm, shown.depth_mm, relative=1e-4)


def test_sizes_come_and_go_without_changing_a_picture(scene: TrainedScene) -> None:
    first = render_frame(scene, 0.2).rgb
    for width in range(40, 48):
        render_frame(scene, 0.7, None, scene.intrinsics.resized(width, 30))
    np.testing.assert_array_equal(render_frame(scene, 0.2).rgb, first)


def test_frames_of_one_size_that_are_made_in_turn_part_by_part_are_what_each_is_alone(scene: TrainedScene) -> None:
    camera = scene.intrinsics.resized(1100, 1000)
    views = [ViewRequest(scene, 0.5, orbit_pose(yaw_deg, 0.0), camera) for yaw_deg in (0.0, 10.0)]
    alone = [render_frame(scene, 0.5, each.pose, camera) for each in views]
    under_way = {place: frame_in_parts(each, with_confidence=place == 1) for place, each in enumerate(views)}
    made: dict[int, View] = {}
    rounds = 0
    while under_way:
        rounds += 1
        for place, parts in list(under_way.items()):
            try:
                next(parts)
            except StopIteration as end:
                made[place] = end.value
                del under_way[place]
    assert rounds > 8
    for place, expected in enumerate(alone):
        for name in ("rgb", "depth_mm", "unseen", "confidence"):
            np.testing.assert_array_equal(getattr(made[place], name), getattr(expected, name))
        assert (made[place].unseen_share, made[place].warnings) == (expected.unseen_share, expected.warnings)


def test_a_frame_that_is_abandoned_leaves_the_next_as_it_is(scene: TrainedScene) -> None:
    camera = scene.intrinsics.resized(1100, 1000)
    expected = render_frame(scene, 0.5, None, camera).rgb
    parts = frame_in_parts(ViewRequest(scene, 0.2, None, camera))
    next(parts)
    next(parts)
    parts.close()
    np.testing.assert_array_equal(render_frame(scene, 0.5, None, camera).rgb, expected)


def test_a_scene_that_is_dropped_takes_its_renderer_along() -> None:
    scene = random_scene()
    render_frame(scene, 0.0)
    alive = weakref.ref(scene)
    del scene
    gc.collect()
    assert alive() is None


def test_a_moving_camera_is_followed() -> None:
    clip = phantom_clip(moving_camera=True)
    _, scene = made(moving_camera=True, iterations=60)
    assert not np.array_equal(clip.world_from_camera[9], np.eye(4))
    held_out = 9
    t = float(clip.t[held_out])
    assert_close(endoscope_pose(scene, t), clip.world_from_camera[held_out])
    own, standing = (render_frame(scene, t, pose).rgb / np.float32(255) for pose in (None, np.eye(4)))
    own_db, standing_db = (psnr_tissue(each, clip.rgb[held_out], clip.tissue[held_out]) for each in (own, standing))
    assert own_db > max(standing_db + 1, 22)


def test_between_frames_the_endoscope_is_half_way() -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[2] = orbit_pose(20, 0)
    poses[2, :3, 3] = [4.0, 2.0, 0.0]
    scene = dataclasses.replace(random_scene(), world_from_camera=poses, frame_times_s=np.arange(4) / 30)
    half = endoscope_pose(scene, 1.5 / 4)
    assert_close(half[:3, 3], np.array([2.0, 1.0, 0.0]))
    turned = Rotation.from_matrix(half[:3, :3]).magnitude()
    assert turned == pytest.approx(Rotation.from_matrix(poses[2, :3, :3]).magnitude() / 2)
    for frame in range(4):
        assert_close(endoscope_pose(scene, frame / 4), poses[frame])
    assert_close(endoscope_pose(scene, 5.0), poses[3])
    assert_close(endoscope_pose(scene, -5.0), poses[0])


def test_a_scene_of_one_frame_stands_still() -> None:
    scene = dataclasses.replace(
        random_scene(), world_from_camera=np.eye(4)[None], frame_times_s=np.zeros(1), trained_t=(0.0,)
    )
    assert_close(endoscope_pose(scene, 0.7), np.eye(4))
    assert render_frame(scene, 0.7).rgb.shape == (48, 64, 3)


def test_the_range_of_false_colours_holds_nearly_all_depths_of_the_clip_and_moves_with_the_camera(
    scene: TrainedScene,
) -> None:
    found = renderer_of(scene).depth_range
    near_mm, far_mm = found.before(None)
    for t in (0.0, 0.4, LAST):
        depth_mm = render_frame(scene, t).depth_mm
        assert ((near_mm <= depth_mm) & (depth_mm <= far_mm))[depth_mm > 0].mean() > 0.85
    assert found.before(shifted(5.0)) == (near_mm, far_mm)
    nearer = np.eye(4)
    nearer[2, 3] = 10.0
    assert found.before(nearer) == (near_mm - 10, far_mm - 10)


def test_what_lies_far_before_the_tissue_does_not_stretch_the_range_of_false_colours(scene: TrainedScene) -> None:
    near_mm, far_mm = renderer_of(scene).depth_range.before(None)
    mean = scene.gaussians.mean.clone()
    mean[::25, 2] *= 0.4
    outlying = dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, mean=mean))
    assert renderer_of(outlying).depth_range.before(None) == pytest.approx((near_mm, far_mm), abs=2)


def test_a_caller_chooses_the_ends_of_the_false_colours(scene: TrainedScene) -> None:
    found = renderer_of(scene).depth_range
    near_mm, far_mm = found.before(None)
    assert found.chosen(None, None, None) == (near_mm, far_mm)
    assert found.chosen(None, 3, far_mm + 5) == (3, far_mm + 5)
    with pytest.raises(InputError) as refused:
        found.chosen(None, int(far_mm) + 1, None)
    assert refused.value.field == "far_mm"


def test_the_range_of_false_colours_has_a_width_where_nothing_is_in_view() -> None:
    scene = random_scene()
    scene.gaussians.mean[:, 2] = -60.0
    near_mm, far_mm = renderer_of(scene).depth_range.before(None)
    assert near_mm < far_mm
