"""Adaptive density control, as published: split Gaussians with a large image gradient, remove transparent ones.

Symbols: N Gaussians. g_k = |dL/dmean2d| of step k in NDC, with the loss of intrasplat/splat/loss.py (tissue means).
Source: Kerbl et al., 3D Gaussian Splatting (2023), section 5, with the settings Deform3DGS trains with.

A Gaussian is split where the mean of g_k over the steps that saw it exceeds gradient_threshold. Kerbl et al. clone
it instead if it is smaller than a hundredth of the cameras' extent. That extent is the cameras' greatest distance from
their centre: 0 for an endoscope that stands still. Nothing is smaller than 0, so nothing is ever cloned.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from intrasplat.errors import TrainingDiverged
from intrasplat.methods.method import DensifySettings
from intrasplat.splat.layout import LOG_SCALE, MEAN, QUATERNION
from intrasplat.splat.model import Model

SPLIT_SHRINK = 0.8
"""Children of a Gaussian split into n are 1 / (0.8 n) as wide in every direction."""


class Densifier:
    """Sums every Gaussian's gradients on the model's device, and splits and prunes the model when that is due."""

    def __init__(self, settings: DensifySettings, count: int) -> None:
        self.settings = settings
        self._forget(count)

    def _forget(self, count: int) -> None:
        self._gradient_sum = torch.zeros(count, dtype=torch.float64)
        self._steps_seen = torch.zeros(count, dtype=torch.int64)

    @property
    def mean_gradient(self) -> NDArray[np.float64]:
        """[N] mean of g_k over the steps that saw each Gaussian since the last densification; 0 for those unseen."""
        return (self._gradient_sum / self._steps_seen.clamp(min=1)).cpu().numpy()

    def observe(self, model: Model) -> None:
        """Add the model's last step to the statistics.

        Raises:
            ValueError: the model has another number of Gaussians than the statistics.
        """
        if model.count != len(self._steps_seen):
            raise ValueError(f"statistics are of {len(self._steps_seen)} Gaussians, the model has {model.count}")
        visible = model.visible
        # New statistics, and those of a resume file, lie on the host.
        self._gradient_sum, self._steps_seen = (
            each.to(visible.device) for each in (self._gradient_sum, self._steps_seen)
        )
        self._gradient_sum += torch.where(visible, model.gradient_norm, 0.0)
        self._steps_seen += visible

    def apply(self, model: Model, iteration: int, random: np.random.Generator) -> None:
        """Split and prune if that is due after this iteration, and reset the statistics.

        Raises:
            TrainingDiverged: a gradient is not finite, or no Gaussian would be left.
        """
        if not self.settings.due(iteration):
            return
        gradient = self.mean_gradient
        if not np.isfinite(gradient).all():
            broken = int((~np.isfinite(gradient)).sum())
            raise TrainingDiverged(f"The gradients of {broken} Gaussians are not finite at iteration {iteration}.")
        opacity_logit = model.parameters()["opacity_logit"].cpu().numpy()
        columns, born = successors(self.settings, gradient, opacity_logit)
        if len(columns) == 0:
            raise TrainingDiverged(f"All {model.count} Gaussians have become transparent by iteration {iteration}.")
        _replace(model, columns, born, self.settings.split_into, random)
        self._forget(model.count)

    def arrays(self) -> dict[str, Tensor]:
        """The statistics, by name; views."""
        return {"densify.gradient_sum": self._gradient_sum, "densify.steps_seen": self._steps_seen}

    def load_arrays(self, stored: dict[str, Tensor]) -> None:
        """Load what arrays() returned; the number of Gaussians becomes the stored one.

        Raises:
            ValueError: the two arrays differ in length.
        """
        gradient_sum, steps_seen = stored["densify.gradient_sum"], stored["densify.steps_seen"]
        if gradient_sum.ndim != 1 or gradient_sum.shape != steps_seen.shape:
            shapes = tuple(gradient_sum.shape), tuple(steps_seen.shape)
            raise ValueError(f"densify.* have shapes {shapes[0]} and {shapes[1]}, not the same [N]")
        self._gradient_sum = gradient_sum.to(torch.float64, copy=True)
        self._steps_seen = steps_seen.to(torch.int64, copy=True)


def successors(
    settings: DensifySettings, gradient: NDArray[np.floating], opacity_logit: NDArray[np.floating]
) -> tuple[NDArray[np.int64], int]:
    """The next Gaussians as indices [M] of those they copy, and how many of them are children.

    Survivors come first, in their order. Then come the parents, split_into times. Empty if all are transparent.

    Args:
        gradient: [N], NDC; the mean gradient of each since the last densification.
        opacity_logit: [N].
    """
    pruned = opacity_logit < math.log(settings.min_opacity / (1 - settings.min_opacity))
    asked = np.flatnonzero((gradient > settings.gradient_threshold) & ~pruned)
    most = max(0, settings.max_count - int((~pruned).sum())) // (settings.split_into - 1)
    parents = _hardest_pulled(asked, gradient, most)
    kept = ~pruned
    kept[parents] = False
    columns = np.concatenate([np.flatnonzero(kept), np.tile(parents, settings.split_into)])
    return columns, len(parents) * settings.split_into


def _hardest_pulled(candidates: NDArray[np.int64], gradient: NDArray[np.floating], most: int) -> NDArray[np.int64]:
    """The indices of the `most` candidates with the greatest gradients, or of all if they are fewer; ascending."""
    order = np.argsort(-gradient[candidates], kind="stable")
    return np.sort(candidates[order[:most]])


def _replace(model: Model, columns: NDArray[np.int64], born: int, children: int, random: np.random.Generator) -> None:
    """Replace the model's Gaussians by those of these columns. The last `born` are children.

    A child is smaller than its parent, and its centre is drawn from the parent's own density. It keeps the parent's
    rotation, opacity, colour and motion. Its moments of Adam start at 0.
    """
    survivors = len(columns) - born
    model.take(columns, np.arange(len(columns)) >= survivors)

    if born == 0:
        return
    canonical = model.parameters()["canonical"][:, survivors:]
    state = np.array(canonical.cpu())
    mean, quaternion, log_scale = (state[rows] for rows in (MEAN, QUATERNION, LOG_SCALE))
    along_axes = random.standard_normal(mean.T.shape) * np.exp(log_scale.T)
    mean += Rotation.from_quat(quaternion.T[:, [1, 2, 3, 0]]).apply(along_axes).T.astype(np.float32)
    log_scale -= np.float32(math.log(SPLIT_SHRINK * children))
    canonical.copy_(torch.from_numpy(state))
