"""Splatting: Gaussians and a camera in, colour, depth and alpha out. Every backend obeys this one contract.

    rasterize(mean, quaternion, scale, opacity, colour, camera) -> Rendered

rasterize.py joins the backends behind one public function of several cameras, in gsplat's names.

Symbols: N Gaussians, H W pixels (rows i, columns j), T transmittance. Lengths in optimiser units. Names in capitals are
the bounds of worker/model/constants.py.

    mean        [N, 3]  world                    opacity  [N]     in [0, 1]
    quaternion  [N, 4]  wxyz, any length but 0   colour   [N, 3]  blended as it is, not clamped
    scale       [N, 3]  standard deviations > 0  camera   Camera

Projection. (x, y, z) = camera_from_world mean; R, S rotation and scale; W the rotation of camera_from_world.
    mean2d = (fx x / z + cx, fy y / z + cy); the centre of pixel (i, j) is at (j + 0.5, i + 0.5)
    Sigma  = R S S^T R^T, R from the normalised quaternion
    J      = [[fx / z, 0, -fx u / z], [0, fy / z, -fy v / z]]
             u = x / z clamped to [-(cx + margin) / fx, (W - cx + margin) / fx], margin = IMAGE_MARGIN W
             v = y / z clamped likewise, with H, fy, cy
    cov2d  = J W Sigma W^T J^T + 0.3 diag(m_x^2, m_y^2) (EPS2D, pixels^2);  conic = cov2d^-1
    m_x    = max(1, e_x z_r / z), e = Camera.enlarged, z_r = Camera.recorded_depth (mean, 1); m_y likewise

Cull. A Gaussian draws nothing where z <= NEAR or opacity < 1/255, or where no pixel centre of the image can reach
alpha >= 1/255: a bound that only saves work and never changes a pixel.

Order. Ascending z of the mean, stable by index.

Blend. d = pixel centre - mean2d, front to back from T = 1 at every pixel:
    alpha = min(MAX_ALPHA, opacity exp(-d^T conic d / 2))
    alpha = 0 where it is < MIN_ALPHA, and where T before this Gaussian is < MIN_TRANSMITTANCE (the pixel is full)
    w = T alpha;  T <- T (1 - alpha)
    rgb = sum w colour;  depth = sum w z;  alpha = sum w          no background: what nothing covers is black

Gradients reach mean, quaternion, scale, opacity, colour and camera_from_world (if it is a tensor that asks), depth's
also z. They are 0 through a clamped u or v (the rest of J keeps its own), through m_x and m_y, through alpha at
MAX_ALPHA, and through the cuts and the order; a culled Gaussian gets 0, and so does the last row of camera_from_world.

N = 0 and a scene without a visible Gaussian render black, with zero gradients. Inputs must be finite.
No backend may hold an array of N x H x W.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worker.model.constants import IMAGE_MARGIN


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: OpenCV axes, focal lengths and principal point in pixels.

    camera_from_world is [4, 4] float64, rigid, translation in optimiser units; a tensor where its gradient is wanted.
    side and dim say what it sees of the gloss g of a Gaussian (worker/model/gaussians.py): the colour gains side g and
    loses dim |g|. The left eye has side -1/2, the right eye 1/2. The rasteriser gets colours that have it already.
    enlarged and recorded_depth say how large a pixel of the recording is (docs/rasterizer.md): by how much the focal
    lengths exceed the recording's, and the third row of the recording's camera_from_world. By default it is a pixel.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    camera_from_world: NDArray[np.float64] | Tensor
    side: float = 0.0
    dim: float = 0.0
    enlarged: tuple[float, float] = (0.0, 0.0)
    recorded_depth: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1 or min(self.fx, self.fy) <= 0:
            raise ValueError(f"no image of {self.width} x {self.height} at focal lengths {self.fx}, {self.fy}")
        if tuple(self.camera_from_world.shape) != (4, 4):
            raise ValueError(f"camera_from_world must be [4, 4], not {tuple(self.camera_from_world.shape)}")

    def pose(self, like: Tensor) -> Tensor:
        """camera_from_world as a tensor of like's dtype and device; differentiable where it is a tensor."""
        given = self.camera_from_world
        return given.to(like) if isinstance(given, Tensor) else torch.tensor(given).to(like)

    def centre(self, like: Tensor) -> Tensor:
        """[3] position in the world, likewise."""
        pose = self.pose(like)
        return -pose[:3, :3].T @ pose[:3, 3]

    def ratio_limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Least and greatest x / z, then y / z, at which J is taken."""
        beyond_x, beyond_y = IMAGE_MARGIN * self.width / self.fx, IMAGE_MARGIN * self.height / self.fy
        return (
            (-self.cx / self.fx - beyond_x, (self.width - self.cx) / self.fx + beyond_x),
            (-self.cy / self.fy - beyond_y, (self.height - self.cy) / self.fy + beyond_y),
        )


@dataclass(frozen=True, eq=False)
class Rendered:
    """What a camera sees.

    rgb    [H, W, 3]  sum w colour, unclamped
    depth  [H, W]     sum w z in units, not divided by alpha
    alpha  [H, W]     sum w in [0, 1)
    """

    rgb: Tensor
    depth: Tensor
    alpha: Tensor
