"""The phantom's truth against itself, its motions, and its files against their readers. H W pixels, T frames."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip.types import DepthClip
from intrasplat.errors import InputError
from lab.phantom import MOTIONS, CameraPath, Motion, Phantom, PhantomSettings, Tool, make_phantom, orbit_pose

PERIOD = 12.0


@cache
def phantom(
    motion: Motion = "breathing",
    *camera: CameraPath,
    noise: bool = False,
    tools: tuple[Tool, ...] = ("grasper",),
    rate_hz: float = 25.0,
) -> Phantom:
    return make_phantom(
        PhantomSettings(
            160, 128, 12, motion, noise=noise, tools=tools, camera=camera, period_frames=PERIOD, frame_rate_hz=rate_hz
        )
    )


def pixel_rays(camera: Intrinsics) -> NDArray[np.float64]:
    """[H, W, 3] with z = 1."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)


def look_up(image: NDArray[np.float32], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float32]:
    """Bilinear values of image at pixel positions x, y (centres at +0.5); NaN outside."""
    maps = [np.atleast_2d(place - 0.5).astype(np.float32) for place in (x, y)]
    found = cv2.remap(
        image, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 4
    )
    return np.asarray(found).reshape(x.shape + image.shape[2:])


def project(
    points_mm: NDArray[np.float64], world_from_camera: NDArray[np.float64], camera: Intrinsics
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """(x, y, z) of world points [..., 3]."""
    local = (points_mm - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    z = local[..., 2]
    return camera.fx * local[..., 0] / z + camera.cx, camera.fy * local[..., 1] / z + camera.cy, z


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_same_seed_gives_the_same_bits_and_another_seed_other_tissue(motion: Motion) -> None:
    settings = PhantomSettings(96, 80, 4, motion, seed=7)
    one, two = make_phantom(settings).frame(3), make_phantom(settings).frame(3)
    for name in ("left", "right", "tissue", "depth_mm", "hidden_rgb"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    other = make_phantom(PhantomSettings(96, 80, 4, motion, seed=8)).frame(3)
    assert np.abs(one.hidden_depth_mm - other.hidden_depth_mm).mean() > 1


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_pixel_shows_tissue_at_a_depth_of_an_abdomen(motion: Motion) -> None:
    for index in (0, 5, 11):
        depth_mm = phantom(motion).frame(index).hidden_depth_mm
        assert depth_mm.min() > 40
        assert depth_mm.max() < 112
        assert np.ptp(depth_mm) > 20


def test_a_larger_picture_shows_the_same_tissue() -> None:
    small, large = (make_phantom(PhantomSettings(96 * k, 80 * k, 1)).frame(0) for k in (1, 3))
    assert np.median(np.abs(small.hidden_depth_mm - large.hidden_depth_mm[1::3, 1::3])) < 0.1
    colours = [
        cv2.GaussianBlur(cv2.resize(frame.hidden_rgb, (96, 80), interpolation=cv2.INTER_AREA), (0, 0), 2)[..., 1]
        for frame in (small, large)
    ]
    assert np.corrcoef(colours[0].ravel(), colours[1].ravel())[0, 1] > 0.9


@pytest.mark.parametrize("motion", MOTIONS)
def test_left_depth_lands_on_the_same_surface_in_the_right_eye(motion: Motion) -> None:
    scene, index = phantom(motion), 6
    camera, baseline_mm = scene.settings.intrinsics, scene.settings.baseline_mm
    right_pose = np.eye(4)
    right_pose[0, 3] = baseline_mm
    _, right_depth_mm = scene.render(index, right_pose)
    depth_mm = scene.frame(index).hidden_depth_mm.astype(np.float64)
    x, y, z = project(pixel_rays(camera) * depth_mm[..., None], right_pose, camera)
    inside = (x > 1) & (x < camera.width - 1) & (y > 1) & (y < camera.height - 1)
    difference_mm = (z - look_up(right_depth_mm, x, y))[inside]
    assert np.median(np.abs(difference_mm)) < 0.02
    assert np.quantile(difference_mm, 0.95) < 1.0  # behind the right eye's surface: hidden from it
    assert np.quantile(difference_mm, 0.01) > -0.5  # never in front of it


def test_the_right_picture_matches_at_the_true_disparity_and_at_no_other() -> None:
    scene = phantom(noise=True)
    camera, frame = scene.settings.intrinsics, scene.frame(3)
    disparity_px = camera.fx * scene.settings.baseline_mm / frame.depth_mm
    rays = pixel_rays(camera)
    x, y = rays[..., 0] * camera.fx + camera.cx, rays[..., 1] * camera.fy + camera.cy

    def difference(offset_px: float) -> float:
        matched = look_up(frame.right.astype(np.float32), x - disparity_px - offset_px, y)
        error = np.abs(matched - frame.left).mean(-1)
        return float(np.median(error[frame.tissue & np.isfinite(error)]))

    errors = {offset: difference(offset) for offset in (-1.0, -0.25, 0.0, 0.25, 1.0)}
    assert min(errors, key=lambda offset: errors[offset]) == 0.0
    assert errors[0.0] < 4.0
    assert min(errors[-1.0], errors[1.0]) > 2 * errors[0.0]


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_hidden_surface_is_the_visible_one_wherever_no_tool_is(motion: Motion) -> None:
    scene = phantom(motion)
    for index in (0, 4, 8):
        frame = scene.frame(index)
        assert 0.005 < 1 - frame.tissue.mean() < 0.4
        np.testing.assert_array_equal(frame.depth_mm[frame.tissue], frame.hidden_depth_mm[frame.tissue])
        np.testing.assert_allclose(frame.left[frame.tissue] / 255, frame.hidden_rgb[frame.tissue], atol=0.51 / 255)
        covered = ~frame.tissue
        assert np.abs(frame.left[covered] / 255 - frame.hidden_rgb[covered]).mean() > 0.05
        assert (frame.depth_mm <= frame.hidden_depth_mm).all()


def test_without_tools_the_tissue_is_the_same_and_all_of_it_is_seen() -> None:
    bare, full = phantom(tools=()).frame(2), phantom().frame(2)
    assert bare.tissue.all()
    assert bare.tissue_right.all()
    np.testing.assert_array_equal(bare.hidden_rgb, full.hidden_rgb)
    np.testing.assert_array_equal(bare.depth_mm, full.hidden_depth_mm)


def test_the_instrument_hides_different_tissue_over_time_and_its_masks_differ_by_disparity() -> None:
    scene = phantom()
    frames = [scene.frame(index) for index in (0, 6, 11)]
    seen_sometimes = np.logical_or.reduce([frame.tissue for frame in frames])
    hidden_once = np.logical_or.reduce([~frame.tissue for frame in frames])
    assert hidden_once.sum() > 1.2 * min(int((~frame.tissue).sum()) for frame in frames)
    assert (seen_sometimes & hidden_once).any()
    left_column = np.nonzero(~frames[0].tissue)[1].min()
    right_column = np.nonzero(~frames[0].tissue_right)[1].min()
    assert left_column > right_column


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("camera", [(), ("swing",)])
def test_tracked_points_lie_on_the_depth_map_unless_tissue_covers_them(
    motion: Motion, camera: tuple[CameraPath, ...]
) -> None:
    scene = phantom(motion, *camera)
    camera, tracks = scene.settings.intrinsics, scene.trajectories(stride_px=4)
    first = scene.frame(0)
    rows, columns = tracks.pixels.T
    x, y, z = project(tracks.points_mm[0], first.world_from_camera, camera)
    np.testing.assert_allclose(x, columns + 0.5, atol=1e-3)
    np.testing.assert_allclose(y, rows + 0.5, atol=1e-3)
    np.testing.assert_allclose(z, first.hidden_depth_mm[rows, columns], rtol=1e-6)
    for index in (4, 9):
        _, depth_mm = scene.render(index)
        x, y, z = project(tracks.points_mm[index], scene.world_from_camera(index), camera)
        inside = (np.abs(x - camera.cx) < camera.width / 2 - 1) & (np.abs(y - camera.cy) < camera.height / 2 - 1)
        behind_mm = (z - look_up(depth_mm, x, y))[inside]
        assert np.median(np.abs(behind_mm)) < 0.03
        assert np.mean(np.abs(behind_mm) < 0.5) > 0.9
        assert np.quantile(behind_mm, 0.01) > -0.7  # bilinear depth is wrong by this much at edges


def test_colour_travels_with_the_material_point() -> None:
    scene = phantom("pull", tools=())
    camera, tracks = scene.settings.intrinsics, scene.trajectories(stride_px=4)
    rows, columns = tracks.pixels.T
    before = scene.frame(0).hidden_rgb[rows, columns]
    rgb, _ = scene.render(6)
    x, y, _ = project(tracks.points_mm[6], scene.world_from_camera(6), camera)
    followed, stayed = look_up(rgb, x, y), rgb[rows, columns]
    hue = [colour[:, 1] / colour[:, 0] for colour in (before, followed, stayed)]
    known = np.isfinite(hue[1])
    moved = known & (np.linalg.norm(tracks.points_mm[6] - tracks.points_mm[0], axis=-1) > 4)
    assert moved.sum() > 50
    assert np.median(np.abs(hue[1] - hue[0])[moved]) < 0.6 * np.median(np.abs(hue[2] - hue[0])[moved])


def test_still_tissue_is_really_still() -> None:
    scene = phantom("still")
    first, last = scene.frame(0), scene.frame(11)
    np.testing.assert_array_equal(first.hidden_rgb, last.hidden_rgb)
    np.testing.assert_array_equal(first.hidden_depth_mm, last.hidden_depth_mm)
    assert not np.array_equal(first.tissue, last.tissue)
    assert np.ptp(scene.trajectories(16).points_mm, axis=0).max() == 0


def test_breathing_moves_smoothly_and_comes_back() -> None:
    surface = phantom("breathing").surface
    rest = surface.vertices_mm(0.0)
    np.testing.assert_allclose(surface.vertices_mm(PERIOD), rest, atol=1e-9)
    travelled = np.linalg.norm(surface.vertices_mm(PERIOD / 4) - rest, axis=-1)
    assert 3 < travelled.max() < 12


def test_pull_lifts_a_fold_far_and_lets_it_fall_back() -> None:
    surface = phantom("pull").surface
    rest, held, after = (surface.vertices_mm(PERIOD * share) for share in (0.0, 0.6, 1.0))
    assert (rest - held)[:, 2].max() > 12
    np.testing.assert_allclose(after, rest, atol=1e-6)


def test_cut_opens_and_shows_deeper_tissue() -> None:
    scene = make_phantom(PhantomSettings(160, 128, 24, "cut", tools=(), noise=False, period_frames=PERIOD))
    groove = scene.surface.atlas.groove_row

    def groove_pixels(index: int) -> int:
        left, right, floor = (patch.rest_mm.shape[0] * patch.rest_mm.shape[1] for patch in scene.surface.patches)
        vertices = scene.surface.vertices_mm(index)[left + right :]
        assert len(vertices) == floor
        assert (scene.surface.atlas_xy[left + right :, 1] >= groove).all()
        return int(np.ptp(vertices[:, 0].reshape(scene.surface.patches[2].rest_mm.shape[:2]), axis=1).max() * 100)

    closed, half, opened = (groove_pixels(index) for index in (0, 12, 23))
    assert closed == 0
    assert 200 < half <= opened
    red = [scene.frame(index).hidden_rgb[44:84, 66:94].mean(axis=(0, 1)) for index in (0, 23)]
    assert red[1][1] / red[1][0] < red[0][1] / red[0][0] - 0.03


def test_a_free_viewpoint_agrees_with_frame_depth() -> None:
    scene = phantom("pull")
    camera, pose = scene.settings.intrinsics, orbit_pose(12, 6)
    rgb, depth_mm = scene.render(5, pose)
    assert (depth_mm > 0).all()
    assert rgb.min() >= 0
    assert rgb.max() <= 1
    own = scene.frame(5).hidden_depth_mm
    x, y, z = project(pixel_rays(camera) * own[..., None].astype(np.float64), pose, camera)
    inside = (x > 1) & (x < camera.width - 1) & (y > 1) & (y < camera.height - 1)
    behind_mm = (z - look_up(depth_mm, x, y))[inside]
    assert np.median(np.abs(behind_mm)) < 0.05
    assert np.quantile(behind_mm, 0.01) > -1.0


def test_a_render_of_another_size_shows_the_same_view() -> None:
    scene = phantom()
    rgb, depth_mm = scene.render(2, intrinsics=scene.settings.intrinsics.resized(80, 64))
    assert rgb.shape == (64, 80, 3)
    full = scene.frame(2).hidden_depth_mm
    corners = full.reshape(64, 2, 80, 2).mean(axis=(1, 3))
    assert np.median(np.abs(depth_mm - corners)) < 0.02


def test_depth_clip_holds_the_frames() -> None:
    clip, frame = phantom(noise=True).depth_clip(), phantom(noise=True).frame(7)
    assert isinstance(clip, DepthClip)
    np.testing.assert_array_equal(clip.rgb[7], frame.left)
    np.testing.assert_array_equal(clip.tissue[7], frame.tissue)
    np.testing.assert_array_equal(clip.depth_mm[7], frame.depth_mm)
    assert clip.frame_count == 12


def test_noise_is_small_seeded_and_optional() -> None:
    noisy, clean = phantom(noise=True).frame(1), phantom().frame(1)
    difference = noisy.left.astype(float) - clean.left
    assert 0.5 < difference.std() < 4
    assert abs(difference.mean()) < 0.3
    np.testing.assert_array_equal(noisy.hidden_rgb, clean.hidden_rgb)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("width", 32),
        ("height", 47),
        ("frames", 0),
        ("motion", "dance"),
        ("seed", -1),
        ("baseline_mm", float("nan")),
        ("tools", ("spoon",)),
        ("tools", ("steel",) * 4),
        ("camera", ("fly",)),
        ("camera", ("pan", "pan")),
    ],
)
def test_settings_that_cannot_be_drawn_name_the_option(field: str, value: object) -> None:
    with pytest.raises(InputError) as raised:
        PhantomSettings(**{field: value})  # type: ignore[arg-type]
    assert raised.value.field == f"options.{field}"


def test_settings_of_an_extreme_shape_are_refused() -> None:
    with pytest.raises(InputError, match="4 times"):
        PhantomSettings(1000, 100)


@pytest.mark.parametrize(
    ("width", "height", "motion"),
    [(64, 48, "cut"), (97, 61, "pull"), (192, 48, "cut"), (64, 200, "breathing"), (65, 49, "still")],
)
def test_any_size_is_covered_by_tissue(width: int, height: int, motion: Motion) -> None:
    frame = make_phantom(PhantomSettings(width, height, 60, motion, camera=("swing",))).frame(59)
    assert frame.left.shape == frame.right.shape == (height, width, 3)
    assert (frame.hidden_depth_mm > 0).all()


def test_the_stereo_recording_is_what_the_frames_show() -> None:
    scene = make_phantom(PhantomSettings(96, 80, 3, "pull", camera=("swing",)))
    drawn = scene.stereo_recording()
    for index, (left, right) in enumerate(drawn.clip.pairs()):
        frame = scene.frame(index)
        np.testing.assert_array_equal(left, frame.left)
        np.testing.assert_array_equal(right, frame.right)
        np.testing.assert_array_equal(drawn.tissue_right[index], frame.tissue_right)
    assert drawn.clip.tissue is not None
    np.testing.assert_array_equal(drawn.clip.tissue[1], scene.frame(1).tissue)
    assert drawn.calibration.baseline_mm == scene.settings.baseline_mm
