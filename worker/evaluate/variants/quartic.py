"""`fdm-quartic`: FDM as the authors' released code computes it, which differs from what they print.

The kernels of FDM compute both forms (worker/raster/cpu/update.py, worker/raster/cuda/motion_kernels.py).
"""

from __future__ import annotations

import torch
from torch import Tensor

from worker.model.constants import QUARTIC_FLOOR
from worker.model.deformation import FlexibleDeformation


class QuarticFdm(FlexibleDeformation):
    """The released code's form: b_j(t) = exp(-((t - theta_j)^2 / (sigma_j^2 + QUARTIC_FLOOR))^2)."""

    kind = "fdm-quartic"
    quartic = True

    def basis(self, t: float) -> Tensor:
        return torch.exp(-(((t - self.centre) ** 2 / (self.width**2 + QUARTIC_FLOOR)) ** 2))
