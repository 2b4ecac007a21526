"""The training step on the device: deform, project, bin, blend with loss and gradients, Adam; captured in a CUDA graph.

N Gaussians (padded to COLUMNS), rows of N floats; F frames per step; values [VALUES, N] as in update.py; H W pixels.

step() returns before the device has made its step. What changes from step to step goes to the device as one row of the
control block (control.py). Everything else is there already, so a step is a copy of some hundred floats and a replay.

Capacity. The rasteriser's buffers have space for a number of instances. A step that needs more changes nothing, nor do
the steps after it. Every CHECK_EVERY steps, and before any other use of the model, the host reads the report, enlarges
the buffers, and sends the missing steps again from the rows that it kept. So the initial capacity does not change the
result.

The host waits for the device: at every CHECK_EVERY-th step; in wait, and in every method and property but step; for
the picture of a render; for the copy of a frame at its first use; and when buffers grow.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.splat.constants import SH_C0
from intrasplat.splat.cuda import harmonics
from intrasplat.splat.cuda.buffers import FrameBuffers
from intrasplat.splat.cuda.control import write_adam
from intrasplat.splat.cuda.frames import FrameStore
from intrasplat.splat.cuda.motion import Motion, TrainedValues, motion_of, take_moments
from intrasplat.splat.cuda.rasterizer import Gradients
from intrasplat.splat.cuda.update import MADE, SEEN, SUMS, padded
from intrasplat.splat.deformation import Deformation
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.layout import (
    COLOUR,
    DIM,
    GLOSS,
    GLOSS_ROW,
    LOG_SCALE,
    MEAN,
    OPACITY_ROW,
    QUATERNION,
    QUATERNION_ROW,
    ROWS,
    SIDE,
    VALUES,
)
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.model import Blended, ProjectedPicture, put_back
from intrasplat.splat.optimize import StepRates
from intrasplat.splat.step import StepSums, TrainingFrame, image_size

Floats = NDArray[np.float32]
PAD_LOGIT = -30.0
"""Opacity logit of the padding columns, which are never drawn."""
CHECK_EVERY = 32
"""Steps from one read of the device's report to the next. The device idles during a read. After a step that exceeded
the capacity, at most so many are made again."""
MAX_CACHED_SIZES = 3
"""Buffers are kept for so many image sizes, those rendered last."""


class CudaModel:
    """Canonical Gaussians, their deformation and Adam's moments, trained on the device (intrasplat/splat/model.py)."""

    steps_a_report = CHECK_EVERY

    def __init__(
        self,
        gaussians: Gaussians,
        deformation: Deformation,
        width: int,
        height: int,
        device: str | torch.device = "cuda",
    ) -> None:
        self.count, self.device = len(gaussians), torch.device(device)
        columns = padded(self.count)
        values = torch.zeros(VALUES, columns)
        values[QUATERNION_ROW], values[OPACITY_ROW] = 1.0, PAD_LOGIT
        parts = [gaussians.mean, gaussians.quaternion, gaussians.log_scale, gaussians.sh[:, 0]]
        parts += [gaussians.gloss[:, None], gaussians.opacity_logit[:, None]]
        values[:, : self.count] = torch.cat(parts, 1).T
        sh_rest = torch.zeros(gaussians.sh.shape[1] - 1, 3, columns)
        sh_rest[:, :, : self.count] = gaussians.sh[:, 1:].permute(1, 2, 0)
        self.sh_degree = gaussians.sh_degree  # the stored degree; a step may use a lower one
        self._values, self._sh_rest = values.to(self.device), sh_rest.to(self.device)
        self._moments, self._rest_moments = (
            torch.zeros(2, *each.shape, device=self.device) for each in (self._values, self._sh_rest)
        )
        self.motion: Motion = motion_of(deformation, columns, self.device)
        self._size = width, height
        self._training = self._training_view(1)
        self._views: OrderedDict[tuple[int, int, int], FrameBuffers] = OrderedDict()
        self._store = FrameStore(width, height, self.device)
        self._report = torch.zeros(SEEN + CHECK_EVERY, dtype=torch.int32, device=self.device)
        self._sent: list[int] = []  # the harmonics' degree of every step since the last wait
        self._learnt: StepSums | None = None
        self._gradients: Gradients | None = None
        self._shown: FrameBuffers | None = None

    # Steps

    def step(
        self, frames: Sequence[TrainingFrame], loss: LossSettings, rates: StepRates, iteration: int, sh_degree: int = 0
    ) -> StepSums | None:
        """One iteration (counted from 1) on the sum of the frames' losses; sh_degree: the harmonics in use at it.

        Returns:
            The sums of the steps since the last StepSums, if this call read the report.

        Raises:
            ValueError: no frame, or more than the rasteriser draws at once (bins.MAX_FRAMES).
        """
        if len(frames) != self._training.frames:
            self._synchronize()
            self._training.launches.forget()
            self._training = self._training_view(len(frames))
        capacity, slot = self._store.capacity, len(self._sent)
        row, times = self._training.control.rows[slot], [frame.t for frame in frames]
        self._training.write_cameras(slot, [frame.camera for frame in frames])
        for k, frame in enumerate(frames):
            row["loss"][k], row["frame"][k] = frame.loss_settings(loss), self._store.row(frame)
        if self._store.capacity != capacity:
            self._training.launches.forget()
        write_adam(row, slot, rates, iteration)
        self.motion.write_times(row, times)
        self.motion.write_rates(row, times, rates, iteration)
        self._sent.append(sh_degree)
        self._send(slot)
        if len(self._sent) == CHECK_EVERY:
            self._synchronize()
        return self._answer()

    def _training_view(self, frames: int) -> FrameBuffers:
        """The buffers of steps on so many frames."""
        view = FrameBuffers(*self._size, frames, self.motion, self.device, rows=CHECK_EVERY)
        view.fit(self._values.shape[1])
        return view

    def wait(self) -> StepSums | None:
        """Wait until every step is made; the sums of the steps since the last StepSums, or None without any."""
        self._synchronize()
        return self._answer()

    def _send(self, slot: int) -> None:
        """Send the row of a step, and launch the step."""
        sh_degree = self._sent[slot]
        self._training.control.send(slot)
        self._training.launches.run(("step", sh_degree), lambda: self._launch(sh_degree))

    def _launch(self, sh_degree: int) -> None:
        """Launch the kernels of a step, in order."""
        view = self._training
        self._project_and_sort(view, sh_degree)
        control, rasterizer = view.control.values, view.rasterizer
        store = self._store
        gradients = rasterizer.loss_backward(
            store.rgb, store.weight, store.inverse_depth, control["loss"], control["frame"]
        )
        if sh_degree > 0:
            seen, shown = (view.state, control["centre"], view.colour), (gradients.colour, gradients.state)
            harmonics.evaluate_backward(self._sh_rest, *seen, *shown, sh_degree)
            harmonics.update(
                self._sh_rest, self._rest_moments, *seen, gradients.colour, rasterizer.ok, control, sh_degree
            )
        trained = TrainedValues(
            self._values, self._moments, gradients.state, gradients.opacity_logit, gradients.colour, view.colour,
            control["shine"], rasterizer.count, rasterizer.statistics, rasterizer.ok, self._report,
        )  # fmt: skip
        self.motion.update(trained, control)
        self._gradients = gradients

    def _project_and_sort(self, view: FrameBuffers, sh_degree: int) -> None:
        """Project the Gaussians, at the times and with the cameras of the view's control block."""
        control = view.control.values
        self.motion.deform(self._values, control, view.state, view.colour)
        if sh_degree > 0:
            harmonics.evaluate(self._sh_rest, view.state, control["centre"], view.colour, sh_degree)
        view.rasterizer.project_and_sort(control["camera"], view.state, self._values[OPACITY_ROW], view.colour)

    def _synchronize(self) -> None:
        """Wait for the steps sent, and send those again that exceeded the capacity."""
        first = 0
        while first < len(self._sent):
            grown = self._training.rasterizer.grown()
            first = self._learn(first)
            if not grown:
                break
            self._training.launches.forget()
            for slot in range(first, len(self._sent)):
                self._send(slot)
        self._sent.clear()

    def _learn(self, first: int) -> int:
        """Read the report of the steps made from `first` on; returns the place of the first that was not made."""
        report = self._report.to("cpu", copy=True)
        self._report.zero_()
        last = first + int(report[MADE])
        if last == first:
            return last
        colour_l1, depth_l1, squared_error, holes = report[:SUMS].view(torch.float32).tolist()
        visible = int(report[SEEN + first : SEEN + last].min())
        before = self._learnt or StepSums(0.0, 0.0, 0.0, 0.0, visible)
        self._learnt = StepSums(
            before.colour_l1 + colour_l1,
            before.depth_l1 + depth_l1,
            before.squared_error + squared_error,
            before.holes + holes,
            min(before.visible, visible),
        )
        return last

    def _answer(self) -> StepSums | None:
        """The sums read since the last call."""
        learnt, self._learnt = self._learnt, None
        return learnt

    @property
    def gradient_norm(self) -> Tensor:
        """[N] |dL/dmean2d| of the last step in NDC, the largest of its frames."""
        self._synchronize()
        if self._gradients is None:
            raise ValueError("no step has been made")
        return self._gradients.mean2d_norm[:, : self.count].amax(0)

    @property
    def visible(self) -> Tensor:
        """[N] whether any of the last step's frames could see each Gaussian."""
        self._synchronize()
        return self._training.rasterizer.count[:, : self.count].amax(0) > 0

    # Pictures

    def _view(self, width: int, height: int, frames: int) -> FrameBuffers:
        """The buffers for so many images of this size; those of the sizes used last are kept."""
        if (width, height) == self._size and frames == self._training.frames:
            return self._training
        size = width, height, frames
        if size not in self._views:
            self._views[size] = FrameBuffers(width, height, frames, self.motion, self.device)
            self._views[size].fit(self._values.shape[1])
        self._views.move_to_end(size)
        while len(self._views) > MAX_CACHED_SIZES:
            self._views.popitem(last=False)[1].launches.forget()
        return self._views[size]

    def _steer(self, camera: NDArray[np.float64], times: Sequence[float]) -> FrameBuffers:
        """Wait for all steps; the buffers, with these times and this camera in their control block."""
        self._synchronize()
        view = self._view(*image_size(camera), len(times))
        view.write_cameras(0, [camera] * len(times))
        self.motion.write_times(view.control.rows[0], times)
        view.control.send(0)
        return view

    def _fitted(self, view: FrameBuffers) -> bool:
        """Wait; whether the capacity was enough for the last projection. If not, it is enlarged."""
        grown = view.rasterizer.grown()
        if grown:
            view.launches.forget()
        return not grown

    def render_times(self, camera: NDArray[np.float64], times: Sequence[float], values: Floats | None = None) -> Tensor:
        """R G B Z A at several times at once, [F, 5, H, W] on the device; a view that the next render overwrites.

        With values [N], a number per Gaussian, they are blended as colour is, and [F, 6, H, W] ends with them.

        Raises:
            ValueError: more times than the rasteriser draws at once (bins.MAX_FRAMES).
        """
        view = self._shown = self._steer(camera, times)
        with_values = values is not None
        if values is not None:
            view.values[: self.count] = torch.from_numpy(np.asarray(values, np.float32))
        while True:
            view.launches.run(("picture", self.sh_degree, with_values), lambda: self._draw(view, with_values))
            if self._fitted(view):
                return view.images[with_values]

    def _draw(self, view: FrameBuffers, with_values: bool) -> None:
        """Launch the kernels of a picture."""
        self._project_and_sort(view, self.sh_degree)
        view.images[with_values] = view.rasterizer.render(view.values if with_values else None)

    def render(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> Floats:
        """R G B Z A, [5, H, W]; with values [N], blended as colour is, [6, H, W]. A view the next render overwrites."""
        image: Floats = self.render_times(camera, [t], values)[0].cpu().numpy()
        return image

    def projected(self, camera: NDArray[np.float64], t: float, values: Floats | None = None) -> ProjectedPicture:
        """The picture of render(), already blended: a GPU does not divide it into bands."""
        return Blended(self.render_times(camera, [t], values)[0].to("cpu", copy=True).numpy())

    def blended(self, camera: NDArray[np.float64], t: float, planes: Floats) -> Floats:
        """planes [3, N], blended in place of R G B: [5, H, W]; a view the next render overwrites."""
        view = self._steer(camera, [t])
        control, wanted = view.control.values, torch.from_numpy(np.ascontiguousarray(planes, np.float32))
        while True:
            self.motion.deform(self._values, control, view.state, view.colour)
            view.colour[0, :, : self.count] = wanted.to(self.device)
            view.rasterizer.project_and_sort(control["camera"], view.state, self._values[OPACITY_ROW], view.colour)
            image: Floats = view.rasterizer.render(None)[0].cpu().numpy()
            if self._fitted(view):
                return image

    def image_gradient(self, camera: NDArray[np.float64], t: float, cotangents: Floats) -> Floats:
        """Gradient of sum(cotangents * image), cotangents [5, H, W], to the Gaussians as they are at t, [VALUES, N]."""
        view = self._steer(camera, [t])
        wanted = torch.from_numpy(np.ascontiguousarray(cotangents, np.float32)).to(self.device)[None]
        while True:
            self._project_and_sort(view, 0)
            found = view.rasterizer.cotangent_backward(wanted)
            if self._fitted(view):
                break
        shine = float(camera[SIDE]) - float(camera[DIM]) * torch.sign(view.state[0, GLOSS])
        gloss = shine * found.colour[0].sum(0)
        rows = torch.cat([found.state[0], found.colour[0] * SH_C0, gloss, found.opacity_logit])
        gradient: Floats = rows[:, : self.count].cpu().numpy()
        return gradient

    def deformed_mean(self, t: float) -> Floats:
        """Centres at time t, [3, N] in units, as a copy."""
        self._synchronize()
        view = self._view(*self._size, 1)
        self.motion.write_times(view.control.rows[0], [t])
        view.control.send(0)
        self.motion.deform(self._values, view.control.values, view.state, view.colour)
        mean: Floats = view.state[0, MEAN, : self.count].cpu().numpy().copy()
        return mean

    # What is stored

    def take(self, columns: NDArray[np.int64], fresh: NDArray[np.bool_]) -> None:
        """Keep these Gaussians, in this order (repeats are copies); Adam's moments start at 0 where fresh."""
        self._synchronize()
        count = len(columns)
        fill = padded(count) - count
        chosen = torch.from_numpy(np.concatenate([columns, np.zeros(fill, np.int64)])).to(self.device)
        is_fresh = torch.from_numpy(np.concatenate([fresh, np.ones(fill, np.bool_)])).to(self.device)
        self._values, self._sh_rest = (each.index_select(-1, chosen) for each in (self._values, self._sh_rest))
        self._moments, self._rest_moments = (
            take_moments(each, chosen, is_fresh) for each in (self._moments, self._rest_moments)
        )
        self.motion.take(chosen, is_fresh)
        self._values[OPACITY_ROW, count:] = PAD_LOGIT
        self.count = count
        self._training.fit(len(chosen))
        for view in self._views.values():
            view.fit(len(chosen))
        self._gradients = self._shown = None

    def parameters(self) -> dict[str, Tensor]:
        """The trained tensors by name; views."""
        self._synchronize()
        return self._own(self._values, self._sh_rest) | self.motion.parameters(self.count)

    def _own(self, values: Tensor, sh_rest: Tensor, prefix: str = "") -> dict[str, Tensor]:
        """values [..., VALUES, N] and sh_rest [..., K - 1, 3, N] by their names, without the padding columns."""
        named = {"canonical": values[..., :ROWS, :], "opacity_logit": values[..., OPACITY_ROW, :], "sh_rest": sh_rest}
        return {prefix + name: each[..., : self.count] for name, each in named.items()}

    def arrays(self) -> dict[str, Tensor]:
        """All tensors that a resumed run needs, by name; views, motion.steps on the host."""
        self._synchronize()
        moments = self._own(self._moments, self._rest_moments, "moments.")
        return self._own(self._values, self._sh_rest) | moments | self.motion.arrays(self.count)

    def load_arrays(self, stored: dict[str, Tensor]) -> None:
        """Load what arrays() returned, on any device, into a model of the same size; ValueError if the sizes differ."""
        put_back(self.arrays(), stored)

    def export(self, *, as_it_lies: bool = False) -> tuple[Gaussians, Deformation]:
        """The Gaussians and their deformation as tensors on the host (copies)."""
        del as_it_lies
        self._synchronize()
        values, sh_rest = (each[..., : self.count].cpu() for each in (self._values, self._sh_rest))
        mean, quaternion, log_scale = (
            values[rows].T.clone(memory_format=torch.contiguous_format) for rows in (MEAN, QUATERNION, LOG_SCALE)
        )
        sh = torch.cat([values[None, COLOUR], sh_rest]).permute(2, 0, 1).contiguous()
        opacity_logit, gloss = values[OPACITY_ROW].clone(), values[GLOSS_ROW].clone()
        gaussians = Gaussians(mean, quaternion, log_scale, opacity_logit, sh, gloss)
        return gaussians, self.motion.export(self.count)
