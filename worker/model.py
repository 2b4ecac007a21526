"""What training needs of a model, whatever computes its steps: Gaussians, their deformation and Adam's moments.

Symbols: N Gaussians; arrays in rows of N or more: columns from N on only fill the last vector. H W pixels.
Implementations: worker/raster/cpu/model.py, and worker/unfused.py for deformations without kernels of their own.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from worker.deformation import Deformation
from worker.gaussians import Gaussians
from worker.optimize import StepRates
from worker.raster.cpu import Target
from worker.raster.cpu.model import StepSums

Floats = NDArray[np.float32]


class Model(Protocol):
    """A scene that can be trained a frame at a time, rendered, and edited between two steps."""

    @property
    def count(self) -> int:
        """N."""
        ...

    @property
    def canonical(self) -> Floats:
        """[13, >= N]: mean 0:3, quaternion 3:7, log-scale 7:10, constant harmonic 10:13. May be written."""
        ...

    @property
    def opacity_logit(self) -> Floats:
        """[>= N]. May be written."""
        ...

    @property
    def gradient_norm(self) -> Floats:
        """[N] |dL/dmean2d| of the last step in NDC (the image is 2 wide and 2 high); a view."""
        ...

    @property
    def visible(self) -> NDArray[np.bool_]:
        """[N] whether the last frame could see each Gaussian: in front of the camera, in the image, not too faint."""
        ...

    def render(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> Floats:
        """R G B Z A, [5, H, W], Z = sum(w z) in units; a view that the next render overwrites.

        With values [N], a number a Gaussian, they are blended as colour is, and [6, H, W] ends with them.
        """
        ...

    def blend_values(self, values: Floats) -> Floats:
        """Further values [N], blended as colour was in the last render: [H, W]; a view."""
        ...

    def deformed_mean(self, t: float) -> Floats:
        """Centres at time t, [3, N] in units, as a copy."""
        ...

    def step(
        self,
        camera: NDArray[np.float64],
        t: float,
        target: Target,
        loss_settings: Floats,
        rates: StepRates,
        iteration: int,
        sh_degree: int = 0,
    ) -> StepSums:
        """One iteration (counted from 1) on one frame.

        Args:
            camera: camera_vector of the frame; target: the frame, padded.
            loss_settings: [5] as the blend reads them (worker/raster/cpu/blend.py).
            sh_degree: the harmonics in use at this iteration.
        """
        ...

    def take(self, columns: NDArray[np.int64], fresh: NDArray[np.bool_]) -> None:
        """Keep these Gaussians, in this order (repeats are copies); Adam's moments start at 0 where fresh."""
        ...

    def parameters(self) -> dict[str, np.ndarray]:
        """What is trained, by name; views of the live arrays. May be written."""
        ...

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything a resumed run needs, by name; views of the live arrays."""
        ...

    def load_arrays(self, stored: dict[str, np.ndarray]) -> None:
        """Put back what arrays() gave, into a model of the same size; ValueError if the sizes differ."""
        ...

    def export(self) -> tuple[Gaussians, Deformation]:
        """The Gaussians and their deformation as torch tensors (copies)."""
        ...
