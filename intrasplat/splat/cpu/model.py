"""The fused training step: deform, project, bin, blend with loss and gradients, then Adam on every parameter.

N Gaussians (padded to whole vectors), rows of N floats, F frames per step; canonical and state [ROWS, N].
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import groupby
from operator import attrgetter

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.splat.constants import SH_C0
from intrasplat.splat.cpu import harmonics, update
from intrasplat.splat.cpu.bins import TILE_ROWS
from intrasplat.splat.cpu.motion import Motion, motion_of, take_moments
from intrasplat.splat.cpu.rasterizer import Floats, Gradients, Rasterizer, padded
from intrasplat.splat.cpu.threads import flushing, run
from intrasplat.splat.deformation import Deformation
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import (
    COLOUR,
    DIM,
    GEOMETRY,
    GLOSS,
    GLOSS_ROW,
    LOG_SCALE,
    MEAN,
    QUATERNION,
    QUATERNION_ROW,
    ROWS,
    SIDE,
)
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.model import ProjectedPicture, bands_of, put_back
from intrasplat.splat.optimize import StepRates, adam_step
from intrasplat.splat.step import StepSums, TrainingFrame, camera_centre, image_size

PAD_LOGIT = -30.0
"""Opacity logit of the padding columns, which are never drawn."""
MAX_CACHED_SIZES = 3
"""Buffers are kept for so many image sizes, those used last."""


class CpuModel:
    """Canonical Gaussians, their deformation and Adam's moments, trained on the CPU. See intrasplat/splat/model.py."""

    steps_a_report = 1

    def __init__(
        self,
        gaussians: Gaussians,
        deformation: Deformation,
        width: int,
        height: int,
        *,
        make_motion: Callable[[Deformation, int, int], Motion] = motion_of,
    ) -> None:
        self.count = len(gaussians)
        columns = padded(self.count)
        canonical = torch.cat([gaussians.mean, gaussians.quaternion, gaussians.log_scale], 1).numpy()
        self.canonical = np.zeros((ROWS, columns), np.float32)
        self.canonical[QUATERNION_ROW] = 1.0
        self.canonical[GEOMETRY, : self.count] = canonical.T
        self.canonical[COLOUR, : self.count] = gaussians.sh[:, 0].T.numpy()
        self.canonical[GLOSS_ROW, : self.count] = gaussians.gloss.numpy()
        self.opacity_logit = np.full(columns, PAD_LOGIT, np.float32)
        self.opacity_logit[: self.count] = gaussians.opacity_logit.numpy()
        self.sh_rest = np.zeros((gaussians.sh.shape[1] - 1, 3, columns), np.float32)
        self.sh_rest[:, :, : self.count] = gaussians.sh[:, 1:].permute(1, 2, 0).numpy()
        self.sh_degree = gaussians.sh_degree  # the stored degree; a step may use a lower one
        self.motion = make_motion(deformation, self.count, columns)
        self._rasterizers: OrderedDict[tuple[int, int], Rasterizer] = OrderedDict()
        self.rasterizer = self._rasterizer(width, height)
        self._moments = {name: np.zeros((2, *a.shape), np.float32) for name, a in self._parameters().items()}
        self._allocate()

    def _parameters(self) -> dict[str, Floats]:
        return {"canonical": self.canonical, "opacity_logit": self.opacity_logit, "sh_rest": self.sh_rest}

    def _allocate(self, times: int = 1) -> None:
        """Allocate the Gaussians at one time, and their gradients at so many times per step."""
        columns = self.canonical.shape[1]
        self.state = np.zeros((ROWS, columns), np.float32)
        self.colour = np.zeros((3, columns), np.float32)
        self._v_state = np.zeros((times, ROWS, columns), np.float32)
        self._v_rest = np.zeros(self.sh_rest.shape, np.float32)
        total = Gradients.zeros(self._v_state[0])
        self._gradients = [replace(total, state=v_state) for v_state in self._v_state]  # they differ only in the state
        self._seen = np.zeros(columns, np.bool_)

    def _rasterizer(self, width: int, height: int) -> Rasterizer:
        """The buffers of an image size."""
        return self._cached(self._rasterizers.get((width, height)) or Rasterizer(width, height))

    def _cached(self, rasterizer: Rasterizer) -> Rasterizer:
        """Keep these buffers, and those of the few other sizes used last."""
        size = rasterizer.width, rasterizer.height
        self._rasterizers[size] = rasterizer
        self._rasterizers.move_to_end(size)
        while len(self._rasterizers) > MAX_CACHED_SIZES:
            self._rasterizers.popitem(last=False)
        return rasterizer

    @property
    def gradient_norm(self) -> Tensor:
        """[N] |dL/dmean2d| of the last step in NDC, the largest of its frames; a view."""
        return torch.from_numpy(self._gradients[0].mean2d_norm[: self.count])

    @property
    def visible(self) -> Tensor:
        """[N] whether any of the last step's frames could see each Gaussian."""
        return torch.from_numpy(self._seen[: self.count].copy())

    def project(self, camera: NDArray[np.float64], t: float, sh_degree: int) -> None:
        """Project the Gaussians at time t onto this camera's image."""
        self.motion.deform(self.canonical, t, self.state)
        self._project_and_sort(camera, sh_degree, self._rasterizer(*image_size(camera)))

    def _project_and_sort(self, camera: NDArray[np.float64], sh_degree: int, rasterizer: Rasterizer) -> None:
        """Project the Gaussians of the state onto this camera's image."""
        self._project_state(camera, sh_degree, rasterizer)
        rasterizer.sort()

    def _project_state(self, camera: NDArray[np.float64], sh_degree: int, rasterizer: Rasterizer) -> None:
        """First half of _project_and_sort, after which the state may be overwritten."""
        if sh_degree == 0:
            run(harmonics.colour_from_gloss, camera, self.state, self.colour)
        else:
            run(harmonics.colour_from_sh, sh_degree, camera_centre(camera), self.state, self.sh_rest, self.colour)
        self._project_coloured(camera, rasterizer)

    def _project_coloured(self, camera: NDArray[np.float64], rasterizer: Rasterizer) -> None:
        """Project the Gaussians of the state in the colours that are set."""
        rasterizer.project(camera, self.state, self.opacity_logit, self.colour)
        self.rasterizer = rasterizer

    def render(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> Floats:
        """R G B Z A, [5, H, W]; with values [N], blended as colour is, [6, H, W]. A view the next render overwrites."""
        self.project(camera, t, self.sh_degree)
        return self.rasterizer.render(values)

    def projected(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> ProjectedPicture:
        """The picture of render(), to be blended in bands. Until it is closed, others of its size use other buffers."""
        size = image_size(camera)
        rasterizer = self._rasterizers.pop(size, None) or Rasterizer(*size)
        self.motion.deform(self.canonical, t, self.state)
        self._project_state(camera, self.sh_degree, rasterizer)
        if values is not None:
            rasterizer.set_values(values)
        return _Projected(rasterizer, values is not None, self._cached)

    def blended(self, camera: NDArray[np.float64], t: float, planes: Floats) -> Floats:
        """planes [3, N], blended in place of R G B: [5, H, W]; a view the next render overwrites."""
        self.motion.deform(self.canonical, t, self.state)
        self.colour[:, : self.count] = planes
        self._project_coloured(camera, self._rasterizer(*image_size(camera)))
        self.rasterizer.sort()
        return self.rasterizer.render()

    def image_gradient(self, camera: NDArray[np.float64], t: float, cotangents: Floats) -> Floats:
        """Gradient of sum(cotangents * render(camera, t)) to the Gaussians as they are at t, [VALUES, N]."""
        self.project(camera, t, 0)
        gradients = self.rasterizer.cotangent_backward(cotangents)
        colour, gloss = gradients.colour * np.float32(SH_C0), self._shine(camera) * gradients.colour.sum(0)
        rows = [gradients.state[GEOMETRY], colour, gloss[None], gradients.opacity_logit[None]]
        return np.concatenate(rows)[:, : self.count]

    def _shine(self, camera: NDArray[np.float64]) -> Floats:
        """[N] derivative of each colour channel by the gloss."""
        gloss: Floats = self.state[GLOSS_ROW]
        return np.float32(camera[SIDE]) - np.float32(camera[DIM]) * np.sign(gloss)

    def deformed_mean(self, t: float) -> Floats:
        """Centres at time t, [3, N] in units, as a copy."""
        self.motion.deform(self.canonical, t, self.state)
        return self.state[MEAN, : self.count].copy()

    def step(
        self, frames: Sequence[TrainingFrame], loss: LossSettings, rates: StepRates, iteration: int, sh_degree: int = 0
    ) -> StepSums:
        """One iteration (counted from 1) on the sum of the frames' losses; sh_degree: the harmonics in use at it."""
        times = [(t, list(same)) for t, same in groupby(frames, key=attrgetter("t"))]
        if len(times) > len(self._gradients):
            self._allocate(len(times))
        self._seen[:] = False
        sums = [
            each for place, (t, same) in enumerate(times) for each in self._backward(place, t, same, loss, sh_degree)
        ]
        self.motion.update(self._v_state[: len(times)], [t for t, _ in times], rates, iteration)
        for v_state in self._v_state[1 : len(times)]:
            self._v_state[0] += v_state
        self.update_canonical(self._gradients[0], rates, iteration, sh_degree)
        colour_l1, depth_l1, squared_error, holes = np.sum(sums, axis=0).tolist()
        return StepSums(colour_l1, depth_l1, squared_error, holes, int(np.count_nonzero(self._seen[: self.count])))

    def _backward(
        self, place: int, t: float, frames: Sequence[TrainingFrame], loss: LossSettings, sh_degree: int
    ) -> list[NDArray[np.float64]]:
        """Compute the gradients of the losses of all frames at time t, which share one state; returns the losses' sums.

        place: index of that time in the step. All times add to the same gradients but those of the state.
        """
        gradients, sums = self._gradients[place], []
        self.motion.deform(self.canonical, t, self.state, trains=True)
        for k, frame in enumerate(frames):
            adds, adds_state = place + k > 0, k > 0
            self._project_and_sort(frame.camera, sh_degree, self._rasterizer(*image_size(frame.camera)))
            self.rasterizer.loss_backward(
                frame.target, frame.loss_settings(loss), gradients, adds=adds, adds_state=adds_state
            )
            if sh_degree == 0:
                run(
                    harmonics.colour_from_gloss_backward, frame.camera, self.state, self.colour, gradients.colour,
                    adds_state, gradients.state,
                )  # fmt: skip
            else:
                run(
                    harmonics.colour_from_sh_backward, sh_degree, camera_centre(frame.camera), self.state,
                    self.sh_rest, self.colour, gradients.colour, adds, adds_state, self._v_rest, gradients.state,
                )  # fmt: skip
                gradients.state[GLOSS_ROW] = 0
            self._seen |= self.rasterizer.radius2 >= 0
            sums.append(self.rasterizer.statistics.sum(0, dtype=np.float64))
        return sums

    def wait(self) -> None:
        """None: step() waits for the step and returns its sums."""

    def update_canonical(self, gradients: Gradients, rates: StepRates, iteration: int, sh_degree: int) -> None:
        """One Adam step of all parameters but the motion's, given dL/dcanonical."""
        canonical, moments = self.canonical, self._moments["canonical"]
        groups = (
            (MEAN, rates.mean),
            (QUATERNION, rates.quaternion),
            (LOG_SCALE, rates.log_scale),
            (COLOUR, rates.colour),
            (GLOSS, rates.gloss),
        )
        for rows, rate in groups:
            _adam(canonical[rows], gradients.state[rows], moments[:, rows], rate, rates, iteration)
        opacity_moments = self._moments["opacity_logit"]
        _adam(self.opacity_logit, gradients.opacity_logit, opacity_moments, rates.opacity, rates, iteration)
        if sh_degree > 0:
            rest, used = self._moments["sh_rest"], slice(0, (sh_degree + 1) ** 2 - 1)
            _adam(self.sh_rest[used], self._v_rest[used], rest[:, used], rates.sh_rest, rates, iteration)

    def take(self, columns: NDArray[np.int64], fresh: NDArray[np.bool_]) -> None:
        """Keep these Gaussians, in this order (repeats are copies); Adam's moments start at 0 where fresh."""
        count = len(columns)
        fill = padded(count) - count
        columns = np.concatenate([columns, np.zeros(fill, np.int64)])
        fresh = np.concatenate([fresh, np.ones(fill, np.bool_)])
        for name, values in self._parameters().items():
            setattr(self, name, np.ascontiguousarray(values[..., columns]))
            self._moments[name] = take_moments(self._moments[name], columns, fresh)
        self.motion.take(columns, fresh)
        self.opacity_logit[count:] = PAD_LOGIT
        self.count = count
        self._allocate()

    def parameters(self) -> dict[str, Tensor]:
        """The trained arrays by name; views."""
        return {**self._views(self._parameters()), **self.motion.parameters(self.count)}

    def arrays(self) -> dict[str, Tensor]:
        """All arrays that a resumed run needs, by name; views."""
        moments = {f"moments.{name}": values for name, values in self._moments.items()}
        return {**self._views(self._parameters() | moments), **self.motion.arrays(self.count)}

    def _views(self, padded_arrays: dict[str, Floats]) -> dict[str, Tensor]:
        return {name: torch.from_numpy(values)[..., : self.count] for name, values in padded_arrays.items()}

    def load_arrays(self, stored: dict[str, Tensor]) -> None:
        """Load what arrays() returned, or some of it, into a model of the same size."""
        put_back(self.arrays(), stored)

    def export(self, *, as_it_lies: bool = False) -> tuple[Gaussians, Deformation]:
        """The Gaussians and their deformation as torch tensors (copies)."""
        canonical = torch.from_numpy(np.ascontiguousarray(self.canonical[GEOMETRY, : self.count].T))
        sh = np.concatenate([self.canonical[None, COLOUR], self.sh_rest])[:, :, : self.count]
        gaussians = Gaussians(
            canonical[:, MEAN].contiguous(),
            canonical[:, QUATERNION].contiguous(),
            canonical[:, LOG_SCALE].contiguous(),
            torch.from_numpy(self.opacity_logit[: self.count].copy()),
            torch.from_numpy(np.ascontiguousarray(sh.transpose(2, 0, 1))),
            torch.from_numpy(self.canonical[GLOSS_ROW, : self.count].copy()),
        )
        return gaussians, self.motion.export(self.count, as_it_lies=as_it_lies)


@dataclass(frozen=True)
class _Projected:
    """See intrasplat/splat/model.py. keep: takes the rasterizer back."""

    rasterizer: Rasterizer
    with_values: bool
    keep: Callable[[Rasterizer], object]

    @property
    def bands(self) -> list[slice]:
        return bands_of(self.rasterizer.width, self.rasterizer.height, TILE_ROWS)

    def sort(self) -> None:
        self.rasterizer.sort()

    def blend(self, rows: slice) -> Floats:
        planes = self.rasterizer.render_rows(rows.start // TILE_ROWS, -(-rows.stop // TILE_ROWS))
        return planes if self.with_values else planes[:5]

    def close(self) -> None:
        self.keep(self.rasterizer)


def _adam(value: Floats, gradient: Floats, moments: Floats, rate: float, rates: StepRates, iteration: int) -> None:
    if rate == 0.0:
        return
    flat = [_flat(each) for each in (value, gradient, moments[0], moments[1])]
    run(flushing(update.adam), *flat, *map(np.float32, astuple(adam_step(rate, rates, iteration))))


def _flat(array: Floats) -> Floats:
    """A flat view. reshape alone would copy a strided array, and the kernel's update would be lost."""
    if not array.flags.c_contiguous:
        raise ValueError(f"an array of shape {array.shape} and strides {array.strides} has no flat view")
    return array.reshape(-1)
