"""Scenes for rasteriser tests, the backends under test, and the pixels no float32 backend can be held to.

Symbols: N Gaussians, H W pixels.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from intrasplat.splat import cpu, reference
from intrasplat.splat.camera import Camera, Rendered
from intrasplat.splat.constants import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

Rasterize = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Camera], Rendered]

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
"""Whether the CUDA backend's kernels run in Triton's interpreter (tests/conftest.py): right, and a million times slower
than on a GPU, so that it gets small scenes."""


def cuda_rasterize(
    mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, colour: Tensor, camera: Camera
) -> Rendered:
    """The CUDA backend for tensors of the host: there and back, gradients too."""
    from intrasplat.splat.cuda import rasterize  # needs Triton

    device = "cpu" if INTERPRETED else "cuda"
    moved = [each.to(device) for each in (mean, quaternion, scale, opacity, colour)]
    rendered = rasterize(*moved, camera)
    return Rendered(rendered.rgb.cpu(), rendered.depth.cpu(), rendered.alpha.cpu())


BACKENDS: dict[str, Rasterize] = {"reference": reference.rasterize, "cpu": cpu.rasterize}
"""Every backend by name, all tested in float32 (the reference too: it shows what float32 alone costs)."""
if find_spec("triton") is not None:
    BACKENDS["cuda"] = cuda_rasterize

NAMES = ("mean", "quaternion", "scale", "opacity", "colour")


@dataclass(frozen=True, eq=False)
class SplatScene:
    """The arguments of rasterize."""

    mean: Tensor
    quaternion: Tensor
    scale: Tensor
    opacity: Tensor
    colour: Tensor
    camera: Camera

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        return self.mean, self.quaternion, self.scale, self.opacity, self.colour

    def render(self, rasterize: Rasterize = reference.rasterize) -> Rendered:
        return rasterize(*self.tensors(), self.camera)

    def to(self, dtype: torch.dtype) -> SplatScene:
        """In another precision; the camera stays float64."""
        return dataclasses.replace(self, **{name: getattr(self, name).to(dtype) for name in NAMES})

    def rows(self, index: Tensor) -> SplatScene:
        """The Gaussians index, in that order."""
        return dataclasses.replace(self, **{name: getattr(self, name)[index] for name in NAMES})

    def differentiable(self) -> SplatScene:
        """Copies that ask for gradients, the camera's pose among them."""
        leaves = {name: getattr(self, name).detach().clone().requires_grad_() for name in NAMES}
        pose = torch.tensor(np.asarray(self.camera.camera_from_world)).requires_grad_()
        return dataclasses.replace(self, camera=dataclasses.replace(self.camera, camera_from_world=pose), **leaves)

    def leaves(self) -> dict[str, Tensor]:
        """What can be differentiated, by name."""
        pose = self.camera.camera_from_world
        assert isinstance(pose, Tensor)
        return {**{name: getattr(self, name) for name in NAMES}, "camera_from_world": pose}


def affordable(rasterize: Rasterize, count: int, *, width: int, height: int) -> dict[str, int]:
    """A scene's count, width and height; a small one's where kernels are interpreted: 2 x 2 tiles, three cut."""
    if INTERPRETED and rasterize is BACKENDS.get("cuda"):
        count, width, height = min(count, 40), min(width, 13), min(height, 11)
    return {"count": count, "width": width, "height": height}


def tilted_pose() -> NDArray[np.float64]:
    """A rigid camera_from_world that is nothing special: every entry matters."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.2, -0.15, 0.3]).as_matrix()
    pose[:3, 3] = [1.5, -2.0, 3.0]
    return pose


def camera(width: int, height: int, pose: NDArray[np.float64] | None = None) -> Camera:
    """About 65 degrees wide, unequal focal lengths, the principal point off the middle."""
    return Camera(
        fx=0.80 * width,
        fy=0.84 * width,
        cx=0.48 * width,
        cy=0.53 * height,
        width=width,
        height=height,
        camera_from_world=tilted_pose() if pose is None else pose,
    )


def random_scene(
    count: int,
    *,
    width: int,
    height: int,
    seed: int = 0,
    pixels: float = 2.0,
    opacities: tuple[float, ...] = (0.05, 0.4, 0.999),
) -> SplatScene:
    """Gaussians in and around the image at distinct depths, float64: faint and opaque, thin and wide, any orientation.

    Args:
        pixels: standard deviation on the image of an average Gaussian.
        opacities: each Gaussian has one of them, less up to a tenth.
    """
    random = np.random.default_rng(seed)
    view = camera(width, height)
    depth = random.permutation(np.linspace(40.0, 80.0, count))
    column = random.uniform(-0.25 * width, 1.25 * width, count)
    row = random.uniform(-0.25 * height, 1.25 * height, count)
    scale = random.lognormal(0.0, 0.5, (count, 3)) * (pixels * depth / view.fx)[:, None]
    return SplatScene(
        mean=torch.tensor(unproject(view, column, row, depth)),
        quaternion=torch.tensor(random.normal(size=(count, 4))),
        scale=torch.tensor(scale),
        opacity=torch.tensor(random.choice(opacities, count) * random.uniform(0.9, 1.0, count)),
        colour=torch.tensor(random.uniform(-0.2, 1.4, (count, 3))),
        camera=view,
    )


def enlarged(scene: SplatScene) -> SplatScene:
    """The scene, recorded by another camera beside this one: it enlarges most of it, more across than down."""
    row = (0.1, -0.05, 0.9, 4.0)
    return dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, enlarged=(2.0, 1.1), recorded_depth=row))


def opaque_wall() -> SplatScene:
    """Every pixel is full long before its last Gaussian: most are hidden everywhere."""
    return random_scene(400, width=37, height=35, seed=40, pixels=9.0, opacities=(0.9,))


def opacities_at_both_ends(count: int = 150, *, width: int = 41, height: int = 34) -> SplatScene:
    """A third of the Gaussians at opacity 1, a third at 0: neither has a finite logit."""
    scene = random_scene(count, width=width, height=height, seed=41)
    opacity = scene.opacity.clone()
    opacity[0::3], opacity[1::3] = 1.0, 0.0
    return dataclasses.replace(scene, opacity=opacity)


def unproject(
    view: Camera, column: NDArray[np.float64], row: NDArray[np.float64], depth: NDArray[np.float64]
) -> NDArray[np.float64]:
    """World points [N, 3] seen at continuous image positions (column, row) and camera z depth."""
    in_camera = np.stack([(column - view.cx) / view.fx * depth, (row - view.cy) / view.fy * depth, depth], axis=1)
    pose = np.asarray(view.camera_from_world)
    return np.asarray((in_camera - pose[:3, 3]) @ pose[:3, :3])


def pixels_near_a_cut(scene: SplatScene, *, alpha_margin: float = 1e-5, stop_margin: float = 1e-6) -> NDArray[np.bool_]:
    """[H, W] bool: pixels where a Gaussian comes so near a threshold that rounding decides on which side it falls.

    Thresholds: alpha at MIN_ALPHA and at MAX_ALPHA (within alpha_margin), transmittance at MIN_TRANSMITTANCE (within
    stop_margin).
    """
    exact = scene.to(torch.float64)
    projected = reference.project(*exact.tensors()[:4], scene.camera)
    i, j = np.mgrid[0.5 : scene.camera.height, 0.5 : scene.camera.width]
    near = np.zeros(i.shape, bool)
    transmittance = np.ones(i.shape)
    mean2d, conic = projected.mean2d.detach().numpy(), projected.conic.detach().numpy()
    opacity = projected.opacity.detach().numpy()
    for g in np.argsort(projected.depth.detach().numpy(), kind="stable"):
        if not projected.visible[g]:
            continue
        dx, dy = j - mean2d[g, 0], i - mean2d[g, 1]
        a, b, c = conic[g]
        raw = opacity[g] * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        open_still = transmittance >= MIN_TRANSMITTANCE - stop_margin
        near |= open_still & ((abs(raw - MIN_ALPHA) < alpha_margin) | (abs(raw - MAX_ALPHA) < alpha_margin))
        alpha = np.where(raw >= MIN_ALPHA, np.minimum(raw, MAX_ALPHA), 0.0)
        near |= (alpha > 0) & (abs(transmittance - MIN_TRANSMITTANCE) < stop_margin)
        transmittance *= np.where(transmittance >= MIN_TRANSMITTANCE, 1 - alpha, 1.0)
    return near
