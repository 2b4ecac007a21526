"""What must hold for every backend whatever it computes: laws, in float32."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from intrasplat.splat import reference
from intrasplat.splat.camera import Rendered
from tests.helpers import assert_close
from tests.intrasplat.splat.scenes import (
    BACKENDS,
    Rasterize,
    SplatScene,
    affordable,
    camera,
    pixels_near_a_cut,
    random_scene,
    unproject,
)


@pytest.fixture(params=sorted(BACKENDS))
def rasterize(request: pytest.FixtureRequest) -> Rasterize:
    return BACKENDS[request.param]


@pytest.fixture
def scene(rasterize: Rasterize) -> SplatScene:
    return random_scene(**affordable(rasterize, 250, width=47, height=38), seed=11).to(torch.float32)


def assert_same(actual: Rendered, expected: Rendered, scene: SplatScene) -> None:
    """Equal but for rounding, where rounding does not choose the side of a threshold."""
    kept = ~pixels_near_a_cut(scene)
    assert kept.mean() > 0.9
    for name in ("rgb", "depth", "alpha"):
        assert_close(getattr(actual, name), getattr(expected, name), where=kept, name=name)


def test_permuting_the_gaussians_changes_nothing(rasterize: Rasterize, scene: SplatScene) -> None:
    shuffled = scene.rows(torch.randperm(len(scene.mean), generator=torch.Generator().manual_seed(4)))
    expected, actual = scene.render(rasterize), shuffled.render(rasterize)
    assert bool((actual.rgb == expected.rgb).all())
    assert bool((actual.depth == expected.depth).all())
    assert bool((actual.alpha == expected.alpha).all())


def test_a_gaussian_of_opacity_zero_changes_nothing(rasterize: Rasterize, scene: SplatScene) -> None:
    hidden = scene.opacity.clone()
    hidden[::3] = 0.0
    kept = scene.rows(torch.tensor([g for g in range(len(scene.mean)) if g % 3]))
    expected, actual = kept.render(rasterize), dataclasses.replace(scene, opacity=hidden).render(rasterize)
    assert bool((actual.rgb == expected.rgb).all())
    assert bool((actual.depth == expected.depth).all())


@pytest.mark.parametrize("factor", [-1.0, 3.0], ids=["the other sign", "another length"])
def test_a_quaternion_turns_alike_with(factor: float, rasterize: Rasterize, scene: SplatScene) -> None:
    again = dataclasses.replace(scene, quaternion=factor * scene.quaternion)
    assert_same(again.render(rasterize), scene.render(rasterize), scene)


def test_the_colour_is_linear_in_the_gaussians_colours(rasterize: Rasterize, scene: SplatScene) -> None:
    swapped = dataclasses.replace(scene, colour=scene.colour.flip(0))
    both = dataclasses.replace(scene, colour=scene.colour - 2 * scene.colour.flip(0))
    expected = scene.render(rasterize).rgb - 2 * swapped.render(rasterize).rgb
    assert_close(both.render(rasterize).rgb, expected, absolute=1e-5)


def test_colour_one_shows_alpha(rasterize: Rasterize, scene: SplatScene) -> None:
    white = dataclasses.replace(scene, colour=torch.ones_like(scene.colour)).render(rasterize)
    assert_close(white.rgb, white.alpha[..., None].expand(-1, -1, 3))
    assert float(white.alpha.min()) >= 0.0
    assert float(white.alpha.max()) <= 1.0


def test_depth_over_alpha_of_one_gaussian_is_its_camera_z(rasterize: Rasterize) -> None:
    scene = random_scene(1, width=19, height=15, seed=1, pixels=4.0).to(torch.float32)
    view = scene.camera
    z = 57.0
    mean = unproject(view, np.array([8.3]), np.array([7.1]), np.array([z]))
    rendered = dataclasses.replace(scene, mean=torch.tensor(mean, dtype=torch.float32)).render(rasterize)
    seen = rendered.alpha > 0
    assert int(seen.sum()) > 20
    assert_close(rendered.depth[seen] / rendered.alpha[seen], torch.full((int(seen.sum()),), z), relative=1e-5)


def test_moving_camera_and_world_together_changes_nothing(rasterize: Rasterize) -> None:
    scene = random_scene(**affordable(rasterize, 250, width=47, height=38), seed=12)
    turn = Rotation.from_euler("xyz", [0.4, 0.2, -0.5])
    shift = np.array([3.0, -1.0, 2.0])
    # x' = turn x + shift, so camera_from_world' = camera_from_world (turn, shift)^-1
    moved_from_world = np.eye(4)
    moved_from_world[:3, :3], moved_from_world[:3, 3] = turn.as_matrix(), shift
    pose = np.asarray(scene.camera.camera_from_world) @ np.linalg.inv(moved_from_world)
    old = Rotation.from_quat(scene.quaternion.numpy(), scalar_first=True)
    moved = dataclasses.replace(
        scene,
        mean=torch.tensor(turn.apply(scene.mean.numpy()) + shift),
        quaternion=torch.tensor((turn * old).as_quat(scalar_first=True)),
        camera=dataclasses.replace(scene.camera, camera_from_world=pose),
    )
    single = torch.float32
    assert_same(moved.to(single).render(rasterize), scene.to(single).render(rasterize), scene)


def test_a_camera_given_as_a_tensor_sees_the_same(rasterize: Rasterize, scene: SplatScene) -> None:
    assert_same(scene.differentiable().render(rasterize), scene.render(rasterize), scene)


def test_a_pose_that_cannot_be_written_sees_the_same(rasterize: Rasterize, scene: SplatScene) -> None:
    pose = np.array(scene.camera.camera_from_world)
    pose.setflags(write=False)
    fixed = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, camera_from_world=pose))
    assert bool((fixed.render(rasterize).rgb == scene.render(rasterize).rgb).all())


def test_project_undoes_unproject() -> None:
    view = camera(31, 24)
    i, j = np.mgrid[:24, :31]
    depth = np.linspace(30.0, 90.0, i.size)
    mean = torch.tensor(unproject(view, j.ravel() + 0.5, i.ravel() + 0.5, depth))
    quaternion, scale = torch.ones(i.size, 4, dtype=torch.float64), torch.ones(i.size, 3, dtype=torch.float64)
    projected = reference.project(mean, quaternion, scale, torch.ones(i.size, dtype=torch.float64), view)
    assert_close(projected.mean2d, np.stack([j.ravel() + 0.5, i.ravel() + 0.5], axis=1), relative=1e-12)
    assert_close(projected.depth, depth, relative=1e-12)
    assert bool(projected.visible.all())


def test_a_footprint_bound_holds_every_pixel_of_its_gaussian() -> None:
    scene = random_scene(80, width=60, height=50, seed=9, pixels=3.0)
    projected = reference.project(*scene.tensors()[:4], scene.camera)
    for g in range(80):
        alpha = scene.rows(torch.tensor([g])).render().alpha
        rows, columns = torch.nonzero(alpha, as_tuple=True)
        if len(rows) == 0:
            continue
        assert bool(projected.visible[g])
        reach = torch.stack([columns + 0.5, rows + 0.5], dim=1) - projected.mean2d[g]
        assert bool((reach.abs() <= projected.half_extent[g]).all())
