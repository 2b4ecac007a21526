"""The reference rasteriser in plain torch, for any float dtype and with autograd; its equations are in camera.py.

Symbols: N Gaussians, H W pixels, M (Gaussian, tile) instances, P pixels of a tile, Q Gaussians of a chunk.
The other backends are tested against this one in float64.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from intrasplat.splat.camera import Camera, Rendered
from intrasplat.splat.constants import EPS2D, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR

TILE = 16
"""Side of a tile in pixels."""
CHUNK = 256
"""Gaussians of one tile that are blended together; an intermediate has at most TILE^2 * CHUNK numbers."""
BOUND_SLACK = 0.01
"""Pixels added to a footprint, so that rounding never culls what reaches MIN_ALPHA."""


@dataclass(frozen=True, eq=False)
class Projected:
    """Gaussians on the image. The other numbers of a row with visible False are finite but meaningless.

    mean2d       [N, 2]  x, y in pixels
    conic        [N, 3]  (a, b, c) of the inverse covariance [[a, b], [b, c]], 1 / pixels^2
    depth        [N]     camera z of the mean, units
    opacity      [N]
    half_extent  [N, 2]  pixels from mean2d, x and y, beyond which alpha < MIN_ALPHA; no gradient
    visible      [N]     bool
    """

    mean2d: Tensor
    conic: Tensor
    depth: Tensor
    opacity: Tensor
    half_extent: Tensor
    visible: Tensor


@dataclass(frozen=True)
class Tiles:
    """The Gaussians that touch each tile; tiles row by row, each list in blending order.

    gaussian  [M] int64 indices, the tiles' lists one after the other
    counts    length of each tile's list, for rows * columns tiles
    """

    rows: int
    columns: int
    gaussian: Tensor
    counts: list[int]


def rasterize(
    mean: Tensor,  # [N, 3]
    quaternion: Tensor,  # [N, 4]
    scale: Tensor,  # [N, 3]
    opacity: Tensor,  # [N]
    colour: Tensor,  # [N, 3]
    camera: Camera,
) -> Rendered:
    """Render N Gaussians as camera.py defines it, in the dtype of mean.

    Raises:
        ValueError: shapes that do not belong together.
    """
    check_shapes(mean, quaternion, scale, opacity, colour)
    projected = project(mean, quaternion, scale, opacity, camera)
    tiles = bin_tiles(projected, camera)
    return blend(projected, colour, tiles, camera)


def check_shapes(mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, colour: Tensor) -> None:
    """Raises ValueError unless the five are [N, 3], [N, 4], [N, 3], [N], [N, 3]."""
    count = mean.shape[0] if mean.ndim else 0
    given = [tuple(each.shape) for each in (mean, quaternion, scale, opacity, colour)]
    wanted = [(count, 3), (count, 4), (count, 3), (count,), (count, 3)]
    if given != wanted:
        raise ValueError(f"mean, quaternion, scale, opacity, colour have shapes {given}, not {wanted}")


def project(mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, camera: Camera) -> Projected:
    """Project Gaussians from the world onto the image (camera.py, "Projection" and "Cull")."""
    pose = camera.pose(mean)
    x, y, depth = (mean @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    in_front = depth > NEAR
    z = torch.where(in_front, depth, torch.ones_like(depth))  # keeps values and gradients of culled ones finite

    mean2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1)
    half = pose[:3, :3] @ rotation(quaternion) * scale[:, None, :]  # W R S: [N, 3, 3]
    on_image = projection_jacobian(x / z, y / z, z, camera) @ half  # [N, 2, 3]
    covariance = on_image @ on_image.transpose(1, 2)
    low_x, low_y = _low_pass(mean.detach(), z.detach(), camera)
    xx, xy, yy = covariance[:, 0, 0] + low_x, covariance[:, 0, 1], covariance[:, 1, 1] + low_y
    determinant = xx * yy - xy * xy
    conic = torch.stack([yy, -xy, xx], dim=-1) / determinant[:, None]

    half_extent = _half_extent(xx.detach(), yy.detach(), opacity.detach())
    visible = in_front & (opacity >= MIN_ALPHA) & _meets_image(mean2d.detach(), half_extent, camera)
    return Projected(mean2d, conic, depth, opacity, half_extent, visible)


def _low_pass(mean: Tensor, z: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """The terms added to the variances along x and y, [N] each: 0.3 m_x^2 and 0.3 m_y^2."""
    row = mean.new_tensor(camera.recorded_depth)
    nearer = (mean @ row[:3] + row[3]) / z
    x, y = (EPS2D * torch.clamp(enlarged * nearer, min=1.0) ** 2 for enlarged in camera.enlarged)
    return x, y


def rotation(quaternion: Tensor) -> Tensor:
    """Quaternions wxyz [N, 4] of any length but 0 -> rotation matrices [N, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def projection_jacobian(x_over_z: Tensor, y_over_z: Tensor, z: Tensor, camera: Camera) -> Tensor:
    """[N, 2, 3] J, the derivative of the pixel by the camera's x, y, z, with u and v clamped to Camera.ratio_limits."""
    x_limits, y_limits = camera.ratio_limits()
    u, v = torch.clamp(x_over_z, *x_limits), torch.clamp(y_over_z, *y_limits)
    zero = torch.zeros_like(z)
    first = torch.stack([camera.fx / z, zero, -camera.fx * u / z], dim=-1)
    second = torch.stack([zero, camera.fy / z, -camera.fy * v / z], dim=-1)
    return torch.stack([first, second], dim=-2)


def _half_extent(variance_x: Tensor, variance_y: Tensor, opacity: Tensor) -> Tensor:
    """[N, 2] half-size of the bounding box of the ellipse opacity exp(-d^T conic d / 2) = MIN_ALPHA, pixels."""
    squared = 2 * torch.log(torch.clamp(opacity / MIN_ALPHA, min=1.0))
    return torch.sqrt(squared[:, None] * torch.stack([variance_x, variance_y], dim=-1)) + BOUND_SLACK


def _meets_image(mean2d: Tensor, half_extent: Tensor, camera: Camera) -> Tensor:
    """[N] bool: the footprint reaches the centre of some pixel."""
    last = mean2d.new_tensor([camera.width - 0.5, camera.height - 0.5])
    return ((mean2d + half_extent >= 0.5) & (mean2d - half_extent <= last)).all(dim=-1)


@torch.no_grad()
def bin_tiles(projected: Projected, camera: Camera) -> Tiles:
    """Sort the visible Gaussians by depth, and list them for every tile they may touch."""
    by_depth = torch.argsort(projected.depth, stable=True)
    drawn = by_depth[projected.visible[by_depth]]
    low = projected.mean2d[drawn] - projected.half_extent[drawn]
    high = projected.mean2d[drawn] + projected.half_extent[drawn]
    rows, columns = -(-camera.height // TILE), -(-camera.width // TILE)
    lists = []
    for top in range(0, camera.height, TILE):
        in_row = (high[:, 1] >= top) & (low[:, 1] <= top + TILE)
        for left in range(0, camera.width, TILE):
            lists.append(drawn[in_row & (high[:, 0] >= left) & (low[:, 0] <= left + TILE)])
    return Tiles(rows, columns, torch.cat(lists), [len(each) for each in lists])


def blend(projected: Projected, colour: Tensor, tiles: Tiles, camera: Camera) -> Rendered:
    """Blend every tile's Gaussians front to back."""
    features = torch.cat([colour, projected.depth[:, None], torch.ones_like(projected.depth)[:, None]], dim=1)
    splats = torch.cat([projected.mean2d, projected.conic, projected.opacity[:, None], features], dim=1)
    of_tile = torch.split(splats[tiles.gaussian], tiles.counts)  # one gather, so that its gradient is one scatter
    rows = []
    for row in range(tiles.rows):
        blocks = [
            _blend_tile(of_tile[row * tiles.columns + column], row * TILE, column * TILE, camera)
            for column in range(tiles.columns)
        ]
        rows.append(torch.cat(blocks, dim=1))
    image = torch.cat(rows, dim=0)  # [H, W, 5]
    return Rendered(rgb=image[..., :3], depth=image[..., 3], alpha=image[..., 4])


def _blend_tile(splats: Tensor, top: int, left: int, camera: Camera) -> Tensor:
    """[rows, columns, 5] sum w f of one tile, f = (colour, z, 1), from its splats [*, 11] in blending order."""
    rows, columns = min(TILE, camera.height - top), min(TILE, camera.width - left)
    i, j = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    pixel = torch.stack([left + j.flatten() + 0.5, top + i.flatten() + 0.5], dim=-1).to(splats)  # [P, 2]

    blended = splats.new_zeros(len(pixel), 5)
    transmittance = splats.new_ones(len(pixel), 1)
    for chunk in torch.split(splats, CHUNK):  # an empty list still gives one empty chunk, so gradients stay connected
        mean2d, conic, opacity, features = chunk[:, :2], chunk[:, 2:5], chunk[:, 5], chunk[:, 6:]
        alpha = _alpha(pixel, mean2d, conic, opacity)  # [P, Q]
        before = transmittance * _exclusive_product(1 - alpha)
        alpha = torch.where(before >= MIN_TRANSMITTANCE, alpha, torch.zeros_like(alpha))
        blended = blended + (before * alpha) @ features
        transmittance = transmittance * torch.prod(1 - alpha, dim=1, keepdim=True)
    return blended.reshape(rows, columns, 5)


def _alpha(pixel: Tensor, mean2d: Tensor, conic: Tensor, opacity: Tensor) -> Tensor:
    """[P, Q] alpha of each Gaussian at each pixel centre, clamped to MAX_ALPHA and 0 below MIN_ALPHA."""
    dx, dy = (pixel[:, None, :] - mean2d[None, :, :]).unbind(-1)
    a, b, c = conic.unbind(-1)
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
    alpha = torch.clamp(opacity * torch.exp(power), max=MAX_ALPHA)
    return torch.where(alpha >= MIN_ALPHA, alpha, torch.zeros_like(alpha))


def _exclusive_product(factors: Tensor) -> Tensor:
    """[P, Q] product of the factors before each column.

    The products ignore that a full pixel stops. They never grow, so the first column below MIN_TRANSMITTANCE is the
    same as with the stop, and every later one is below it too.
    """
    shifted = torch.cat([torch.ones_like(factors[:, :1]), factors[:, :-1]], dim=1)
    return torch.cumprod(shifted, dim=1)
