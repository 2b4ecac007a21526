"""The GPU's rasterize(), with gradients by torch.autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from intrasplat.splat.autograd import KernelGradients, rasterize_by
from intrasplat.splat.camera import Camera, Rendered
from intrasplat.splat.cuda.rasterizer import CudaRasterizer
from intrasplat.splat.step import camera_vector


def _kernels(
    mean: Tensor, quaternion: Tensor, scale: Tensor, logit: Tensor, colour: Tensor, camera: Camera
) -> tuple[Tensor, KernelGradients]:
    state = torch.cat([mean, quaternion, scale.log()], dim=1).float().T.contiguous()[None]
    rasterizer = CudaRasterizer(camera.width, camera.height, mean.device)
    row = torch.from_numpy(camera_vector(camera)).to(mean.device)
    given = row[None], state, logit, colour.float().T.contiguous()[None]
    rasterizer.project_and_sort(*given)
    if rasterizer.grown():
        rasterizer.project_and_sort(*given)

    def gradients(cotangents: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        found = rasterizer.cotangent_backward(cotangents[None], pose=True)
        return found.state[0].T.clone(), found.opacity_logit[0], found.colour[0].T.clone(), found.pose.sum((0, 1))

    return rasterizer.render()[0].clone(), gradients


def rasterize(
    mean: Tensor, quaternion: Tensor, scale: Tensor, opacity: Tensor, colour: Tensor, camera: Camera
) -> Rendered:
    """rasterize() of intrasplat/splat/camera.py in float32 on the device of mean; gradients by torch.autograd.

    Raises:
        ValueError: shapes that do not belong together.
    """
    return rasterize_by(_kernels, mean, quaternion, scale, opacity, colour, camera)
