"""Render Gaussians for several pinhole cameras: colours, depth and alpha, differentiable by torch.autograd.

Symbols: N Gaussians, C cameras, D channels of colour, H W pixels. Names and shapes are gsplat's where they mean the
same (docs/gsplat.md). The equations are in intrasplat/splat/camera.py. A backend renders three channels for one camera.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from numbers import Integral
from typing import Literal, get_args

import torch
from torch import Tensor

from intrasplat.errors import InputError, LimitError, UnavailableError
from intrasplat.machine.gpu import find_gpu
from intrasplat.splat import cpu, reference
from intrasplat.splat.camera import Camera, Rendered
from intrasplat.splat.constants import NEAR
from intrasplat.splat.cpu.bins import MAX_GAUSSIANS

BackendName = Literal["auto", "cpu", "cuda", "reference"]
Draw = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Camera], Rendered]
CHANNELS_PER_PASS = 3
MIN_QUATERNION = 1e-12
"""A shorter quaternion cannot be normalised in float32."""


@dataclass(frozen=True, eq=False)
class Rasterized:
    """The images of C cameras. w is a Gaussian's weight in a pixel, transmittance times alpha.

    colors  [C, H, W, D]  sum w color, not clamped; 0 where nothing is drawn
    depth   [C, H, W, 1]  sum w z in the unit of means, z along the camera's axis; depth / alpha is the expected depth
    alpha   [C, H, W, 1]  sum w, from 0 to 1
    """

    colors: Tensor
    depth: Tensor
    alpha: Tensor


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    backend: BackendName = "auto",
) -> Rasterized:
    """Colour, depth and alpha of N Gaussians as C pinhole cameras see them, with gradients.

    Gradients reach means, quats, scales, opacities, colors and viewmats, from all three results. Ks gets no gradient,
    and a Ks that requires one raises InputError. viewmats gets the gradient of its upper three rows, as twelve
    independent numbers. A step along it is not rigid, so optimise a parametrisation of the pose and build viewmats from
    it. The kernels compute first derivatives only: create_graph=True needs the reference. The first call on a machine
    compiles the kernels, about 10 s of CPU time; later processes load them.

    Lengths may have any unit, the same for means, scales, the translations of viewmats, near_plane and depth.
    means, quats, scales, opacities and colors share one dtype, float32 or float64, and one device; the result has both.
    viewmats may have the other dtype. viewmats and Ks may lie on another device.

    Args:
        means: [N, 3] centres in the world.
        quats: [N, 4] rotations w x y z, of any length from 1e-12.
        scales: [N, 3] standard deviations, not their logarithms, at least 0.
        opacities: [N] from 0 to 1, not logits.
        colors: [N, D] or, if they differ from camera to camera, [C, N, D]; blended as they are. Every three channels
            cost one pass. Spherical harmonics are not evaluated.
        viewmats: [C, 4, 4] camera_from_world in OpenCV axes (x right, y down, z forward), last row 0 0 0 1. The upper
            left 3 x 3 should be a rotation; it is not checked.
        Ks: [C, 3, 3] intrinsics in pixels, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]. The centre of the first pixel is at
            (0.5, 0.5).
        width: W in pixels, at least 1.
        height: H in pixels, at least 1.
        near_plane: a Gaussian up to this z is not drawn; above 0. The kernels clamp scales to 5e6 near_plane.
        backend: "cpu": Numba kernels, float32 on the processor. "cuda": Triton kernels, float32 on an NVIDIA GPU.
            "reference": plain torch, float32 or float64 on any device, slow. "auto": the kernels of the device for
            float32, the reference otherwise.

    Raises:
        InputError: an argument has a wrong type, shape, dtype, device or value. Its attribute field names the argument.
        LimitError: more Gaussians than the processor's kernels can number; a subclass of InputError.
        UnavailableError: the tensors are on a GPU, and something that the kernels need is missing.
        RuntimeError: in the backward pass of the kernels, with create_graph=True.

    Equations: intrasplat/splat/camera.py, after Zwicker et al., EWA Splatting, 2002, and Kerbl et al., 3D Gaussian
    Splatting, 2023. docs/rasterizer.md derives the gradients.

    Example:
        >>> import torch
        >>> from intrasplat import rasterize
        >>> means = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)
        >>> view = rasterize(
        ...     means,
        ...     quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.tensor([[0.1, 0.1, 0.1]]),
        ...     opacities=torch.tensor([0.9]),
        ...     colors=torch.tensor([[1.0, 0.5, 0.0]]),
        ...     viewmats=torch.eye(4)[None],
        ...     Ks=torch.tensor([[[100.0, 0.0, 16.5], [0.0, 100.0, 12.5], [0.0, 0.0, 1.0]]]),
        ...     width=32,
        ...     height=24,
        ... )
        >>> view.colors.shape, view.depth.shape, view.alpha.shape
        (torch.Size([1, 24, 32, 3]), torch.Size([1, 24, 32, 1]), torch.Size([1, 24, 32, 1]))
        >>> [round(value, 3) for value in view.colors[0, 12, 16].tolist()]
        [0.9, 0.45, 0.0]
        >>> round((view.depth / view.alpha)[0, 12, 16].item(), 3)
        2.0
        >>> view.depth.sum().backward()
        >>> means.grad.shape
        torch.Size([1, 3])
    """
    if not (math.isfinite(near_plane) and near_plane > 0):
        raise InputError("near_plane", f"{near_plane} is no distance above 0.", "Pass the least depth to draw.")
    _check_shapes(means, quats, scales, opacities, colors, viewmats, Ks)
    _check_values(means, quats, scales, opacities, colors, viewmats)
    draw = _backend(backend, means)
    units = NEAR / near_plane  # the backends cull at NEAR, so lengths go to them in the unit where near_plane is NEAR
    cameras = _cameras(viewmats * _with_translation(units, viewmats), Ks, width, height)
    gaussians = (means * units, quats, scales * units, opacities)
    by_camera = colors if colors.ndim == 3 else colors.expand(len(cameras), *colors.shape)
    # Triton launches on the current GPU; for tensors on the host this does nothing.
    with torch.cuda.device_of(means):  # type: ignore[no-untyped-call]
        views = [_draw_channels(draw, gaussians, own, camera) for own, camera in zip(by_camera, cameras, strict=True)]
    rgb, depth, alpha = (torch.stack(layer) for layer in zip(*views, strict=True))
    return Rasterized(rgb, depth / units, alpha)


def _draw_channels(
    draw: Draw, gaussians: tuple[Tensor, Tensor, Tensor, Tensor], colors: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """One camera's colours [H, W, D], depth and alpha [H, W, 1], from colors [N, D]."""
    channels = colors.shape[1]
    filled = torch.nn.functional.pad(colors, (0, -channels % CHANNELS_PER_PASS))
    passes = [draw(*gaussians, three, camera) for three in torch.split(filled, CHANNELS_PER_PASS, dim=1)]
    rgb = torch.cat([each.rgb for each in passes], dim=-1)[..., :channels]
    return rgb, passes[0].depth[..., None], passes[0].alpha[..., None]


def _with_translation(factor: float, like: Tensor) -> Tensor:
    """[4, 4] ones, with factor at the entries of a pose's translation."""
    factors = like.new_ones(4, 4)
    factors[:3, 3] = factor
    return factors


def _cameras(viewmats: Tensor, Ks: Tensor, width: int, height: int) -> list[Camera]:
    """The cameras one by one; each pose is a view of viewmats, so gradients reach it."""
    size = _pixels("width", width), _pixels("height", height)
    if Ks.requires_grad:
        raise InputError("Ks", "requires a gradient, which is not computed.", "Pass Ks.detach().")
    cameras = []
    for index, ((fx, skew, cx), (below, fy, cy), last) in enumerate(Ks.tolist()):
        if not all(map(math.isfinite, (fx, skew, cx, below, fy, cy, *last))):
            raise InputError("Ks", f"row {index} holds {Ks[index].tolist()}, not finite.", "Look where it is computed.")
        if (skew, below, *last) != (0.0, 0.0, 0.0, 0.0, 1.0):
            problem = f"row {index} is {Ks[index].tolist()}, which has skew or is no pinhole camera."
            raise InputError("Ks", problem, "Pass [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.")
        if min(fx, fy) <= 0:
            raise InputError("Ks", f"row {index} has focal lengths {fx}, {fy}.", "Pass numbers of pixels above 0.")
        cameras.append(Camera(fx, fy, cx, cy, *size, viewmats[index]))
    return cameras


def _pixels(name: str, size: object) -> int:
    if not isinstance(size, Integral) or int(size) < 1:
        raise InputError(name, f"{size!r} is no number of pixels.", "Pass a whole number of at least 1.")
    return int(size)


def _check_shapes(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor
) -> None:
    """Raise InputError unless all are float tensors of shapes, dtypes and devices that belong together."""
    gaussians = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    for name, given in {**gaussians, "viewmats": viewmats, "Ks": Ks}.items():
        if not isinstance(given, Tensor):
            raise InputError(name, f"is {type(given).__name__}, not a tensor.", "Pass torch.as_tensor(...) of it.")
        if not given.is_floating_point():
            raise InputError(name, f"has dtype {given.dtype}.", "Pass floating-point numbers.")
    _check_shape("means", means, "N", 3)
    _check_shape("quats", quats, len(means), 4)
    _check_shape("scales", scales, len(means), 3)
    _check_shape("opacities", opacities, len(means))
    _check_shape("viewmats", viewmats, "C", 4, 4)
    _check_shape("Ks", Ks, len(viewmats), 3, 3)
    _check_shape("colors", colors, *([len(viewmats)] if colors.ndim == 3 else []), len(means), "D")
    if colors.shape[-1] == 0:
        raise InputError("colors", "has no channel.", "Pass one at least.")
    if len(viewmats) == 0:
        raise InputError("viewmats", "names no camera.", "Pass one at least, [1, 4, 4].")
    for name, given in (("means", means), ("viewmats", viewmats)):
        if given.dtype not in (torch.float32, torch.float64):
            raise InputError(name, f"has dtype {given.dtype}.", "Pass float32 or float64.")
    for name, given in gaussians.items():
        if (given.dtype, given.device) != (means.dtype, means.device):
            problem = f"is {given.dtype} on {given.device}, and means are {means.dtype} on {means.device}."
            raise InputError(name, problem, "Pass the Gaussians in one dtype on one device.")


def _check_shape(name: str, given: Tensor, *wanted: int | str) -> None:
    """Raise InputError unless given has the shape wanted; a letter stands for any size."""
    fits = given.ndim == len(wanted) and all(
        isinstance(size, str) or size == own for own, size in zip(given.shape, wanted, strict=True)
    )
    if not fits:
        remedy = "Pass that shape."
        if given.ndim > len(wanted):
            remedy = "Pass that shape; batches of scenes are not supported."
        if name == "opacities" and given.ndim == 2 and given.shape[1] == 1:
            remedy = "Pass opacities[:, 0]."
        elif name == "Ks" and given.shape == (1, 3, 3):
            remedy = f"Pass a matrix for each camera: Ks.expand({wanted[0]}, 3, 3)."
        elif name == "viewmats" and given.shape[-2:] == (3, 4):
            remedy = "Append the row 0 0 0 1."
        elif name == "colors":
            remedy = "Pass [N, D] or [C, N, D]; evaluate spherical harmonics first."
        elif name in ("viewmats", "Ks") and given.ndim == 2:
            remedy = f"Pass one camera as {name}[None]."
        raise InputError(name, f"has shape {list(given.shape)}, not [{', '.join(map(str, wanted))}].", remedy)


def _check_values(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor
) -> None:
    """Raise InputError unless all numbers are finite and in range."""
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    for name, values in {**given, "viewmats": viewmats}.items():
        _refuse(name, values, ~values.isfinite(), "is not finite.", "Look where it is computed.")
    lengths = quats.norm(dim=1)
    remedy = "Start from 1 0 0 0, the identity."
    _refuse("quats", lengths, lengths < MIN_QUATERNION, "is the length, which names no rotation.", remedy)
    _refuse("scales", scales, scales < 0, "is below 0.", "Pass standard deviations: exp of logarithms.")
    outside = (opacities < 0) | (opacities > 1)
    _refuse("opacities", opacities, outside, "is not from 0 to 1.", "Pass sigmoid of logits.")
    last = viewmats[:, 3]
    remedy = "Pass camera_from_world, points as columns: the translation is the last column."
    _refuse("viewmats", last, last != last.new_tensor([0, 0, 0, 1]), "is in a last row that is not 0 0 0 1.", remedy)


def _refuse(name: str, values: Tensor, wrong: Tensor, problem: str, remedy: str) -> None:
    """Raise InputError with the first of the values that is wrong, if any is."""
    if bool(wrong.any()):
        where = wrong.nonzero()[0].tolist()
        raise InputError(name, f"{values[tuple(where)].item():g} at {where} {problem}", remedy)


def _backend(name: str, means: Tensor) -> Draw:
    """The function that renders Gaussians of this dtype on this device for one camera."""
    if name not in get_args(BackendName):
        raise InputError("backend", f"there is no backend {name!r}.", "Use auto, cpu, cuda or reference.")
    device = means.device.type
    if name == "auto":
        name = device if device in ("cpu", "cuda") and means.dtype == torch.float32 else "reference"
    if name == "reference":
        return reference.rasterize
    if means.dtype != torch.float32:
        problem = f"{name!r} computes in float32, and means are {means.dtype}."
        raise InputError("backend", problem, "Pass float32 tensors, or use backend='reference'.")
    is_interpreted = os.environ.get("TRITON_INTERPRET") == "1"  # then Triton's kernels take tensors of the host
    if device != name and not (name == "cuda" and device == "cpu" and is_interpreted):
        problem = f"{name!r} does not read means on {means.device}."
        raise InputError("backend", problem, "Move the Gaussians, or use backend='auto'.")
    if name == "cpu":
        if cpu.padded(len(means)) > MAX_GAUSSIANS:
            problem = f"holds {len(means)} Gaussians, and the kernels number {MAX_GAUSSIANS}."
            raise LimitError("means", problem, "Pass fewer, or use a GPU or backend='reference'.")
        return cpu.rasterize
    if not is_interpreted:
        _require_gpu()
    from intrasplat.splat.cuda import rasterize as rasterize_on_gpu  # needs Triton

    return rasterize_on_gpu


@cache
def _require_gpu() -> None:
    """Check once whether the GPU's kernels can run; raise UnavailableError if not."""
    gpu = find_gpu()
    if gpu.missing:
        raise UnavailableError(f"backend 'cuda': {gpu.missing}.", f"{gpu.remedy}, or use backend='reference'.")
