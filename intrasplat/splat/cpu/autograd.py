"""The CPU's rasterize(), with gradients by torch.autograd."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from intrasplat.splat.autograd import MAX_LOGIT, KernelGradients, rasterize_by
from intrasplat.splat.camera import Camera, Rendered
from intrasplat.splat.cpu.rasterizer import Floats, Rasterizer, padded
from intrasplat.splat.step import camera_vector


def _kernels(
    mean: Tensor, quaternion: Tensor, scale: Tensor, logit: Tensor, colour: Tensor, camera: Camera
) -> tuple[Tensor, KernelGradients]:
    columns = padded(max(1, len(mean)))
    state = np.concatenate([_rows(mean, columns), _rows(quaternion, columns, 1.0), _rows(scale.log(), columns)])
    rasterizer = Rasterizer(camera.width, camera.height)
    rasterizer.project_and_sort(
        camera_vector(camera), state, _rows(logit, columns, -MAX_LOGIT)[0], _rows(colour, columns)
    )
    count = len(mean)  # not mean itself, which the closure would keep

    def gradients(cotangents: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        found = rasterizer.cotangent_backward(cotangents.numpy())
        state, colour = (torch.from_numpy(each[:, :count].T.copy()) for each in (found.state, found.colour))
        logit = torch.from_numpy(found.opacity_logit[:count].copy())
        return state, logit, colour, torch.from_numpy(found.pose.sum(0))

    return torch.from_numpy(rasterizer.render().copy()), gradients


def _rows(tensor: Tensor, count: int, fill: float = 0.0) -> Floats:
    """[N, ...] tensor as [k, count] float32 rows; the columns beyond N only fill the last vector."""
    values = tensor.detach().reshape(tensor.shape[0], math.prod(tensor.shape[1:])).numpy()
    rows = np.full((values.shape[1], count), fill, np.float32)
    rows[:, : values.shape[0]] = values.T
    return rows


def rasterize(
    mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, colour: Tensor, camera: Camera
) -> Rendered:
    """rasterize() of intrasplat/splat/camera.py in float32 on the CPU; gradients by torch.autograd.

    Raises:
        ValueError: shapes that do not belong together.
    """
    return rasterize_by(_kernels, mean, quaternion, scale, opacity, colour, camera)
