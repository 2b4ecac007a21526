"""rasterize() with gradients by torch on the device."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from worker.raster import Camera, Rendered
from worker.raster.cuda.rasterizer import CudaRasterizer
from worker.raster.reference import check_shapes

_LARGEST_LOGIT = 30.0
"""Stands for opacities 0 and 1, which have no finite logit; sigmoid(30) differs from 1 by 1e-13."""


def camera_rows(camera: Camera, device: torch.device) -> Tensor:
    """float64 [1, 18]: fx, fy, cx, cy, W, H and camera_from_world [3, 4] row-major, as the kernels read a camera."""
    pose = camera.pose(torch.zeros((), dtype=torch.float64, device=device)).detach()
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
    return torch.cat([torch.tensor(numbers, dtype=torch.float64, device=device), pose[:3].reshape(12)])[None]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        mean: Tensor,
        quaternion: Tensor,
        scale: Tensor,
        opacity: Tensor,
        colour: Tensor,
        camera_from_world: Tensor,
        camera: Camera,
    ) -> tuple[Tensor, Tensor, Tensor]:
        logit = torch.logit(opacity.double()).clamp(-_LARGEST_LOGIT, _LARGEST_LOGIT).float()
        state = torch.cat([mean, quaternion, scale.log()], dim=1).float().T.contiguous()[None]
        rasterizer = CudaRasterizer(camera.width, camera.height, mean.device)
        rows = camera_rows(camera, mean.device)
        rasterizer.project(rows, state, logit, colour.float().T.contiguous()[None])
        if rasterizer.grown():
            rasterizer.project(rows, state, logit, colour.float().T.contiguous()[None])
        image = rasterizer.render()[0].clone()
        ctx.rasterizer = rasterizer
        ctx.save_for_backward(scale, logit, camera_from_world)
        return image[:3].permute(1, 2, 0), image[3], image[4]

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        scale, logit, camera_from_world = ctx.saved_tensors
        v_rgb, v_depth, v_alpha = cotangents
        stacked = torch.cat([v_rgb.permute(2, 0, 1), v_depth[None], v_alpha[None]])[None].float().contiguous()
        gradients = ctx.rasterizer.cotangent_backward(stacked, pose=True)
        state = gradients.state[0].T.clone()
        slope = torch.sigmoid(logit.double()) * torch.sigmoid(-logit.double())
        pose = torch.zeros_like(camera_from_world)
        pose[:3] = gradients.pose.sum((0, 1)).reshape(3, 4).to(pose)
        return (
            state[:, 0:3],
            state[:, 3:7],
            state[:, 7:10] / scale,
            (gradients.opacity_logit[0].double() / slope).float(),
            gradients.colour[0].T.clone(),
            pose,
            None,
        )


def rasterize(
    mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, colour: Tensor, camera: Camera
) -> Rendered:
    """See worker/raster/__init__.py. float32 on the device of mean; gradients by torch.autograd.

    Raises:
        ValueError: shapes that do not belong together.
    """
    check_shapes(mean, quaternion, scale, opacity, colour)
    pose = camera.pose(mean)
    arguments = (mean, quaternion, scale, opacity, colour, pose, camera)
    rgb, depth, alpha = _Rasterize.apply(*arguments)  # type: ignore[no-untyped-call]
    return Rendered(rgb, depth, alpha)
