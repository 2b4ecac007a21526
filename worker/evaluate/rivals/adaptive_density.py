"""Splits and drops Gaussians while `endogaussian` trains, as in 3D Gaussian splatting (Kerbl et al., 2023, section 5).

Symbols: N Gaussians. worker/train/densify.py says which are split and dropped; here that edits torch's parameters.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from contract.wire.errors import TrainingDiverged
from worker.methods.method import DensifySettings
from worker.raster import Camera
from worker.raster.reference import rotation
from worker.train.densify import SPLIT_SHRINK, successors

PARAMETERS = 6
"""Of Gaussians, each in a group of its own, and these the optimiser's first groups: mean [N, 3] in units,
quaternion [N, 4], log_scale [N, 3], opacity_logit [N, 1], then two of colours: [N, 1, 3], and harmonics [N, K, 3]."""


class AdaptiveDensity:
    """How hard the loss pulls each projected Gaussian, and what that makes of the Gaussians.

    The pull is the mean of |dL/dmean2d| in NDC over the steps that saw the Gaussian since the last split.
    """

    def __init__(self, settings: DensifySettings, optimizer: torch.optim.Optimizer) -> None:
        self.settings, self._optimizer = settings, optimizer
        self._forget()

    def _forget(self) -> None:
        mean = self._optimizer.param_groups[0]["params"][0]
        self._sum, self._seen = torch.zeros_like(mean[:, 0]), torch.zeros_like(mean[:, 0])

    @property
    def pull(self) -> Tensor:
        """[N]; 0 where no step saw the Gaussian."""
        return self._sum / self._seen.clamp(min=1)

    def watch(self, deformed: Tensor, camera: Camera) -> None:
        """Observe the gradient by deformed [N, 3 or more], means in units first, in the next backward pass."""
        places = deformed.detach()[:, :3]

        def observe(gradient: Tensor) -> None:
            self.observe(gradient[:, :3], places, camera)

        if deformed.requires_grad:
            deformed.register_hook(observe)  # type: ignore[no-untyped-call]

    @torch.no_grad()
    def observe(self, gradient: Tensor, places: Tensor, camera: Camera) -> None:
        """Add a step's gradient [N, 3] by places [N, 3] (units, world), which the camera saw.

        The gradient by a projected place is taken as that by the place, across the viewing axis, times z / f. So it
        also contains what reaches the place through the projected covariance and the view-dependent colour.
        """
        pose = camera.pose(places)
        across = (gradient @ pose[:3, :3].T)[:, :2]
        z = (places @ pose[2, :3] + pose[2, 3])[:, None]
        ndc = across * z * across.new_tensor([camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)])
        length = ndc.norm(dim=1)
        self._sum += length
        self._seen += length > 0

    @torch.no_grad()
    def split(self, random: torch.Generator) -> list[nn.Parameter]:
        """Drop transparent Gaussians and split those that are pulled hardest: the new parameters, children last.

        Children are smaller, at places drawn from their parent's density, and the same in everything else.

        Raises:
            TrainingDiverged: all are transparent.
        """
        opacity_logit = self._optimizer.param_groups[3]["params"][0]
        found, born = successors(self.settings, self.pull.cpu().numpy(), opacity_logit[:, 0].cpu().numpy())
        if len(found) == 0:
            raise TrainingDiverged("All Gaussians have become transparent.")
        indices = torch.from_numpy(found).to(opacity_logit.device)
        made = [self._taken(group, indices, born) for group in self._optimizer.param_groups[:PARAMETERS]]
        mean, quaternion, log_scale = (each[len(indices) - born :] for each in made[:3])
        along_axes = torch.randn(mean.shape, generator=random).to(mean) * log_scale.exp()
        mean += (rotation(quaternion) @ along_axes[..., None])[..., 0]
        log_scale -= math.log(SPLIT_SHRINK * self.settings.split_into)
        self._forget()
        return made

    def _taken(self, group: dict[str, list[nn.Parameter]], indices: Tensor, born: int) -> nn.Parameter:
        """These rows of a group's parameter; of Adam's moments, those of the last born are 0."""
        (old,) = group["params"]
        new = nn.Parameter(old.detach()[indices])
        state = {}
        for name, each in self._optimizer.state.pop(old, {}).items():
            state[name] = each if each.ndim == 0 else each[indices]  # the number of steps is one for all
            if each.ndim:
                state[name][len(indices) - born :] = 0
        self._optimizer.state[new] = state
        group["params"] = [new]
        return new
