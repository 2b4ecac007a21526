"""The buffers of one image size: the rasteriser's, the Gaussians at the frames' times, and the control block.

N Gaussians (padded), F frames at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.splat.cuda.captured import Captured
from intrasplat.splat.cuda.control import Control, ControlField, adam_fields
from intrasplat.splat.cuda.motion import Motion
from intrasplat.splat.cuda.rasterizer import CudaRasterizer
from intrasplat.splat.layout import CAMERA, DIM, ROWS, SIDE
from intrasplat.splat.step import camera_centre


class FrameBuffers:
    """The buffers of a step or a render of F frames of one size; the next one uses them again.

    launches  captured steps and renders; call forget() when a buffer moves
    values    [N], a number per Gaussian, blended as colour is
    images    the last render with values (True) and without (False)
    """

    def __init__(
        self, width: int, height: int, frames: int, motion: Motion, device: torch.device, *, rows: int = 1
    ) -> None:
        self.frames, self._device = frames, device
        self.rasterizer = CudaRasterizer(width, height, device, frames=frames)
        cameras = {
            "camera": ControlField((frames, CAMERA), "double"),
            "centre": ControlField((frames, 3)),
            "shine": ControlField((frames, 2)),
        }
        training = {"loss": ControlField((frames, 5)), "frame": ControlField((frames,), "int")} | adam_fields()
        self.control = Control(cameras | motion.fields(frames) | training, rows, device)
        self.launches = Captured(device)
        self.images: dict[bool, Tensor] = {}
        self.fit(0)

    def fit(self, columns: int) -> None:
        """Allocate the buffers for so many Gaussians."""
        self.launches.forget()
        self.state = torch.zeros(self.frames, ROWS, columns, device=self._device)
        self.colour = torch.zeros(self.frames, 3, columns, device=self._device)
        self.values = torch.zeros(columns, device=self._device)

    def write_cameras(self, row: int, cameras: Sequence[NDArray[np.float64]]) -> None:
        """Write the cameras into a row of the control block."""
        written = self.control.rows[row]
        for frame, camera in enumerate(cameras):
            written["camera"][frame], written["centre"][frame] = camera, camera_centre(camera)
            written["shine"][frame] = camera[SIDE], camera[DIM]
