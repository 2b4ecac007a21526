"""rasterize() with gradients by torch: what the rivals without a fused step, and the tests, use."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from worker.raster import Camera, Rendered
from worker.raster.cpu.rasterizer import Floats, Rasterizer, padded
from worker.raster.reference import check_shapes
from worker.raster.step import camera_vector

_LARGEST_LOGIT = 30.0
"""Stands for opacities 0 and 1, which have no finite logit; sigmoid(30) differs from 1 by 1e-13."""


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
        logit = torch.logit(opacity.double()).clamp(-_LARGEST_LOGIT, _LARGEST_LOGIT).float()
        state = np.concatenate([_rows(mean, count), _rows(quaternion, count, 1.0), _rows(scale.log(), count)])
        rasterizer = Rasterizer(camera.width, camera.height)
        rasterizer.project(camera_vector(camera), state, _rows(logit, count, -_LARGEST_LOGIT)[0], _rows(colour, count))
        image = torch.from_numpy(rasterizer.render().copy())
        ctx.rasterizer, ctx.count = rasterizer, mean.shape[0]
        ctx.save_for_backward(scale, logit, camera_from_world)
        return image[:3].permute(1, 2, 0), image[3], image[4]

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        scale, logit, camera_from_world = ctx.saved_tensors
        v_rgb, v_depth, v_alpha = cotangents
        stacked = torch.cat([v_rgb.permute(2, 0, 1), v_depth[None], v_alpha[None]]).contiguous().float()
        gradients = ctx.rasterizer.cotangent_backward(stacked.numpy())
        state = torch.from_numpy(gradients.state[:, : ctx.count].T.copy())
        v_logit = torch.from_numpy(gradients.opacity_logit[: ctx.count].copy()).double()
        slope = torch.sigmoid(logit.double()) * torch.sigmoid(-logit.double())
        pose = torch.zeros_like(camera_from_world)
        pose[:3] = torch.from_numpy(gradients.pose.sum(0).reshape(3, 4)).to(pose)
        return (
            state[:, 0:3],
            state[:, 3:7],
            state[:, 7:10] / scale,
            (v_logit / slope).float(),
            torch.from_numpy(gradients.colour[:, : ctx.count].T.copy()),
            pose,
            None,
        )


def _rows(tensor: Tensor, count: int, fill: float = 0.0) -> Floats:
    """[N, ...] tensor as [k, count] float32 rows; the columns beyond N only fill the last vector."""
    values = tensor.detach().reshape(tensor.shape[0], math.prod(tensor.shape[1:])).numpy()
    rows = np.full((values.shape[1], count), fill, np.float32)
    rows[:, : values.shape[0]] = values.T
    return rows


def rasterize(
    mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, colour: Tensor, camera: Camera
) -> Rendered:
    """See worker/raster/__init__.py. float32 on the CPU; gradients by torch.autograd.

    Raises:
        ValueError: shapes that do not belong together.
    """
    check_shapes(mean, quaternion, scale, opacity, colour)
    pose = camera.pose(mean)
    arguments = (mean, quaternion, scale, opacity, colour, pose, camera)
    rgb, depth, alpha = _Rasterize.apply(*arguments)  # type: ignore[no-untyped-call]
    return Rendered(rgb, depth, alpha)
