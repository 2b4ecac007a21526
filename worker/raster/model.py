"""What training needs of a model, whatever computes its steps: Gaussians, their deformation and Adam's moments.

Symbols: N Gaussians; H W pixels, as many as the camera says; F frames per step.
Implementations: CpuModel (worker/raster/cpu/model.py) and CudaModel (worker/raster/cuda/model.py). Each holds a Motion,
which evaluates and trains the deformation: by kernels, or on the CPU by torch (worker/raster/cpu/unfused.py).
worker/raster/backend.py makes the one for a device.

A device may lag behind: step() may return before its step is made. Every other method waits for all steps first, so
none sees a model between two steps. The sums of a step that lags come with a later answer. They tell whether its loss
is a number and whether any Gaussian was in view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from worker.model.deformation import Deformation
from worker.model.gaussians import Gaussians
from worker.model.loss import LossSettings
from worker.model.optimize import StepRates
from worker.raster.step import StepSums, TrainingFrame

Floats = NDArray[np.float32]
FIRST_MOMENTS = "motion.first"
"""In Model.arrays()."""
BAND_PIXELS = 1 << 18
"""One core blends and converts so many in some 12 ms."""


def bands_of(width: int, height: int, multiple: int = 1) -> list[slice]:
    """The rows of an image, from top to bottom, in bands of about BAND_PIXELS that begin at multiples of a number."""
    rows = multiple * max(1, BAND_PIXELS // (width * multiple))
    return [slice(first, min(first + rows, height)) for first in range(0, height, rows)]


class Projected(Protocol):
    """The Gaussians at one time on one camera's image, in buffers of its own: its bands are blended one by one, and the
    model may render other pictures in between."""

    @property
    def bands(self) -> Sequence[slice]:
        """The image's rows, from top to bottom, about BAND_PIXELS of them at a time."""
        ...

    def sort(self) -> None:
        """Call it once before the first band: it may take as long as some of them."""
        ...

    def blend(self, rows: slice) -> Floats:
        """R G B Z A and the values of one of the bands, [5 or 6, h, W]; a view until close()."""
        ...

    def close(self) -> None:
        """Give the buffers back to the model."""
        ...


@dataclass(frozen=True)
class Blended:
    """A Projected whose bands are blended already. image: [5 or 6, H, W]."""

    image: Floats

    @property
    def bands(self) -> list[slice]:
        """As of Projected."""
        return bands_of(self.image.shape[2], self.image.shape[1])

    def sort(self) -> None:
        """There is nothing left to do."""

    def blend(self, rows: slice) -> Floats:
        """As of Projected."""
        return self.image[:, rows]

    def close(self) -> None:
        """There is nothing to give back."""


class Model(Protocol):
    """A scene that can be trained, on one frame per step or several, rendered, and edited between two steps.

    Tensors lie on the model's device; NumPy arrays on the host.
    """

    @property
    def count(self) -> int:
        """N."""
        ...

    @property
    def answers_every(self) -> int:
        """Steps from one answer to the next; 1 where every step is waited for."""
        ...

    def step(
        self, frames: Sequence[TrainingFrame], loss: LossSettings, rates: StepRates, iteration: int, sh_degree: int = 0
    ) -> StepSums | None:
        """One iteration (counted from 1): one step of Adam down the sum of the frames' losses.

        Args:
            frames: F of one size; a frame may occur more than once. Another F may allocate new buffers.
            sh_degree: the harmonics in use at this iteration.

        Returns:
            What the steps since the last answer add up to; None where the device has not been asked.
        """
        ...

    def wait(self) -> StepSums | None:
        """Return when every step is made: their sums, or None if there was none since the last answer."""
        ...

    @property
    def gradient_norm(self) -> Tensor:
        """[N] float32 |dL/dmean2d| of the last step in NDC (the image is 2 wide and 2 high), the largest of its frames;
        a view."""
        ...

    @property
    def visible(self) -> Tensor:
        """[N] bool, whether any of the last step's frames could see each: in front of the camera, in the image, not too
        faint."""
        ...

    def render(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> Floats:
        """R G B Z A, [5, H, W], Z = sum(w z) in units; a view that the next render overwrites.

        With values [N], a number per Gaussian, they are blended as colour is, and [6, H, W] ends with them.
        """
        ...

    def projected(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> Projected:
        """The same picture, to be blended in bands of rows, with the same bits. The caller closes it."""
        ...

    def blend_values(self, values: Floats) -> Floats:
        """Further values [N], blended as colour was in the last render: [H, W]; a view."""
        ...

    def image_gradient(self, camera: NDArray[np.float64], t: float, cotangents: Floats) -> Floats:
        """Gradient of sum(cotangents * render(camera, t)), cotangents [5, H, W], to the Gaussians as they are at t.

        [VALUES, N], rows as in worker/model/layout.py, colours as if none were held above 0. Other harmonics are left
        out.
        """
        ...

    def deformed_mean(self, t: float) -> Floats:
        """Centres at time t, [3, N] in units, as a copy."""
        ...

    def take(self, columns: NDArray[np.int64], fresh: NDArray[np.bool_]) -> None:
        """Keep these Gaussians, in this order (repeats are copies); Adam's moments start at 0 where fresh."""
        ...

    def parameters(self) -> dict[str, Tensor]:
        """What is trained, by name; views of the live tensors, on every device of one shape. May be written.

        Among them: canonical [ROWS, N], rows as in worker/model/layout.py, and opacity_logit [N].
        """
        ...

    def arrays(self) -> dict[str, Tensor]:
        """Everything a resumed run needs, by name; likewise."""
        ...

    def load_arrays(self, stored: dict[str, Tensor]) -> None:
        """Put back what arrays() gave, or some of it, on any device; ValueError if the sizes differ."""
        ...

    def export(self, *, as_it_lies: bool = False) -> tuple[Gaussians, Deformation]:
        """The Gaussians and their deformation as tensors on the host (copies).

        as_it_lies: the deformation's tensors need not be contiguous, which saves time to whoever makes a model of them.
        """
        ...


def state_of(model: Model, beta1: float) -> dict[str, Tensor]:
    """arrays() without a motion's first moments where no step asks for them: with beta1 = 0 each is the last gradient.

    They take much of the model's memory on a CPU as soon as they are touched.
    """
    return {name: values for name, values in model.arrays().items() if beta1 or name != FIRST_MOMENTS}


def put_back(arrays: Mapping[str, Tensor], stored: Mapping[str, Tensor]) -> None:
    """Copy the stored tensors, on any device, into a model's arrays(). What is not stored stays as it is.

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
