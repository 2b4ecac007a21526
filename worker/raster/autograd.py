"""What every backend's rasterize() needs to pass torch's arguments and cotangents to its kernels and back."""

from __future__ import annotations

import torch
from torch import Tensor

from worker.raster import Camera, Rendered
from worker.raster.reference import check_shapes

MAX_LOGIT = 30.0
"""Stands for opacities 0 and 1, which have no finite logit; sigmoid(30) differs from 1 by 1e-13."""


def logit_of(opacity: Tensor) -> Tensor:
    """[N] float32 logits, finite."""
    return torch.logit(opacity.double()).clamp(-MAX_LOGIT, MAX_LOGIT).float()


def opacity_gradient(v_logit: Tensor, logit: Tensor) -> Tensor:
    """dL/dopacity [N] float32 from dL/dlogit."""
    slope = torch.sigmoid(logit.double()) * torch.sigmoid(-logit.double())
    return (v_logit.double() / slope).float()


def scale_gradient(v_log_scale: Tensor, scale: Tensor) -> Tensor:
    """dL/dscale [N, 3] float32 from dL/dlog_scale, finite also where a scale has underflowed to 0."""
    return v_log_scale / scale.clamp(min=torch.finfo(scale.dtype).tiny)


def pose_gradient(rows: Tensor, like: Tensor) -> Tensor:
    """dL/dcamera_from_world [4, 4] from that of its upper three rows, [12]; the last row gets 0."""
    pose = torch.zeros_like(like)
    pose[:3] = rows.reshape(3, 4).to(pose)
    return pose


def refuse_second_derivatives() -> None:
    """To be called first in a backward of kernels: torch would take their gradients for constants.

    Raises:
        RuntimeError: this backward runs with create_graph=True.
    """
    if torch.is_grad_enabled():
        raise RuntimeError("the kernels compute first derivatives only: differentiate twice with the reference")


def stacked(v_rgb: Tensor, v_depth: Tensor, v_alpha: Tensor) -> Tensor:
    """Cotangents of rgb [H, W, 3], depth and alpha [H, W] as the kernels read them: [5, H, W] float32."""
    return torch.cat([v_rgb.permute(2, 0, 1), v_depth[None], v_alpha[None]]).float().contiguous()


def rasterize_by(
    function: type[torch.autograd.Function],
    mean: Tensor,
    quaternion: Tensor,
    scale: Tensor,
    opacity: Tensor,
    colour: Tensor,
    camera: Camera,
) -> Rendered:
    """rasterize() by a backend's function of (the five, camera_from_world, camera) -> rgb, depth, alpha.

    Raises:
        ValueError: shapes that do not belong together.
    """
    check_shapes(mean, quaternion, scale, opacity, colour)
    arguments = (mean, quaternion, scale, opacity, colour, camera.pose(mean), camera)
    rgb, depth, alpha = function.apply(*arguments)  # type: ignore[no-untyped-call]
    return Rendered(rgb, depth, alpha)
