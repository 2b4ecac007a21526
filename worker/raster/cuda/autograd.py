"""rasterize() with gradients by torch on the device."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from worker.model.layout import LOG_SCALE, MEAN, QUATERNION
from worker.raster import Camera, Rendered
from worker.raster.autograd import (
    logit_of,
    opacity_gradient,
    pose_gradient,
    rasterize_by,
    refuse_second_derivatives,
    scale_gradient,
    stacked,
)
from worker.raster.cuda.rasterizer import CudaRasterizer
from worker.raster.step import camera_vector


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
        logit = logit_of(opacity)
        state = torch.cat([mean, quaternion, scale.log()], dim=1).float().T.contiguous()[None]
        rasterizer = CudaRasterizer(camera.width, camera.height, mean.device)
        row = torch.from_numpy(camera_vector(camera)).to(mean.device)
        given = row[None], state, logit, colour.float().T.contiguous()[None]
        rasterizer.project(*given)
        if rasterizer.grown():
            rasterizer.project(*given)
        image = rasterizer.render()[0].clone()
        ctx.rasterizer = rasterizer
        ctx.save_for_backward(scale, logit, camera_from_world)
        return image[:3].permute(1, 2, 0), image[3], image[4]

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        refuse_second_derivatives()
        scale, logit, camera_from_world = ctx.saved_tensors
        gradients = ctx.rasterizer.cotangent_backward(stacked(*cotangents)[None], pose=True)
        state = gradients.state[0].T.clone()
        return (
            state[:, MEAN],
            state[:, QUATERNION],
            scale_gradient(state[:, LOG_SCALE], scale),
            opacity_gradient(gradients.opacity_logit[0], logit),
            gradients.colour[0].T.clone(),
            pose_gradient(gradients.pose.sum((0, 1)), camera_from_world),
            None,
        )


def rasterize(
    mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, colour: Tensor, camera: Camera
) -> Rendered:
    """See worker/raster/__init__.py. float32 on the device of mean; gradients by torch.autograd.

    Raises:
        ValueError: shapes that do not belong together.
    """
    return rasterize_by(_Rasterize, mean, quaternion, scale, opacity, colour, camera)
