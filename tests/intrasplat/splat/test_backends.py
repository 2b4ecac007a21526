"""Every backend in float32 against the reference in float64: values, and gradients under shared random cotangents.

Tolerance per tensor: max |a - b| <= 1e-4 max |b| + 1e-6. Pixels within 1e-5 of a cut are left out and counted: there
float32 rounding may choose the other side, and both answers are right.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.splat import reference
from intrasplat.splat.camera import Rendered
from intrasplat.splat.constants import EPS2D, MIN_TRANSMITTANCE
from tests.helpers import assert_close
from tests.intrasplat.splat.scenes import (
    BACKENDS,
    INTERPRETED,
    Rasterize,
    SplatScene,
    affordable,
    enlarged,
    opacities_at_both_ends,
    opaque_wall,
    pixels_near_a_cut,
    random_scene,
)

MAX_LEFT_OUT = 0.05
"""Share of an image's pixels that may lie near a cut before a comparison says too little."""

SCENES: dict[str, Callable[[], SplatScene]] = {
    "one Gaussian": lambda: random_scene(1, width=16, height=16, seed=1, pixels=4.0),
    "odd size": lambda: random_scene(400, width=47, height=38, seed=2),
    "one pixel": lambda: random_scene(30, width=1, height=1, seed=3, pixels=0.5),
    "one column": lambda: random_scene(60, width=1, height=70, seed=4),
    "one row": lambda: random_scene(60, width=70, height=1, seed=5),
    "past a tile": lambda: random_scene(200, width=33, height=65, seed=6),
    "wide": lambda: random_scene(50, width=40, height=40, seed=7, pixels=7.0),
    "opaque": opaque_wall,
    "opacity 0 and 1": opacities_at_both_ends,
    "thinner than a pixel": lambda: random_scene(600, width=56, height=40, seed=8, pixels=0.15),
    "enlarged": lambda: enlarged(random_scene(300, width=45, height=38, seed=10, pixels=0.5)),
    "a small frame": lambda: random_scene(1500, width=96, height=80, seed=9),
}
SMALL_SCENES: dict[str, Callable[[], SplatScene]] = {
    "one Gaussian": SCENES["one Gaussian"],
    "one pixel": SCENES["one pixel"],
    "one column": lambda: random_scene(40, width=1, height=21, seed=42),
    "one row": lambda: random_scene(40, width=19, height=1, seed=5),
    "past a tile": lambda: random_scene(60, width=17, height=9, seed=6),
    "wide": lambda: random_scene(40, width=10, height=12, seed=7, pixels=7.0),
    "opaque": lambda: random_scene(120, width=9, height=8, seed=40, pixels=9.0, opacities=(0.9,)),
    "enlarged": lambda: enlarged(random_scene(60, width=14, height=10, seed=10, pixels=0.5)),
    "thinner than a pixel": lambda: random_scene(120, width=14, height=10, seed=8, pixels=0.15),
}
"""The same, as small as an interpreted kernel needs them."""
COMPARISONS = [
    (backend, name)
    for backend in sorted(BACKENDS)
    for name in (SMALL_SCENES if backend == "cuda" and INTERPRETED else SCENES)
]


def test_the_opaque_scene_hides_most_of_its_gaussians() -> None:
    wall = opaque_wall()
    assert float(wall.render().alpha.min()) > 1 - MIN_TRANSMITTANCE
    live = wall.differentiable()
    (gradient,) = torch.autograd.grad(live.render().rgb.sum(), [live.colour])
    assert float((gradient == 0).all(dim=1).double().mean()) > 0.5


@pytest.fixture(params=sorted(BACKENDS))
def rasterize(request: pytest.FixtureRequest) -> Rasterize:
    return BACKENDS[request.param]


@pytest.mark.parametrize(("backend", "name"), COMPARISONS)
def test_values_and_gradients_are_the_references(
    backend: str, name: str, record_property: Callable[[str, object], None]
) -> None:
    rasterize = BACKENDS[backend]
    exact = (SMALL_SCENES if backend == "cuda" and INTERPRETED else SCENES)[name]()
    single = exact.to(torch.float32)
    exact = single.to(torch.float64)  # the same numbers, so that only the arithmetic differs
    left_out = pixels_near_a_cut(exact)
    record_property("pixels_left_out", int(left_out.sum()))
    assert left_out.mean() <= MAX_LEFT_OUT
    cotangent = random_cotangent(exact, left_out)

    wanted, wanted_gradients = values_and_gradients(exact, reference.rasterize, cotangent)
    got, got_gradients = values_and_gradients(single, rasterize, cotangent)

    for layer in ("rgb", "depth", "alpha"):
        assert_close(getattr(got, layer), getattr(wanted, layer), where=~left_out, name=layer)
    for leaf, gradient in wanted_gradients.items():
        assert_close(got_gradients[leaf], gradient, name=f"gradient of {leaf}")


def test_an_enlarged_picture_holds_the_recordings_pixels_and_no_needles() -> None:
    thin = random_scene(300, width=45, height=38, seed=10, pixels=0.1)
    needles, smooth = (reference.project(*each.tensors()[:4], each.camera) for each in (thin, enlarged(thin)))
    recorded = 4.0 + thin.mean @ torch.tensor([0.1, -0.05, 0.9], dtype=torch.float64)
    a, b, c = smooth.conic.T
    least = torch.stack([c, a]) / (a * c - b * b)  # the variances along x and y
    for variance, by in zip(least, (2.0, 1.1), strict=True):
        wanted = EPS2D * torch.clamp(by * recorded / smooth.depth, min=1.0) ** 2
        assert bool((variance[smooth.visible] >= wanted[smooth.visible]).all())
    assert float((smooth.half_extent > needles.half_extent).double().mean()) > 0.6


def test_an_opacity_of_one_gets_its_gradient(rasterize: Rasterize) -> None:
    size = affordable(rasterize, 150, width=41, height=34)
    scene = opacities_at_both_ends(**size).to(torch.float32).differentiable()
    (gradient,) = torch.autograd.grad(scene.render(rasterize).alpha.sum(), [scene.opacity])
    assert float((gradient[0::3] != 0).double().mean()) > 0.3
    assert not gradient[1::3].any()


def test_shapes_that_do_not_belong_together_are_refused(rasterize: Rasterize) -> None:
    scene = random_scene(5, width=19, height=11).to(torch.float32)
    with pytest.raises(ValueError, match="shapes"):
        dataclasses.replace(scene, colour=scene.colour[:4]).render(rasterize)


def test_no_gaussians_are_black_with_gradients_of_their_shape(rasterize: Rasterize) -> None:
    scene = random_scene(5, width=19, height=11).to(torch.float32).rows(torch.zeros(0, dtype=torch.long))
    cotangent = random_cotangent(scene, no_pixel(scene))
    rendered, gradients = values_and_gradients(scene, rasterize, cotangent)
    assert rendered.rgb.shape == (11, 19, 3)
    assert not rendered.rgb.any()
    assert not rendered.depth.any()
    assert not rendered.alpha.any()
    assert {name: tuple(each.shape) for name, each in gradients.items()} == {
        "mean": (0, 3),
        "quaternion": (0, 4),
        "scale": (0, 3),
        "opacity": (0,),
        "colour": (0, 3),
        "camera_from_world": (4, 4),
    }
    assert not gradients["camera_from_world"].any()


def test_gaussians_that_are_culled_get_zero_gradient(rasterize: Rasterize) -> None:
    scene = random_scene(**affordable(rasterize, 200, width=31, height=27), seed=13, pixels=0.4).to(torch.float32)
    cotangent = random_cotangent(scene, no_pixel(scene))
    _, gradients = values_and_gradients(scene, rasterize, cotangent)
    projected = reference.project(*scene.to(torch.float64).tensors()[:4], scene.camera)
    hidden = ~projected.visible
    assert int(hidden.sum()) > 10
    for name in ("mean", "quaternion", "scale", "opacity", "colour"):
        assert not gradients[name][hidden].any(), name


def test_a_scale_of_zero_gets_a_gradient_that_is_a_number(rasterize: Rasterize) -> None:
    scene = random_scene(**affordable(rasterize, 40, width=19, height=11)).to(torch.float32)
    scale = scene.scale.clone()
    scale[::2, 1] = 0.0  # exp(-104) in float32
    _, gradients = values_and_gradients(
        dataclasses.replace(scene, scale=scale), rasterize, random_cotangent(scene, no_pixel(scene))
    )
    for name, gradient in gradients.items():
        assert bool(torch.isfinite(gradient).all()), name


def test_permuting_the_gaussians_permutes_their_gradients(rasterize: Rasterize) -> None:
    scene = random_scene(**affordable(rasterize, 150, width=31, height=27), seed=14).to(torch.float32)
    order = torch.randperm(len(scene.mean), generator=torch.Generator().manual_seed(0))
    cotangent = random_cotangent(scene, no_pixel(scene))
    _, gradients = values_and_gradients(scene, rasterize, cotangent)
    _, permuted = values_and_gradients(scene.rows(order), rasterize, cotangent)
    for name in ("mean", "quaternion", "scale", "opacity", "colour"):
        assert_close(permuted[name], gradients[name][order], relative=1e-6, name=name)
    assert_close(permuted["camera_from_world"], gradients["camera_from_world"], relative=1e-5)


def test_gradients_of_one_layer_alone_are_right(rasterize: Rasterize) -> None:
    scene = random_scene(**affordable(rasterize, 80, width=30, height=22), seed=15).to(torch.float32)
    left_out = pixels_near_a_cut(scene)
    full = random_cotangent(scene, left_out)
    for layer, channels in {"rgb": slice(0, 3), "depth": slice(3, 4), "alpha": slice(4, 5)}.items():
        cotangent = torch.zeros_like(full)
        cotangent[..., channels] = full[..., channels]
        _, wanted = values_and_gradients(scene.to(torch.float64), reference.rasterize, cotangent)
        _, got = values_and_gradients(scene, rasterize, cotangent)
        for leaf, gradient in wanted.items():
            assert_close(got[leaf], gradient, name=f"gradient of {leaf} from {layer}")


def test_the_same_scene_gives_the_same_bits(rasterize: Rasterize) -> None:
    scene = random_scene(**affordable(rasterize, 300, width=45, height=41), seed=16).to(torch.float32)
    cotangent = random_cotangent(scene, no_pixel(scene))
    first, first_gradients = values_and_gradients(scene, rasterize, cotangent)
    again, again_gradients = values_and_gradients(scene, rasterize, cotangent)
    assert bool((again.rgb == first.rgb).all())
    assert bool((again.depth == first.depth).all())
    assert all(bool((again_gradients[name] == each).all()) for name, each in first_gradients.items())


def no_pixel(scene: SplatScene) -> NDArray[np.bool_]:
    return np.zeros((scene.camera.height, scene.camera.width), bool)


def random_cotangent(scene: SplatScene, left_out: NDArray[np.bool_]) -> Tensor:
    """[H, W, 5] float64 for rgb, depth, alpha; 0 where pixels are left out; depth scaled so that no layer rules."""
    random = torch.Generator().manual_seed(17)
    cotangent = torch.randn(scene.camera.height, scene.camera.width, 5, generator=random, dtype=torch.float64)
    cotangent[..., 3] /= 60
    cotangent[torch.from_numpy(left_out)] = 0
    return cotangent


def values_and_gradients(
    scene: SplatScene, rasterize: Rasterize, cotangent: Tensor
) -> tuple[Rendered, dict[str, Tensor]]:
    """The image, and the gradients of sum(cotangent * layers) to everything that can be differentiated."""
    live = scene.differentiable()
    rendered = live.render(rasterize)
    layers = torch.cat([rendered.rgb, rendered.depth[..., None], rendered.alpha[..., None]], dim=-1)
    leaves = live.leaves()
    gradients = torch.autograd.grad((layers * cotangent.to(layers)).sum(), list(leaves.values()))
    return rendered, dict(zip(leaves, gradients, strict=True))
