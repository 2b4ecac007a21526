"""rasterize() with gradients by torch: what EndoGaussian (worker/evaluate/rivals) and the tests use."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from worker.model.layout import LOG_SCALE, MEAN, QUATERNION
from worker.raster import Camera, Rendered
from worker.raster.autograd import (
    MAX_LOGIT,
    logit_of,
    opacity_gradient,
    pose_gradient,
    rasterize_by,
    refuse_second_derivatives,
    scale_gradient,
    stacked,
)
from worker.raster.cpu.rasterizer import Floats, Rasterizer, padded
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
        count = padded(max(1, mean.shape[0]))
        logit = logit_of(opacity)
        state = np.concatenate([_rows(mean, count), _rows(quaternion, count, 1.0), _rows(scale.log(), count)])
        rasterizer = Rasterizer(camera.width, camera.height)
        rasterizer.project(camera_vector(camera), state, _rows(logit, count, -MAX_LOGIT)[0], _rows(colour, count))
        image = torch.from_numpy(rasterizer.render().copy())
        ctx.rasterizer, ctx.count = rasterizer, mean.shape[0]
        ctx.save_for_backward(scale, logit, camera_from_world)
        return image[:3].permute(1, 2, 0), image[3], image[4]

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        refuse_second_derivatives()
        scale, logit, camera_from_world = ctx.saved_tensors
        gradients = ctx.rasterizer.cotangent_backward(stacked(*cotangents).numpy())
        state = torch.from_numpy(gradients.state[:, : ctx.count].T.copy())
        v_logit = torch.from_numpy(gradients.opacity_logit[: ctx.count].copy())
        return (
            state[:, MEAN],
            state[:, QUATERNION],
            scale_gradient(state[:, LOG_SCALE], scale),
            opacity_gradient(v_logit, logit),
            torch.from_numpy(gradients.colour[:, : ctx.count].T.copy()),
            pose_gradient(torch.from_numpy(gradients.pose.sum(0)), camera_from_world),
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
    return rasterize_by(_Rasterize, mean, quaternion, scale, opacity, colour, camera)
