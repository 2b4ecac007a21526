"""rasterize() with gradients by torch: what the rivals without a fused step, and the tests, use."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from worker.raster import Camera, Rendered
from worker.raster.cpu.rasterizer import Floats, Rasterizer, camera_vector, padded

_PAD_LOGIT = -30.0  # opacity of the columns that only fill the last vector: culled


def _rows(tensor: Tensor, count: int, fill: float = 0.0) -> Floats:
    """[N, k] tensor as [k, padded N] float32 rows."""
    values = tensor.detach().reshape(tensor.shape[0], math.prod(tensor.shape[1:])).numpy()
    rows = np.full((values.shape[1], count), fill, np.float32)
    rows[:, : values.shape[0]] = values.T
    return rows


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
        count = padded(max(1, mean.shape[0]))
        state = np.concatenate([_rows(mean, count), _rows(quaternion, count, 1.0), _rows(scale.log(), count)])
        logit = _rows(torch.logit(opacity.double()).clamp(-_PAD_LIMIT, _PAD_LIMIT), count, _PAD_LOGIT)[0]
        rasterizer = Rasterizer(camera.width, camera.height)
        rasterizer.project(camera_vector(camera), state, logit, _rows(colour, count))
        image = torch.from_numpy(rasterizer.render().copy())
        ctx.rasterizer, ctx.count = rasterizer, mean.shape[0]
        ctx.save_for_backward(scale, opacity, camera_from_world)
        return image[:3].permute(1, 2, 0), image[3], image[4]

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        scale, opacity, camera_from_world = ctx.saved_tensors
        v_rgb, v_depth, v_alpha = cotangents
        stacked = torch.cat([v_rgb.permute(2, 0, 1), v_depth[None], v_alpha[None]]).contiguous().float()
        gradients = ctx.rasterizer.cotangent_backward(stacked.numpy())
        state = torch.from_numpy(gradients.state[:, : ctx.count].T.copy())
        v_opacity = torch.from_numpy(gradients.opacity_logit[: ctx.count].copy())
        pose = torch.zeros_like(camera_from_world)
        pose[:3] = torch.from_numpy(gradients.pose.sum(0).reshape(3, 4)).to(pose)
        slope = (opacity * (1 - opacity)).clamp_min(1e-12)
        return (
            state[:, 0:3],
            state[:, 3:7],
            state[:, 7:10] / scale,
            v_opacity / slope,
            torch.from_numpy(gradients.colour[:, : ctx.count].T.copy()),
            pose,
            None,
        )


_PAD_LIMIT = 30.0  # a logit beyond it is 0 or 1 in float32


def rasterize(
    mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, colour: Tensor, camera: Camera
) -> Rendered:
    """See worker/raster/__init__.py. float32 on the CPU; gradients by torch.autograd."""
    pose = camera.pose(mean)
    rgb, depth, alpha = _Rasterize.apply(mean, quaternion, scale, opacity, colour, pose, camera)
    return Rendered(rgb, depth, alpha)
