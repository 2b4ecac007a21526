"""Every backend's rasterize() with gradients by torch.autograd: converts torch's arguments and cotangents to the
kernels'."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from intrasplat.splat.camera import Camera, Rendered
from intrasplat.splat.layout import LOG_SCALE, MEAN, QUATERNION
from intrasplat.splat.reference import check_shapes

MAX_LOGIT = 30.0
"""Replaces the infinite logits of opacities 0 and 1; sigmoid(30) differs from 1 by 1e-13."""


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


def stacked(v_rgb: Tensor, v_depth: Tensor, v_alpha: Tensor) -> Tensor:
    """Cotangents of rgb [H, W, 3], depth and alpha [H, W] as the kernels read them: [5, H, W] float32."""
    return torch.cat([v_rgb.permute(2, 0, 1), v_depth[None], v_alpha[None]]).float().contiguous()


KernelGradients = Callable[[Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]
"""From cotangents [5, H, W] of an image to dL/dstate [N, 10] (layout.py), dL/dlogit [N], dL/dcolour [N, 3] and
dL/dcamera_from_world [12], its upper three rows."""
Kernels = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Camera], tuple[Tensor, KernelGradients]]
"""A backend: from mean, quaternion, scale, logit, colour and camera to the image [5, H, W] and its gradients."""


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        kernels: Kernels,
        mean: Tensor,
        quaternion: Tensor,
        scale: Tensor,
        opacity: Tensor,
        colour: Tensor,
        camera_from_world: Tensor,
        camera: Camera,
    ) -> tuple[Tensor, Tensor, Tensor]:
        logit = logit_of(opacity)
        image, ctx.gradients = kernels(mean, quaternion, scale, logit, colour, camera)
        ctx.save_for_backward(scale, logit, camera_from_world)
        return image[:3].permute(1, 2, 0), image[3], image[4]

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True: torch would treat the kernels' gradients as constants
            raise RuntimeError("the kernels differentiate once: pass backend='reference' to differentiate twice")
        scale, logit, camera_from_world = ctx.saved_tensors
        v_state, v_logit, v_colour, v_pose = ctx.gradients(stacked(*cotangents))
        return (
            None,
            v_state[:, MEAN],
            v_state[:, QUATERNION],
            scale_gradient(v_state[:, LOG_SCALE], scale),
            opacity_gradient(v_logit, logit),
            v_colour,
            pose_gradient(v_pose, camera_from_world),
            None,
        )


def rasterize_by(
    kernels: Kernels, mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, colour: Tensor, camera: Camera
) -> Rendered:
    """rasterize() by a backend's kernels.

    Raises:
        ValueError: shapes that do not belong together.
    """
    check_shapes(mean, quaternion, scale, opacity, colour)
    arguments = (kernels, mean, quaternion, scale, opacity, colour, camera.pose(mean), camera)
    rgb, depth, alpha = _Rasterize.apply(*arguments)  # type: ignore[no-untyped-call]
    return Rendered(rgb, depth, alpha)
