"""The canonical state: N anisotropic Gaussians, how their stored numbers become physical ones, and how they start.

Symbols: N Gaussians, K = (degree + 1)^2 coefficients of spherical harmonics a colour channel.
Lengths are in optimiser units (the median valid training depth is 60).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from intrasplat.errors import InputError
from intrasplat.splat.constants import SH_C0, SH_C1, SH_C2, SH_C3

MAX_SH_DEGREE = 3
NEIGHBOURS = 3
"""Neighbours that decide a starting Gaussian's size."""
MIN_START_SCALE = 3e-4
"""Units. Coincident points would start at scale 0, whose logarithm is -infinity."""
MAX_START_SCALE = 6.0
"""Units, a tenth of the median depth. A stray stereo point far from all others would otherwise cover the image."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians, in the form that is optimised.

    mean          [N, 3]     centre in the world, optimiser units
    quaternion    [N, 4]     wxyz, any length but 0: projection normalises it
    log_scale     [N, 3]     natural logarithm of the three standard deviations in units
    opacity_logit [N]        logit of the opacity
    sh            [N, K, 3]  colour, K in {1, 4, 9, 16}
    gloss         [N]        how much brighter the right eye sees it than the left one, added to red, green and blue:
                             wet tissue mirrors the lamp elsewhere for each eye; 0 if not given
    """

    mean: Tensor
    quaternion: Tensor
    log_scale: Tensor
    opacity_logit: Tensor
    sh: Tensor
    gloss: Tensor = field(default_factory=lambda: torch.zeros(0))

    def __post_init__(self) -> None:
        if not self.gloss.numel():
            object.__setattr__(self, "gloss", torch.zeros_like(self.opacity_logit))

    def __len__(self) -> int:
        return int(self.mean.shape[0])

    @property
    def scale(self) -> Tensor:
        """[N, 3] standard deviations in units."""
        return torch.exp(self.log_scale)

    @property
    def opacity(self) -> Tensor:
        """[N] in (0, 1)."""
        return torch.sigmoid(self.opacity_logit)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(int(self.sh.shape[1])) - 1

    def colour(self, camera_centre: Tensor, side: float = 0.0, dim: float = 0.0) -> Tensor:
        """Colour seen from a camera at camera_centre ([3], world, units): [N, 3] RGB, not below 0, unbounded above.

        side, dim: the camera's factors of the gloss (intrasplat/splat/camera.py). With sh_degree > 0 gloss is ignored.
        """
        if self.sh.shape[1] == 1:  # no view dependence: skip the directions and their gradients
            shine = side * self.gloss - dim * self.gloss.abs()
            return torch.clamp(0.5 + SH_C0 * self.sh[:, 0] + shine[:, None], min=0.0)
        direction = torch.nn.functional.normalize(self.mean - camera_centre, dim=-1)
        return sh_colour(self.sh, direction)

    def tensors(self) -> dict[str, Tensor]:
        """The six tensors by name, to optimise or to store."""
        return {
            "mean": self.mean,
            "quaternion": self.quaternion,
            "log_scale": self.log_scale,
            "opacity_logit": self.opacity_logit,
            "sh": self.sh,
            "gloss": self.gloss,
        }


def sh_basis(degree: int, direction: Tensor) -> Tensor:
    """Real spherical harmonics of unit directions [N, 3]: [N, (degree + 1)^2], ordered by l, then m = -l..l.

    The signs, Condon-Shortley phase included, are those that splat viewers expect.
    """
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"degree must be 0..{MAX_SH_DEGREE}, not {degree}")
    x, y, z = direction.unbind(-1)
    columns = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        columns += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        columns += [
            SH_C2[0] * x * y,
            -SH_C2[0] * y * z,
            SH_C2[1] * (2 * z * z - x * x - y * y),
            -SH_C2[0] * x * z,
            SH_C2[2] * (x * x - y * y),
        ]
    if degree >= 3:
        columns += [
            -SH_C3[0] * y * (3 * x * x - y * y),
            SH_C3[1] * x * y * z,
            -SH_C3[2] * y * (4 * z * z - x * x - y * y),
            SH_C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -SH_C3[2] * x * (4 * z * z - x * x - y * y),
            SH_C3[4] * z * (x * x - y * y),
            -SH_C3[0] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, dim=-1)


def sh_colour(sh: Tensor, direction: Tensor) -> Tensor:
    """max(0, 0.5 + sum_k sh_k Y_k(direction)): sh [N, K, 3], unit direction [N, 3] (unread for K = 1) -> [N, 3]."""
    degree = math.isqrt(int(sh.shape[1])) - 1
    basis = sh_basis(degree, direction)
    return torch.clamp(0.5 + torch.einsum("nk,nkc->nc", basis, sh), min=0.0)


def sh_from_rgb(rgb: Tensor) -> Tensor:
    """The degree-0 coefficient whose colour is rgb [..., 3] in [0, 1]."""
    return (rgb - 0.5) / SH_C0


def initial_gaussians(
    points: NDArray[np.floating],
    rgb: NDArray[np.floating],
    *,
    sh_degree: int,
    opacity: float = 0.1,
) -> Gaussians:
    """Round Gaussians at a point cloud, as wide as the root mean square distance to the 3 nearest neighbours.

    Args:
        points: [N, 3] world positions in optimiser units.
        rgb: [N, 3] in [0, 1].
        sh_degree: 0..3; coefficients above degree 0 start at 0.
        opacity: the opacity of every Gaussian, in (0, 1).

    Raises:
        InputError: no points, shapes that do not fit, or values that are not finite.
    """
    _check_cloud(points, rgb, opacity)
    count = len(points)
    scale = _neighbour_scale(points)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = sh_from_rgb(torch.as_tensor(rgb, dtype=torch.float32))
    return Gaussians(
        mean=torch.tensor(points, dtype=torch.float32),
        quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scale=torch.as_tensor(np.log(scale), dtype=torch.float32)[:, None].repeat(1, 3),
        opacity_logit=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=sh,
    )


def _neighbour_scale(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """[N] root mean square distance to the 3 nearest others; with fewer than 3 others the upper clamp."""
    # The nearest is the point itself; the distance of a missing neighbour is inf.
    distance, _ = cKDTree(points).query(points, k=NEIGHBOURS + 1)
    scale: NDArray[np.float64] = np.sqrt(np.mean(distance[:, 1:] ** 2, axis=1))
    return np.clip(scale, MIN_START_SCALE, MAX_START_SCALE)


def _check_cloud(points: NDArray[np.floating], rgb: NDArray[np.floating], opacity: float) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != rgb.shape:
        raise InputError(
            "points", f"has shape {points.shape} with colours {rgb.shape}.", "Give two arrays of the same [N, 3]."
        )
    if len(points) == 0:
        raise InputError("points", "is empty: no training frame has valid depth on tissue.", "Check depth and masks.")
    if not (np.isfinite(points).all() and np.isfinite(rgb).all()):
        broken = int((~np.isfinite(points).all(1) | ~np.isfinite(rgb).all(1)).sum())
        raise InputError("points", f"holds {broken} points with NaN or infinity.", "Drop them before starting.")
    if not 0 < opacity < 1:
        raise InputError("opacity", f"is {opacity}.", "Give a number between 0 and 1, both excluded.")
