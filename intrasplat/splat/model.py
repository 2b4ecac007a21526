"""The interface of a model on any device: Gaussians, their deformation and Adam's moments.

Symbols: N Gaussians; H W pixels, the size in the camera vector; F frames per step.
Implementations: CpuModel (intrasplat/splat/cpu/model.py) and CudaModel (intrasplat/splat/cuda/model.py). Each has a
Motion, which evaluates and trains the deformation: by kernels, or on the CPU by torch
(intrasplat/splat/cpu/unfused.py). intrasplat/splat/backend.py creates the model for a device.

A device may lag behind: step() may return before the device has made the step. Every other method waits for all steps
first. The sums of a step that lags (StepSums) are returned by a later call.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.splat.deformation import Deformation
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.optimize import StepRates
from intrasplat.splat.step import StepSums, TrainingFrame

Floats = NDArray[np.float32]
FIRST_MOMENTS = "motion.first"
"""Name of a motion's first moments in Model.arrays()."""
BAND_PIXELS = 1 << 18
"""One core blends and converts so many pixels in some 12 ms."""


def bands_of(width: int, height: int, multiple: int = 1) -> list[slice]:
    """The rows of an image, from top to bottom, in bands of about BAND_PIXELS that start at multiples of `multiple`."""
    rows = multiple * max(1, BAND_PIXELS // (width * multiple))
    return [slice(first, min(first + rows, height)) for first in range(0, height, rows)]


class ProjectedPicture(Protocol):
    """The Gaussians at one time projected for one camera. Its bands of rows are blended one by one. It has buffers of
    its own, so the model may render other pictures in between."""

    @property
    def bands(self) -> Sequence[slice]:
        """The image's rows, from top to bottom, about BAND_PIXELS of them at a time."""
        ...

    def sort(self) -> None:
        """Sort the Gaussians; call it once before the first band. It may take as long as blending several bands."""
        ...

    def blend(self, rows: slice) -> Floats:
        """R G B Z A, and the values if given, of one of the bands, [5 or 6, h, W]; a view until close()."""
        ...

    def close(self) -> None:
        """Give the buffers back to the model."""
        ...


@dataclass(frozen=True)
class Blended:
    """A ProjectedPicture whose bands are already blended. image: [5 or 6, H, W]."""

    image: Floats

    @property
    def bands(self) -> list[slice]:
        """See ProjectedPicture."""
        return bands_of(self.image.shape[2], self.image.shape[1])

    def sort(self) -> None:
        """Does nothing."""

    def blend(self, rows: slice) -> Floats:
        """See ProjectedPicture."""
        return self.image[:, rows]

    def close(self) -> None:
        """Does nothing."""


class Model(Protocol):
    """A scene that can be trained on one or several frames per step, rendered, and edited between two steps.

    Tensors lie on the model's device, NumPy arrays on the host.
    """

    @property
    def count(self) -> int:
        """N."""
        ...

    @property
    def steps_a_report(self) -> int:
        """Steps from one StepSums to the next; 1 if step() waits for every step."""
        ...

    def step(
        self, frames: Sequence[TrainingFrame], loss: LossSettings, rates: StepRates, iteration: int, sh_degree: int = 0
    ) -> StepSums | None:
        """One iteration (counted from 1): one step of Adam on the sum of the frames' losses.

        Args:
            frames: F frames of one size; a frame may occur more than once. Another F may allocate new buffers.
            sh_degree: degree of the spherical harmonics in use at this iteration.

        Returns:
            The sums of the steps since the last StepSums; None if the device's report was not read.
        """
        ...

    def wait(self) -> StepSums | None:
        """Wait until every step is made; the sums of the steps since the last StepSums, or None without any."""
        ...

    @property
    def gradient_norm(self) -> Tensor:
        """[N] float32 |dL/dmean2d| of the last step in NDC (the image is 2 wide and 2 high), the largest of its frames;
        a view."""
        ...

    @property
    def visible(self) -> Tensor:
        """[N] bool: in one of the last step's frames it was in front of the camera, in the image and not too faint."""
        ...

    def render(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> Floats:
        """R G B Z A, [5, H, W], Z = sum(w z) in units; a view that the next render overwrites.

        With values [N], a number per Gaussian, they are blended as colour is, and [6, H, W] ends with them.
        """
        ...

    def projected(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> ProjectedPicture:
        """The same picture, bit-identical, to be blended in bands of rows. The caller closes it."""
        ...

    def blended(self, camera: NDArray[np.float64], t: float, planes: Floats) -> Floats:
        """Three numbers per Gaussian, planes [3, N], blended in place of R G B: [5, H, W], with Z and A as in render().

        A view that the next render overwrites.
        """
        ...

    def image_gradient(self, camera: NDArray[np.float64], t: float, cotangents: Floats) -> Floats:
        """Gradient of sum(cotangents * render(camera, t)), cotangents [5, H, W], to the Gaussians as they are at t.

        [VALUES, N], rows as in intrasplat/splat/layout.py. It ignores that colours are clamped at 0, and all harmonics
        but the constant one.
        """
        ...

    def deformed_mean(self, t: float) -> Floats:
        """Centres at time t, [3, N] in units, as a copy."""
        ...

    def take(self, columns: NDArray[np.int64], fresh: NDArray[np.bool_]) -> None:
        """Keep these Gaussians, in this order (repeats are copies); Adam's moments start at 0 where fresh."""
        ...

    def parameters(self) -> dict[str, Tensor]:
        """The trained tensors by name: views of the live ones, of the same shapes on every device. May be written.

        Among them: canonical [ROWS, N], rows as in intrasplat/splat/layout.py, and opacity_logit [N].
        """
        ...

    def arrays(self) -> dict[str, Tensor]:
        """All tensors that a resumed run needs, by name; views that may be written."""
        ...

    def load_arrays(self, stored: dict[str, Tensor]) -> None:
        """Load what arrays() returned, or some of it, on any device; ValueError if the sizes differ."""
        ...

    def export(self, *, as_it_lies: bool = False) -> tuple[Gaussians, Deformation]:
        """The Gaussians and their deformation as tensors on the host (copies).

        as_it_lies: the deformation's tensors need not be contiguous, which saves time if a model is created from them.
        """
        ...


def state_of(model: Model, beta1: float) -> dict[str, Tensor]:
    """arrays(), without a motion's first moments if beta1 is 0: then no step reads them.

    On a CPU they take much of the model's memory as soon as they are read.
    """
    return {name: values for name, values in model.arrays().items() if beta1 or name != FIRST_MOMENTS}


def put_back(arrays: Mapping[str, Tensor], stored: Mapping[str, Tensor]) -> None:
    """Copy the stored tensors, on any device, into a model's arrays(). Arrays that are not stored do not change.

    Raises:
        ValueError: a stored tensor has another shape than the array of its name.
    """
    for name, each in arrays.items():
        if name not in stored:
            continue
        if stored[name].shape != each.shape:
            shapes = tuple(stored[name].shape), tuple(each.shape)
            raise ValueError(f"{name} has shape {shapes[0]}, this model needs {shapes[1]}")
        each.copy_(stored[name])
