"""The public rasterize() against the reference in float64, for several cameras at once: values, and gradients of every
input under shared random cotangents.

Tolerances and pixels left out are those of test_backends.py. Symbols: N Gaussians, C cameras, D channels, H W pixels.
"""

from __future__ import annotations

import dataclasses
import doctest
import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from intrasplat.errors import InputError
from intrasplat.splat import rasterize as module
from intrasplat.splat import reference
from intrasplat.splat.camera import Camera
from intrasplat.splat.constants import NEAR
from intrasplat.splat.rasterize import Rasterized, rasterize
from tests.helpers import assert_close
from tests.intrasplat.splat.scenes import BACKENDS, INTERPRETED, SplatScene, affordable, pixels_near_a_cut, random_scene

LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats")
"""What gets a gradient."""
MAX_LEFT_OUT = 0.05
"""Share of the pixels that may lie near a cut."""
LAYERS = ("colors", "depth", "alpha")

Inputs = dict[str, Any]


@pytest.fixture(params=sorted(BACKENDS))
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def inputs(scene: SplatScene, cameras: int, channels: int | None = None) -> Inputs:
    """The arguments of rasterize in float32: the scene, seen by its own camera and by others around it.

    channels: each camera has its own colours, so many channels; None: the scene's colours for all.
    """
    random = np.random.default_rng(3)
    view = scene.camera
    poses, matrices = [], []
    for index in range(cameras):
        move = np.eye(4)
        move[:3, :3] = Rotation.from_euler("xyz", 0.04 * index * random.normal(size=3)).as_matrix()
        move[:3, 3] = index * random.normal(size=3)
        poses.append(move @ np.asarray(view.camera_from_world))
        zoom = 1 + 0.1 * index
        matrices.append([[zoom * view.fx, 0, view.cx + 0.3 * index], [0, view.fy, view.cy - 0.2 * index], [0, 0, 1]])
    colors = scene.colour
    if channels is not None:
        colors = torch.tensor(random.uniform(-0.2, 1.4, (cameras, len(scene.mean), channels)))
    given = {
        "means": scene.mean,
        "quats": scene.quaternion,
        "scales": scene.scale,
        "opacities": scene.opacity,
        "colors": colors,
        "viewmats": torch.tensor(np.stack(poses)),
        "Ks": torch.tensor(matrices, dtype=torch.float64),
    }
    return {name: each.float() for name, each in given.items()} | {"width": view.width, "height": view.height}


def with_dtype(given: Inputs, dtype: torch.dtype) -> Inputs:
    return {name: each.to(dtype) if isinstance(each, Tensor) else each for name, each in given.items()}


def differentiable(given: Inputs) -> Inputs:
    return given | {name: given[name].detach().clone().requires_grad_() for name in LEAVES}


def draw(given: Inputs, backend: str) -> Rasterized:
    """rasterize() by this backend for tensors of the host: there and back, gradients too."""
    device = "cuda" if backend == "cuda" and not INTERPRETED else "cpu"
    moved = {name: each.to(device) if isinstance(each, Tensor) else each for name, each in given.items()}
    seen = rasterize(**moved, backend=backend)
    return Rasterized(seen.colors.cpu(), seen.depth.cpu(), seen.alpha.cpu())


def scene_of(given: Inputs, camera: int) -> SplatScene:
    """The Gaussians and one of the cameras, in float64, as the reference takes them; the pose is a part of viewmats."""
    exact = with_dtype(given, torch.float64)
    (fx, _, cx), (_, fy, cy), _ = exact["Ks"][camera].tolist()
    view = Camera(fx, fy, cx, cy, given["width"], given["height"], exact["viewmats"][camera])
    return SplatScene(*(exact[name] for name in LEAVES[:5]), view)


def by_the_reference(given: Inputs) -> Rasterized:
    """What the reference gives, camera by camera and channel by channel."""
    views = []
    for camera in range(len(given["viewmats"])):
        scene = scene_of(given, camera)
        colour = scene.colour[camera] if scene.colour.ndim == 3 else scene.colour
        channels = [
            dataclasses.replace(scene, colour=colour[:, [k, k, k]]).render(reference.rasterize)
            for k in range(colour.shape[1])
        ]
        first = channels[0]
        views.append((torch.stack([each.rgb[..., 0] for each in channels], -1), first.depth, first.alpha))
    rgb, depth, alpha = (torch.stack(layer) for layer in zip(*views, strict=True))
    return Rasterized(rgb, depth[..., None], alpha[..., None])


def near_a_cut(given: Inputs) -> Tensor:
    """[C, H, W] bool."""
    cameras = range(len(given["viewmats"]))
    return torch.from_numpy(np.stack([pixels_near_a_cut(scene_of(given, camera)) for camera in cameras]))


def cotangents(seen: Rasterized, left_out: Tensor) -> Rasterized:
    """Random float64 numbers of the shapes of seen, 0 where pixels are left out; depth's are scaled to its unit."""
    random = torch.Generator().manual_seed(17)
    kept = (~left_out)[..., None].double()
    made = [
        kept * torch.randn(getattr(seen, layer).shape, generator=random, dtype=torch.float64) / size
        for layer, size in zip(LAYERS, (1, 60, 1), strict=True)
    ]
    return Rasterized(*made)


def product(seen: Rasterized, cotangent: Rasterized) -> Tensor:
    """Sum over all layers of seen times cotangent."""
    layers = [(getattr(seen, layer), getattr(cotangent, layer)) for layer in LAYERS]
    return torch.stack([(value * factor.to(value)).sum() for value, factor in layers]).sum()


def gradients(given: Inputs, cotangent: Rasterized, by: Callable[[Inputs], Rasterized]) -> dict[str, Tensor]:
    live = differentiable(given)
    found = torch.autograd.grad(product(by(live), cotangent), [live[name] for name in LEAVES])
    return dict(zip(LEAVES, found, strict=True))


def seen_by(backend: str, *, seed: int, cameras: int, channels: int | None = None) -> Inputs:
    """Arguments that a backend can afford; at most two cameras where kernels are interpreted."""
    if backend == "cuda" and INTERPRETED:
        cameras = min(cameras, 2)
    size = affordable(BACKENDS[backend], 300, width=45, height=38)
    return inputs(random_scene(**size, seed=seed), cameras, channels)


@pytest.mark.parametrize("channels", [None, 1, 5], ids=["shared", "one channel", "five channels"])
def test_values_and_gradients_are_the_references(
    backend: str, channels: int | None, record_property: Callable[[str, object], None]
) -> None:
    given = seen_by(backend, seed=21, cameras=3, channels=channels)
    left_out = near_a_cut(given)
    record_property("pixels_left_out", int(left_out.sum()))
    assert left_out.double().mean() <= MAX_LEFT_OUT
    wanted, got = by_the_reference(given), draw(given, backend)
    assert float(wanted.alpha.amin((1, 2, 3)).max()) < 0.9 < float(wanted.alpha.amax((1, 2, 3)).min())
    for layer in LAYERS:
        assert_close(getattr(got, layer), getattr(wanted, layer), where=~left_out.numpy(), name=layer)
    cotangent = cotangents(wanted, left_out)
    exact = with_dtype(given, torch.float64)
    wanted_gradients = gradients(exact, cotangent, by_the_reference)
    for name, gradient in gradients(given, cotangent, lambda live: draw(live, backend)).items():
        assert gradient.dtype == torch.float32
        assert_close(gradient, wanted_gradients[name], name=f"gradient of {name}")


def test_float64_is_the_references_to_the_last_digits() -> None:
    given = with_dtype(inputs(random_scene(200, width=31, height=27, seed=22), 2), torch.float64)
    wanted, got = by_the_reference(given), rasterize(**given)
    for layer in LAYERS:
        assert getattr(got, layer).dtype == torch.float64
        assert_close(getattr(got, layer), getattr(wanted, layer), relative=1e-12, absolute=1e-13, name=layer)


def test_the_gradient_of_the_pose_is_that_of_finite_differences() -> None:
    given = with_dtype(inputs(random_scene(14, width=21, height=18, seed=8, pixels=2.5), 2), torch.float64)
    cotangent = cotangents(rasterize(**given), near_a_cut(given))
    gradient = gradients(given, cotangent, lambda live: rasterize(**live))["viewmats"]
    step, found = 1e-6, torch.zeros_like(gradient)
    for place in np.ndindex(len(gradient), 3, 4):
        values = []
        for sign in (1, -1):
            moved = given["viewmats"].clone()
            moved[place] += sign * step
            values.append(float(product(rasterize(**given | {"viewmats": moved}), cotangent)))
        found[place] = (values[0] - values[1]) / (2 * step)
    assert_close(found, gradient, relative=1e-6, name="gradient of viewmats")
    assert not gradient[:, 3].any()


def test_one_camera_sees_what_it_sees_among_others(backend: str) -> None:
    given = seen_by(backend, seed=23, cameras=3)
    together = draw(given, backend)
    for camera in range(len(given["viewmats"])):
        one = slice(camera, camera + 1)
        alone = draw(given | {"viewmats": given["viewmats"][one], "Ks": given["Ks"][one]}, backend)
        for layer in LAYERS:
            assert bool((getattr(alone, layer) == getattr(together, layer)[one]).all()), (layer, camera)


def test_gradients_add_up_over_cameras(backend: str) -> None:
    given = seen_by(backend, seed=24, cameras=2)
    cotangent = cotangents(draw(given, backend), near_a_cut(given))
    together = gradients(given, cotangent, lambda live: draw(live, backend))
    apart = []
    for camera in range(2):
        one = slice(camera, camera + 1)
        own = given | {"viewmats": given["viewmats"][one], "Ks": given["Ks"][one]}
        part = Rasterized(*(getattr(cotangent, layer)[one] for layer in LAYERS))
        apart.append(gradients(own, part, lambda live: draw(live, backend)))
        assert_close(together["viewmats"][one], apart[-1]["viewmats"], relative=1e-6, name="viewmats")
    for name in LEAVES[:5]:
        assert bool(apart[0][name].any())
        assert bool(apart[1][name].any())
        assert_close(together[name], apart[0][name] + apart[1][name], relative=1e-6, name=name)


def test_another_unit_of_length_changes_depth_alone(backend: str) -> None:
    metres = seen_by(backend, seed=25, cameras=2)
    millimetres = metres | {"means": 1000 * metres["means"], "scales": 1000 * metres["scales"]}
    millimetres["viewmats"] = metres["viewmats"].clone()
    millimetres["viewmats"][:, :3, 3] *= 1000
    seen = draw(metres | {"near_plane": 0.05}, backend)
    same = draw(millimetres | {"near_plane": 50.0}, backend)
    kept = ~near_a_cut(metres).numpy()
    assert_close(same.colors, seen.colors, where=kept, name="colors")
    assert_close(same.depth / 1000, seen.depth, where=kept, name="depth")


@pytest.mark.parametrize("near_plane", [0.003, 0.01, NEAR, 7.0])
def test_nothing_up_to_the_near_plane_is_drawn(backend: str, near_plane: float) -> None:
    z = torch.tensor([0.999, 1.001]) * near_plane
    for depth, is_seen in zip(z.tolist(), (False, True), strict=True):
        given = one_gaussian(depth, 0.02 * near_plane)
        assert bool(draw(given | {"near_plane": near_plane}, backend).alpha.any()) == is_seen


def one_gaussian(depth: float, scale: float) -> Inputs:
    """On the axis of one camera of 9 x 7 pixels."""
    return {
        "means": torch.tensor([[0.0, 0.0, depth]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), scale),
        "opacities": torch.tensor([0.9]),
        "colors": torch.tensor([[0.2, 0.5, 0.8]]),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[20.0, 0.0, 4.5], [0.0, 20.0, 3.5], [0.0, 0.0, 1.0]]]),
        "width": 9,
        "height": 7,
    }


@pytest.mark.parametrize("what", ["no Gaussian", "all behind", "all transparent"])
def test_nothing_to_see_is_black_with_zero_gradients(backend: str, what: str) -> None:
    given = one_gaussian(50.0, 7.0)
    if what == "no Gaussian":
        given |= {name: given[name][:0] for name in LEAVES[:5]}
    elif what == "all behind":
        given["means"] = -given["means"]
    else:
        given["opacities"] = torch.zeros(1)
    live = differentiable(given)
    seen = draw(live, backend)
    assert [tuple(getattr(seen, layer).shape) for layer in LAYERS] == [(1, 7, 9, 3), (1, 7, 9, 1), (1, 7, 9, 1)]
    assert not any(bool(getattr(seen, layer).any()) for layer in LAYERS)
    (seen.colors.sum() + seen.depth.sum() + seen.alpha.sum()).backward()  # type: ignore[no-untyped-call]
    for name in LEAVES:
        assert live[name].grad.shape == given[name].shape, name
        assert not live[name].grad.any(), name


def test_only_what_asks_for_a_gradient_gets_one(backend: str) -> None:
    given = one_gaussian(50.0, 7.0)
    assert not draw(given, backend).colors.requires_grad
    given["viewmats"].requires_grad_()
    draw(given, backend).depth.sum().backward()  # type: ignore[no-untyped-call]
    assert float(given["viewmats"].grad[0, 2, 3]) > 0
    assert given["means"].grad is None


def test_memory_that_is_not_contiguous_is_read_as_it_stands(backend: str) -> None:
    given = seen_by(backend, seed=26, cameras=2)
    strided = given | {name: given[name].T.contiguous().T for name in ("means", "quats", "scales", "colors")}
    strided["viewmats"] = given["viewmats"].transpose(1, 2).contiguous().transpose(1, 2)
    got, wanted = draw(strided, backend), draw(given, backend)
    for layer in LAYERS:
        assert bool((getattr(got, layer) == getattr(wanted, layer)).all()), layer


def test_a_retained_graph_gives_the_same_gradients_again(backend: str) -> None:
    live = differentiable(seen_by(backend, seed=27, cameras=2))
    total = draw(live, backend).colors.square().sum()
    leaves = [live[name] for name in LEAVES]
    first = torch.autograd.grad(total, leaves, retain_graph=True)
    for name, once, again in zip(LEAVES, first, torch.autograd.grad(total, leaves), strict=True):
        assert bool((once == again).all()), name


@pytest.mark.parametrize("kernels", [each for each in sorted(BACKENDS) if each != "reference"])
def test_the_kernels_refuse_a_second_derivative(kernels: str) -> None:
    live = differentiable(one_gaussian(50.0, 7.0))
    with pytest.raises(RuntimeError, match="differentiate once"):
        torch.autograd.grad(draw(live, kernels).colors.sum(), [live["means"]], create_graph=True)


def test_the_reference_gives_second_derivatives() -> None:
    live = differentiable(with_dtype(one_gaussian(50.0, 7.0), torch.float64))
    (first,) = torch.autograd.grad(rasterize(**live).colors.sum(), [live["means"]], create_graph=True)
    (second,) = torch.autograd.grad(first[0, 0], [live["means"]])
    assert float(second[0, 0]) < 0  # the picture is brightest with the Gaussian in its middle


def test_arguments_stand_in_the_order_of_gsplats() -> None:
    parameters = list(inspect.signature(rasterize).parameters)
    assert parameters[:9] == ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height"]


def test_the_example_of_the_docstring_runs() -> None:
    result = doctest.testmod(module)
    assert result.attempted > 5
    assert result.failed == 0


NAN = math.nan
WRONG: dict[str, tuple[str, dict[str, Any], str]] = {
    "an array": ("means", {"means": np.zeros((1, 3))}, "not a tensor"),
    "whole numbers": ("colors", {"colors": torch.ones(1, 3, dtype=torch.int64)}, "dtype"),
    "a number": ("means", {"means": torch.tensor(1.0)}, r"has shape \[\], not \[N, 3\]"),
    "two columns": ("means", {"means": torch.ones(1, 2)}, r"has shape \[1, 2\], not \[N, 3\]"),
    "batch of scenes": ("means", {"means": torch.ones(2, 1, 3)}, "batches of scenes"),
    "other count": ("quats", {"quats": torch.ones(2, 4)}, r"has shape \[2, 4\], not \[1, 4\]"),
    "one scale": ("scales", {"scales": torch.ones(1)}, r"not \[1, 3\]"),
    "opacity column": ("opacities", {"opacities": torch.ones(1, 1)}, r"not \[1\]"),
    "harmonics": ("colors", {"colors": torch.ones(1, 16, 3)}, "spherical harmonics"),
    "no channel": ("colors", {"colors": torch.ones(1, 0)}, "no channel"),
    "one matrix": ("viewmats", {"viewmats": torch.eye(4)}, r"viewmats\[None\]"),
    "one K": ("Ks", {"Ks": torch.eye(3)}, r"Ks\[None\]"),
    "two K": ("Ks", {"Ks": torch.eye(3).expand(2, 3, 3)}, r"not \[1, 3, 3\]"),
    "no camera": ("viewmats", {"viewmats": torch.ones(0, 4, 4), "Ks": torch.ones(0, 3, 3)}, "no camera"),
    "half precision": ("means", {"means": torch.ones(1, 3).half()}, "float16"),
    "half a pose": ("viewmats", {"viewmats": torch.eye(4)[None].half()}, "float16"),
    "mixed precision": ("scales", {"scales": torch.ones(1, 3).double()}, "one dtype"),
    "NaN": ("means", {"means": torch.tensor([[0.0, NAN, 1.0]])}, r"nan at \[0, 1\] is not finite"),
    "infinite colour": ("colors", {"colors": torch.full((1, 3), math.inf)}, r"inf at \[0, 0\]"),
    "NaN pose": ("viewmats", {"viewmats": torch.full((1, 4, 4), NAN)}, "not finite"),
    "NaN K": ("Ks", {"Ks": torch.full((1, 3, 3), NAN)}, "not finite"),
    "no rotation": ("quats", {"quats": torch.zeros(1, 4)}, r"0 at \[0\] is the length"),
    "log scales": ("scales", {"scales": torch.full((1, 3), -3.0)}, "exp of logarithms"),
    "logits": ("opacities", {"opacities": torch.tensor([2.2])}, "sigmoid of logits"),
    "row vectors": ("viewmats", {"viewmats": torch.eye(4)[None] + torch.eye(4)[3, :, None]}, "last row"),
    "skew": ("Ks", {"Ks": torch.tensor([[[9.0, 0.1, 4.0], [0.0, 9.0, 4.0], [0.0, 0.0, 1.0]]])}, "skew"),
    "scaled K": ("Ks", {"Ks": torch.tensor([[[9.0, 0.0, 4.0], [0.0, 9.0, 4.0], [0.0, 0.0, 2.0]]])}, "pinhole"),
    "OpenGL's K": ("Ks", {"Ks": torch.tensor([[[9.0, 0.0, 4.0], [0.0, -9.0, 4.0], [0.0, 0.0, 1.0]]])}, "focal"),
    "K to learn": ("Ks", {"Ks": torch.eye(3)[None].requires_grad_()}, "requires a gradient"),
    "no width": ("width", {"width": 0}, "0 is no number of pixels"),
    "half a pixel": ("height", {"height": 7.5}, "7.5 is no number of pixels"),
    "no near plane": ("near_plane", {"near_plane": 0.0}, "0.0 is no distance"),
    "no backend": ("backend", {"backend": "vulkan"}, "vulkan"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_argument_is_named(case: str) -> None:
    field, change, message = WRONG[case]
    with pytest.raises(InputError, match=message) as caught:
        rasterize(**one_gaussian(50.0, 7.0) | change)
    assert caught.value.field == field
    assert caught.value.remedy


@pytest.mark.parametrize("kernels", ["cpu", "cuda"])
def test_the_kernels_refuse_float64(kernels: str) -> None:
    given = with_dtype(one_gaussian(50.0, 7.0), torch.float64)
    with pytest.raises(InputError, match="computes in float32"):
        rasterize(**given, backend=kernels)


def test_a_backend_of_another_device_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(InputError, match="'cuda' does not read means on cpu"):
        rasterize(**one_gaussian(50.0, 7.0), backend="cuda")


def test_more_gaussians_than_the_kernels_number_are_refused() -> None:
    given = one_gaussian(50.0, 7.0)
    many = given | {name: given[name].expand(1 << 20, *given[name].shape[1:]) for name in LEAVES[:5]}
    assert rasterize(**many | {"width": 1, "height": 1}).alpha.shape == (1, 1, 1, 1)
    more = given | {name: given[name].expand((1 << 20) + 1, *given[name].shape[1:]) for name in LEAVES[:5]}
    with pytest.raises(InputError, match="1048577 Gaussians"):
        rasterize(**more)
