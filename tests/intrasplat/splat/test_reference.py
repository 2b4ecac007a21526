"""The reference against a loop over pixels written from the contract, and its gradients against finite differences."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from intrasplat.splat import reference
from intrasplat.splat.camera import Camera, Rendered
from intrasplat.splat.constants import MIN_ALPHA, NEAR
from tests.helpers import assert_close
from tests.intrasplat.splat.scenes import SplatScene, camera, pixels_near_a_cut, random_scene, unproject

STEP = 1e-6
"""Of the central differences, in each input's own unit."""
DIFFERENCE_MARGIN = 1e-6
"""No alpha moves further than this in one step."""


LOOP_SCENES = {
    "one": (1, 9, 7),
    "odd size": (40, 23, 17),
    "over a chunk": (300, 12, 10),
    "two tiles": (90, 33, 16),
}
"""Gaussians, width, height."""


@pytest.mark.parametrize(("count", "width", "height"), LOOP_SCENES.values(), ids=LOOP_SCENES.keys())
def test_the_image_is_what_a_loop_over_pixels_gives(count: int, width: int, height: int) -> None:
    scene = random_scene(count, width=width, height=height, seed=count)
    assert not pixels_near_a_cut(scene, alpha_margin=1e-12, stop_margin=1e-14).any()
    rendered, expected = scene.render(), _loop_over_pixels(scene)
    assert_close(rendered.rgb, expected[..., :3], relative=1e-12, absolute=1e-12, name="rgb")
    assert_close(rendered.depth, expected[..., 3], relative=1e-12, absolute=1e-12, name="depth")
    assert_close(rendered.alpha, expected[..., 4], relative=1e-12, absolute=1e-12, name="alpha")


def test_the_loop_scenes_exercise_every_rule() -> None:
    culled = held = 0
    fullest = 0.0
    for count, width, height in LOOP_SCENES.values():
        scene = random_scene(count, width=width, height=height, seed=count)
        projected = reference.project(*scene.tensors()[:4], scene.camera)
        (low, high), _ = scene.camera.ratio_limits()
        ratio = (projected.mean2d[:, 0] - scene.camera.cx) / scene.camera.fx
        culled += int((~projected.visible).sum())
        held += int((projected.visible & ((ratio < low) | (ratio > high))).sum())
        fullest = max(fullest, float(scene.render().alpha.max()))
    assert culled > 0, "nothing is culled"
    assert held > 0, "no Jacobian is taken at its limit"
    assert fullest > 1 - 1e-4, "no pixel is full"
    assert max(count for count, _, _ in LOOP_SCENES.values()) > reference.CHUNK


@pytest.mark.parametrize("name", ["mean", "quaternion", "scale", "opacity", "colour", "camera_from_world"])
def test_gradients_are_those_of_finite_differences(name: str) -> None:
    _check_gradient(random_scene(14, width=21, height=18, seed=8, pixels=2.5), name)


@pytest.mark.parametrize("name", ["mean", "quaternion", "scale", "opacity", "camera_from_world"])
def test_gradients_are_right_where_the_jacobian_is_held_at_its_limit(name: str) -> None:
    scene = _beyond_the_limits()
    assert bool(reference.project(*scene.tensors()[:4], scene.camera).visible.all())
    _check_gradient(scene, name)


def test_no_gradient_passes_the_alpha_clamp() -> None:
    scene = _one_gaussian(opacity=0.999).differentiable()
    at_clamp = scene.render().alpha[4, 4]
    assert float(at_clamp.detach()) == pytest.approx(0.99, abs=1e-12)
    gradients = torch.autograd.grad(at_clamp, list(scene.leaves().values()), allow_unused=True)
    assert all(each is None or not each.any() for each in gradients)


def test_depth_gradient_reaches_the_gaussians_own_z() -> None:
    scene = _one_gaussian(opacity=0.999).differentiable()  # at the clamp alpha is constant: what is left is w z
    (gradient,) = torch.autograd.grad(scene.render().depth[4, 4], [scene.mean])
    assert_close(gradient, np.array([[0.0, 0.0, 0.99]]), relative=1e-12)


def test_a_pixel_takes_nothing_once_it_is_full() -> None:
    one = _one_gaussian(opacity=0.999)
    stack = one.rows(torch.zeros(4, dtype=torch.long))
    mean = stack.mean.clone()
    mean[:, 2] += torch.arange(4)
    alpha = dataclasses.replace(stack, mean=mean).render().alpha[4, 4]
    # T runs 1, 1e-2, 1e-4 (not below the stop, up to rounding), 1e-6: the fourth never counts.
    assert float(alpha) in (pytest.approx(1 - 1e-4, abs=1e-9), pytest.approx(1 - 1e-6, abs=1e-9))


def test_a_gaussian_at_the_near_plane_or_fainter_than_the_cut_draws_nothing() -> None:
    one = _one_gaussian(opacity=0.9)
    behind = dataclasses.replace(one, mean=torch.tensor([[0.0, 0.0, NEAR]], dtype=torch.float64))
    faint = dataclasses.replace(one, opacity=torch.tensor([MIN_ALPHA * 0.999], dtype=torch.float64))
    for scene in (behind, faint):
        assert not reference.project(*scene.tensors()[:4], scene.camera).visible.any()
        assert float(scene.render().alpha.max()) == 0.0


@pytest.mark.parametrize("scene_name", ["empty", "all culled"])
def test_nothing_to_see_is_black_with_zero_gradients(scene_name: str) -> None:
    one = _one_gaussian(opacity=0.9)
    scene = one.rows(torch.zeros(0, dtype=torch.long)) if scene_name == "empty" else one
    if scene_name == "all culled":
        scene = dataclasses.replace(scene, mean=-scene.mean)
    scene = scene.differentiable()
    rendered = scene.render()
    assert rendered.rgb.shape == (9, 9, 3)
    assert not rendered.rgb.any()
    (rendered.rgb.sum() + rendered.depth.sum() + rendered.alpha.sum()).backward()  # type: ignore[no-untyped-call]
    for name, leaf in scene.leaves().items():
        assert leaf.grad is not None, name
        assert not leaf.grad.any(), name


def test_each_tile_lists_its_gaussians_front_to_back() -> None:
    scene = random_scene(120, width=50, height=35, seed=8)
    projected = reference.project(*scene.tensors()[:4], scene.camera)
    tiles = reference.bin_tiles(projected, scene.camera)
    assert (tiles.rows, tiles.columns, len(tiles.counts)) == (3, 4, 12)
    assert bool(projected.visible[tiles.gaussian].all())
    for listed in torch.split(projected.depth[tiles.gaussian], tiles.counts):
        assert bool((listed.diff() >= 0).all())


def test_precision_is_that_of_the_input() -> None:
    scene = random_scene(10, width=16, height=16)
    for dtype in (torch.float32, torch.float64):
        rendered = scene.to(dtype).render()
        assert (rendered.rgb.dtype, rendered.depth.dtype, rendered.alpha.dtype) == (dtype,) * 3


def test_no_intermediate_is_gaussians_times_pixels() -> None:
    scene = random_scene(1500, width=96, height=80, seed=2).to(torch.float32)
    with _LargestTensor() as watch:
        scene.render()
    assert watch.numel <= max(reference.TILE**2 * reference.CHUNK * 2, 1500 * 9)  # dx and dy lie in one tensor
    assert watch.numel * 50 < 1500 * 96 * 80


def test_shapes_that_do_not_belong_together_are_refused() -> None:
    scene = random_scene(3, width=8, height=8)
    with pytest.raises(ValueError, match="shapes"):
        dataclasses.replace(scene, quaternion=scene.quaternion[:2]).render()
    with pytest.raises(ValueError, match="shapes"):
        reference.rasterize(
            scene.mean, scene.quaternion, scene.scale, scene.opacity[:, None], scene.colour, scene.camera
        )


@pytest.mark.parametrize("change", [{"width": 0}, {"fx": -1.0}, {"camera_from_world": np.eye(3)}])
def test_a_camera_without_an_image_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"no image|must be \[4, 4\]"):
        dataclasses.replace(camera(8, 8), **change)


def _one_gaussian(opacity: float) -> SplatScene:
    """In the middle of pixel (4, 4) of a 9 x 9 image, 3 pixels wide, at depth 50."""
    view = Camera(20.0, 20.0, 4.5, 4.5, 9, 9, np.eye(4))
    return SplatScene(
        mean=torch.tensor([[0.0, 0.0, 50.0]], dtype=torch.float64),
        quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
        scale=torch.full((1, 3), 7.5, dtype=torch.float64),
        opacity=torch.tensor([opacity], dtype=torch.float64),
        colour=torch.tensor([[0.2, 0.5, 0.8]], dtype=torch.float64),
        camera=view,
    )


def _beyond_the_limits() -> SplatScene:
    """Wide Gaussians left of, right of, above, below and in a corner outside the limits, all reaching the image."""
    view = camera(21, 18)
    column, row = np.array([-5.0, 26.5, 9.0, 12.0, -4.5]), np.array([6.0, 9.0, -4.5, 22.5, 22.0])
    depth = np.array([44.0, 50.0, 55.0, 60.0, 66.0])
    random = np.random.default_rng(5)
    return SplatScene(
        mean=torch.tensor(unproject(view, column, row, depth)),
        quaternion=torch.tensor(random.normal(size=(5, 4))),
        scale=torch.tensor(random.uniform(8.0, 16.0, (5, 3))),
        opacity=torch.full((5,), 0.7, dtype=torch.float64),
        colour=torch.tensor(random.uniform(0, 1, (5, 3))),
        camera=view,
    )


def _check_gradient(scene: SplatScene, name: str) -> None:
    """Central differences of a random cotangent's product with the image, entry by entry, against autograd."""
    near = pixels_near_a_cut(scene, alpha_margin=DIFFERENCE_MARGIN, stop_margin=DIFFERENCE_MARGIN)
    assert not near.any(), "choose another seed: a difference would step over a threshold"
    random = torch.Generator().manual_seed(1)
    height, width = scene.camera.height, scene.camera.width
    cotangent = torch.randn(height, width, 5, generator=random, dtype=torch.float64)
    cotangent[..., 3] /= 60  # depth is in units; keep the parts of one size

    def value(rendered: Rendered) -> Tensor:
        layers = torch.cat([rendered.rgb, rendered.depth[..., None], rendered.alpha[..., None]], dim=-1)
        return (layers * cotangent).sum()

    live = scene.differentiable()
    leaf = live.leaves()[name]
    (gradient,) = torch.autograd.grad(value(live.render()), [leaf])
    assert bool(gradient.any())
    with torch.no_grad():
        assert_close(gradient, _differences(lambda: value(live.render()), leaf), relative=1e-6, name=name)


def _differences(function: Callable[[], Tensor], leaf: Tensor) -> NDArray[np.float64]:
    entries = leaf.view(-1)
    slopes = np.zeros(len(entries))
    for k in range(len(entries)):
        centre = float(entries[k])
        entries[k] = centre + STEP
        above = float(function())
        entries[k] = centre - STEP
        below = float(function())
        entries[k] = centre
        slopes[k] = (above - below) / (2 * STEP)
    return slopes.reshape(leaf.shape)


def _loop_over_pixels(scene: SplatScene) -> NDArray[np.float64]:
    """[H, W, 5] rgb, depth, alpha by the contract's text, one pixel and one Gaussian at a time."""
    view, pose = scene.camera, np.asarray(scene.camera.camera_from_world)
    splats = []
    for g in range(len(scene.mean)):
        x, y, z = pose[:3, :3] @ scene.mean[g].numpy() + pose[:3, 3]
        if z > 0.2 and float(scene.opacity[g]) >= 1 / 255:
            splats.append((z, g, *_footprint(scene, g, x, y, z)))
    splats.sort(key=lambda splat: (splat[0], splat[1]))
    image = np.zeros((view.height, view.width, 5))
    for i in range(view.height):
        for j in range(view.width):
            transmittance = 1.0
            for z, g, u, v, conic in splats:
                d = np.array([j + 0.5 - u, i + 0.5 - v])
                alpha = min(0.99, float(scene.opacity[g]) * math.exp(-0.5 * d @ conic @ d))
                if alpha < 1 / 255 or transmittance < 1e-4:
                    continue
                image[i, j] += transmittance * alpha * np.array([*scene.colour[g].numpy(), z, 1.0])
                transmittance *= 1 - alpha
    return image


def _footprint(scene: SplatScene, g: int, x: float, y: float, z: float) -> tuple[float, float, NDArray[np.float64]]:
    """Centre on the image and inverse covariance of Gaussian g."""
    view = scene.camera
    turn = Rotation.from_quat(scene.quaternion[g].numpy(), scalar_first=True).as_matrix()
    sigma = turn @ np.diag(scene.scale[g].numpy() ** 2) @ turn.T
    beyond_x, beyond_y = 0.3 * 0.5 * view.width / view.fx, 0.3 * 0.5 * view.height / view.fy
    u = min(max(x / z, -view.cx / view.fx - beyond_x), (view.width - view.cx) / view.fx + beyond_x)
    v = min(max(y / z, -view.cy / view.fy - beyond_y), (view.height - view.cy) / view.fy + beyond_y)
    jacobian = np.array([[view.fx / z, 0, -view.fx * u / z], [0, view.fy / z, -view.fy * v / z]])
    to_image = jacobian @ np.asarray(view.camera_from_world)[:3, :3]
    conic = np.linalg.inv(to_image @ sigma @ to_image.T + 0.3 * np.eye(2))
    return view.fx * x / z + view.cx, view.fy * y / z + view.cy, conic


class _LargestTensor(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Watches every tensor torch makes and keeps the largest size."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.numel = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for each in result if isinstance(result, (tuple, list)) else [result]:
            if isinstance(each, Tensor):
                self.numel = max(self.numel, each.numel())
        return result
