"""Places and distances: as the layers have them, refused where nothing is known, true within what they state."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.errors import InputError
from intrasplat.measuring import RefusalCode
from intrasplat.notices import NoticeCode
from intrasplat.outcome import scene_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.deformation import SharedBasis
from intrasplat.view.measure import (
    DISPARITY_PX,
    MIN_CONFIDENCE,
    UNKNOWN_BASELINE_MM,
    distances,
    places_at,
    uncertainty_mm,
)
from intrasplat.view.measured import EXPANDED, measured
from intrasplat.view.render import render_frame
from intrasplat.view.renderer import renderer_of
from lab.phantom import Phantom, PhantomSettings, make_phantom, orbit_pose
from tests.intrasplat.phantoms import FRAMES, HEIGHT, WIDTH, phantom_clip, prepared, trained

T_SHOWN = 5 / FRAMES
POINTS = ((10.5, 12.5), (48.2, 40.7), (85.5, 66.5), (0.0, 0.0), (WIDTH - 0.01, HEIGHT - 0.01), (30.5, 60.5))
BESIDE = orbit_pose(0.0, 8.0, 0.0)


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return make_phantom(PhantomSettings(width=WIDTH, height=HEIGHT, frames=FRAMES, tools=(), period_frames=12.0))


@pytest.fixture(scope="module")
def scene(phantom: Phantom) -> TrainedScene:
    run, _ = prepared(phantom.depth_clip(), "fast", iterations=60)
    return scene_of(trained(run))


@pytest.mark.parametrize("motion_error", [0, 200])
@pytest.mark.parametrize("pose", [None, BESIDE], ids=["endoscope", "beside"])
def test_depth_and_confidence_are_those_of_the_layers(
    scene: TrainedScene, pose: NDArray[np.float64] | None, motion_error: float
) -> None:
    scene = dataclasses.replace(scene, settings={"motion_error": motion_error})
    frame = render_frame(scene, T_SHOWN, pose)
    for (x, y), place in zip(POINTS, places_at(scene, T_SHOWN, pose, scene.intrinsics, POINTS), strict=True):
        assert place.depth_mm == pytest.approx(frame.depth_mm[int(y), int(x)], abs=0.02)
        assert place.confidence == pytest.approx(frame.confidence[int(y), int(x)], abs=0.08)
        assert place.unseen == frame.unseen[int(y), int(x)]
        assert place.shares.sum() == pytest.approx(1)


@pytest.mark.parametrize("scale", [0.5, 2, 3])
def test_what_is_measured_does_not_depend_on_the_size_of_the_picture(scene: TrainedScene, scale: float) -> None:
    camera = scene.intrinsics.resized(round(scale * WIDTH), round(scale * HEIGHT))
    points = [(scale * x, scale * y) for x, y in POINTS]
    own = places_at(scene, T_SHOWN, BESIDE, scene.intrinsics, POINTS)
    for place, same in zip(own, places_at(scene, T_SHOWN, BESIDE, camera, points), strict=True):
        assert same.confidence == pytest.approx(place.confidence, abs=1e-6)
        assert same.uncertainty_mm == pytest.approx(place.uncertainty_mm, abs=1e-6)
        assert same.point_mm == pytest.approx(place.point_mm, abs=1e-3)


def test_a_place_lies_on_the_ray_of_its_point_at_its_depth(scene: TrainedScene) -> None:
    (place,) = places_at(scene, T_SHOWN, BESIDE, scene.intrinsics, [(30.25, 41.5)])
    seen = np.linalg.inv(BESIDE) @ [*place.point_mm, 1]
    k = scene.intrinsics
    assert seen[2] == pytest.approx(place.depth_mm)
    assert (k.fx * seen[0] / seen[2] + k.cx, k.fy * seen[1] / seen[2] + k.cy) == pytest.approx((30.25, 41.5))


def test_known_distances_are_measured_within_half_a_millimetre_or_what_is_stated(
    scene: TrainedScene, phantom: Phantom
) -> None:
    truth = phantom.trajectories(stride_px=14, shown_in=5)
    points = [(column + 0.5, row + 0.5) for row, column in truth.pixels]
    places = places_at(scene, T_SHOWN, None, scene.intrinsics, points)
    good, all_mm = [], []
    for first, second in zip(range(0, len(places) - 1), range(1, len(places)), strict=True):
        found = distances(scene, T_SHOWN, places[first], places[second])
        true_mm = np.linalg.norm(truth.points_mm[:, first] - truth.points_mm[:, second], axis=1)
        assert found.known.all()
        assert found.now_mm == pytest.approx(found.distances_mm[5], abs=1e-6)
        assert found.now_uncertainty_mm == pytest.approx(found.uncertainties_mm[5], rel=1e-6)
        error_mm = np.abs(found.distances_mm - true_mm)
        good.append(error_mm <= np.maximum(0.5, EXPANDED * found.uncertainties_mm))
        all_mm.append(true_mm)
    assert np.mean(good) > 0.9
    assert np.ptp(all_mm, axis=1).max() > 0.5  # they change


def sheet(width_mm: float = 40.0) -> TrainedScene:
    """A plane of Gaussians 60 mm away that every frame saw; it stretches to the right by a tenth until the last one."""
    x, y = np.meshgrid(np.linspace(-width_mm, width_mm, 81), np.linspace(-width_mm, width_mm, 81))
    run, _ = prepared(phantom_clip(), "fast", iterations=1)
    small = scene_of(run)
    count, frames = x.size, 5
    mean = torch.tensor(np.stack([x.ravel(), y.ravel(), np.full(count, 60.0)], 1), dtype=torch.float32)
    gaussians = dataclasses.replace(
        small.gaussians,
        mean=mean,
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scale=torch.full((count, 3), 0.0),
        opacity_logit=torch.full((count,), 4.0),
        sh=torch.zeros(count, 1, 3),
        gloss=torch.zeros(count),
    )
    start = SharedBasis.initial(count, bases=2)
    return TrainedScene(
        gaussians=gaussians,
        deformation=SharedBasis(torch.zeros(count, *start.weight.shape[1:]), start.centre, start.width),
        intrinsics=Intrinsics(width=96, height=80, fx=100.0, fy=100.0, cx=48.0, cy=40.0),
        world_from_camera=np.tile(np.eye(4), (frames, 1, 1)),
        frame_times_s=np.arange(frames) / 25,
        units_per_mm=1.0,
        preset="fast",
        trained_t=tuple(i / frames for i in range(frames)),
        seen=torch.full((count,), 0.97),
    )


def stretched(scene: TrainedScene) -> TrainedScene:
    """The sheet, each place moved away from the middle in step with the first basis."""
    motion = scene.deformation
    assert isinstance(motion, SharedBasis)
    weight = motion.weight.clone()
    weight[:, 0, 0] = 0.1 * scene.gaussians.mean[:, 0]
    return dataclasses.replace(scene, deformation=SharedBasis(weight, motion.centre, motion.width))


def test_points_are_carried_along_by_the_gaussians_that_make_them() -> None:
    scene = stretched(sheet())
    first, second = places_at(scene, 0.0, None, scene.intrinsics, [(30.5, 40.5), (70.5, 40.5)])
    found = distances(scene, 0.0, first, second)
    model = renderer_of(scene)
    for frame in range(scene.frame_count):
        means = model.means_mm(frame / scene.frame_count)
        stretch = np.ptp(means[:, 0]) / np.ptp(model.means_mm(0.0)[:, 0])
        assert found.distances_mm[frame] == pytest.approx(found.now_mm * stretch, rel=1e-3)
    assert np.ptp(found.distances_mm) > 0.05
    np.testing.assert_allclose(np.linalg.norm(found.paths_mm[1] - found.paths_mm[0], axis=1), found.distances_mm)


def test_the_uncertainty_falls_with_confidence_and_with_the_distance_of_the_eyes_and_grows_with_depth() -> None:
    scene = sheet()
    assert uncertainty_mm(scene, 60, 0.3, 0.9) < uncertainty_mm(scene, 60, 0.3, 0.6)
    assert uncertainty_mm(scene, 60, 0.3, 0.9) < uncertainty_mm(scene, 90, 0.3, 0.9)
    assert uncertainty_mm(scene, 60, 0.3, 0.9) < uncertainty_mm(scene, 60, 0.9, 0.9)
    wide = dataclasses.replace(scene, right_eye_mm=(2 * UNKNOWN_BASELINE_MM, 0.0, 0.0))
    assert uncertainty_mm(wide, 60, 0.3, 0.9) < uncertainty_mm(scene, 60, 0.3, 0.9)
    two_thirds = 0.6827  # of a normal distribution lie within one standard deviation
    px_mm = 60**2 / (scene.intrinsics.fx * UNKNOWN_BASELINE_MM)
    assert uncertainty_mm(scene, 60, 0, two_thirds) == pytest.approx(DISPARITY_PX * px_mm, rel=1e-3)
    assert np.isfinite([uncertainty_mm(scene, 60, 0.3, each) for each in (0.0, 1.0)]).all()


def test_points_that_lie_close_together_are_no_surer_than_their_depths() -> None:
    scene = sheet()
    first, second, far = places_at(scene, 0.0, None, scene.intrinsics, [(40.5, 40.5), (40.6, 40.5), (80.5, 40.5)])
    close, apart = (distances(scene, 0.0, first, each) for each in (second, far))
    whole_mm = np.hypot(first.uncertainty_mm, second.uncertainty_mm)
    assert 0.5 * whole_mm < close.now_uncertainty_mm < 1.5 * whole_mm
    assert apart.now_uncertainty_mm < close.now_uncertainty_mm
    same = distances(scene, 0.0, first, first)
    assert same.now_mm == 0
    assert np.isfinite(same.uncertainties_mm).all()


def test_a_place_that_has_left_the_view_for_long_is_not_measured_then() -> None:
    still = sheet()
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[3:, 0, 3] = 400.0
    scene = dataclasses.replace(still, world_from_camera=poses, frame_times_s=np.array([0.0, 1, 2, 3, 9]))
    first, second = places_at(scene, 0.0, None, scene.intrinsics, [(30.5, 40.5), (70.5, 40.5)])
    known = distances(scene, 0.0, first, second).known
    assert known[:3].all()
    assert not known[4]
    found = measured(scene, 0.0, None, scene.intrinsics, ((30.5, 40.5), (70.5, 40.5))).distance
    assert found is not None
    assert [each is None for each in found.distances_mm] == [not each for each in known]


def test_what_is_measured_is_told_with_the_range_of_the_colours_and_the_time(scene: TrainedScene) -> None:
    found = measured(scene, 3.0, None, scene.intrinsics, ((48.5, 40.5),))
    assert found.t == (FRAMES - 1) / FRAMES
    assert [each.code for each in found.warnings] == [NoticeCode.TIME_OUTSIDE_CLIP]
    (point,) = found.points
    assert point.refusal is None
    assert found.distance is None
    assert found.depth_range_mm == renderer_of(scene).depth_range.before(None)
    assert point.depth_mm is not None
    assert point.mm_per_px == pytest.approx(point.depth_mm / scene.intrinsics.fx, rel=1e-4)
    (place,) = places_at(scene, found.t, None, scene.intrinsics, [(48.5, 40.5)])
    assert point.uncertainty_mm == pytest.approx(EXPANDED * place.uncertainty_mm, abs=1e-4)
    assert "Research use only" in found.notice


@pytest.mark.parametrize(
    ("seen", "code"), [(0.03, RefusalCode.LOW_CONFIDENCE), (0.0, RefusalCode.UNSEEN), (0.97, None)]
)
def test_what_is_unsure_or_was_never_seen_is_refused_without_numbers(seen: float, code: RefusalCode | None) -> None:
    whole = sheet()
    half = torch.where(whole.gaussians.mean[:, 0] > 0, seen, 0.97)
    scene = dataclasses.replace(whole, seen=half)
    found = measured(scene, 0.0, None, scene.intrinsics, ((20.5, 40.5), (75.5, 40.5)))
    left, right = found.points
    assert left.refusal is None
    if code is None:
        assert found.distance is not None
        return
    assert right.refusal is not None
    assert (right.refusal.code, right.refusal.field) == (code, "points[1]")
    assert right.refusal.remedy
    assert right.confidence < MIN_CONFIDENCE
    assert (right.depth_mm, right.uncertainty_mm, right.point_mm, right.mm_per_px) == (None,) * 4
    assert found.distance is None


@pytest.mark.parametrize("point", [(-0.1, 5.0), (96.0, 5.0), (5.0, 80.0), (1e9, 0.0)])
def test_a_point_outside_the_picture_is_refused(point: tuple[float, float]) -> None:
    scene = sheet()
    with pytest.raises(InputError) as refused:
        places_at(scene, 0.0, None, scene.intrinsics, [(1.0, 1.0), point])
    assert refused.value.field == "points[1]"


def test_a_scene_that_knows_nothing_of_its_trust_is_refused() -> None:
    scene = sheet()
    unknown = dataclasses.replace(scene, seen=torch.zeros_like(scene.seen))
    with pytest.raises(InputError) as refused:
        places_at(unknown, 0.0, None, scene.intrinsics, [(1.0, 1.0)])
    assert refused.value.field == "scene"
