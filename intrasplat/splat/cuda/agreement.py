"""Check once per process, before the first job, that the device's images and gradients match the reference.

Any GPU, driver or version of Triton may have errors. So a small fixed scene is rendered and differentiated on the
device, and by intrasplat/splat/reference.py in float64.

Symbols: N Gaussians, H W pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from intrasplat.errors import UnavailableError
from intrasplat.splat import reference
from intrasplat.splat.camera import Camera, Rendered
from intrasplat.splat.cuda.autograd import rasterize
from intrasplat.splat.cuda.captured import one_at_a_time

LIMIT = 1e-2
"""Largest norm of a difference over the norm of the reference. Rounding gives 1e-5; at a pixel where it decides whether
a faint Gaussian is drawn, up to a hundred times that. An error gives 1."""
COUNT, WIDTH, HEIGHT = 32, 20, 13
_PARTS = ("mean", "quaternion", "scale", "opacity", "colour")


@cache
def check(memory: str, name: str) -> None:
    """Compare both once, in any grad mode. memory: torch's name of the device; name: the GPU's product name.

    Raises:
        UnavailableError: they differ by more than LIMIT, so nothing that this device computes can be trusted.
    """
    # inference_mode(False) enables gradients, also inside a caller's no_grad().
    with torch.inference_mode(False), one_at_a_time:  # the first render may run while the first job starts
        worst, part = disagreement(torch.device(memory))
    if not worst <= LIMIT:  # so that NaN is wrong, too
        raise UnavailableError(
            f"{name or memory} is not to be trusted: its {part} of a test scene is off by {worst:.1e}.",
            "Use the CPU (--device cpu, INTRASPLAT_DEVICE=cpu), and send what `make gpu-check` prints.",
        )


def disagreement(device: torch.device) -> tuple[float, str]:
    """The largest relative difference, or NaN if one is NaN, and the name of the image or gradient that has it."""
    right = _splatted(reference.rasterize, torch.device("cpu"), torch.float64)
    found = _splatted(rasterize, device, torch.float32)
    differences = {
        part: float((found[part].cpu().double() - wanted).norm() / wanted.norm()) for part, wanted in right.items()
    }
    part = max(differences, key=lambda each: (differences[each] != differences[each], differences[each]))
    return differences[part], part


def _splatted(splat: Callable[..., Rendered], device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    """Image [H, W, 5] of the scene, and the gradients of its product with fixed cotangents."""
    random = torch.Generator().manual_seed(1)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return (low + (high - low) * torch.rand(*shape, generator=random, dtype=torch.float64)).to(device, dtype)

    mean = torch.cat([uniform(-10, 10, COUNT, 1), uniform(-6, 6, COUNT, 1), uniform(50, 70, COUNT, 1)], 1)
    values = (
        mean,
        uniform(-1, 1, COUNT, 4),
        uniform(0.5, 4, COUNT, 3),
        uniform(0.1, 0.98, COUNT),
        uniform(0, 1, COUNT, 3),
    )
    cotangents = uniform(-1, 1, HEIGHT, WIDTH, 5)
    for each in values:
        each.requires_grad_()
    camera = Camera(60.0, 60.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, torch.eye(4, dtype=torch.float64).numpy())
    seen = splat(*values, camera)
    image = torch.cat([seen.rgb, seen.depth[..., None] / 60, seen.alpha[..., None]], -1)
    gradients = torch.autograd.grad((image * cotangents).sum(), values)
    named = {f"gradient of {name}": each for name, each in zip(_PARTS, gradients, strict=True)}
    return {"image": image.detach(), **named}
