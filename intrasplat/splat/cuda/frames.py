"""The training frames on the device. Each is copied at its first use and then stays there.

Symbols: T frames kept, H W pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from intrasplat.splat.step import TrainingFrame, image_size

FIRST_CAPACITY = 32
"""Initial capacity in frames. It doubles when it is full; whatever stores addresses must then be created again."""


class FrameStore:
    """The targets of training, as the rasteriser reads them.

    rgb            [T, 3, H, W] uint8
    weight         [T, H, W] uint8, 255 = tissue
    inverse_depth  [T, H, W] float32, 1 / units, 0 = none
    """

    def __init__(self, width: int, height: int, device: torch.device) -> None:
        self._width, self._height = width, height
        self._rows: dict[TrainingFrame, int] = {}
        self.rgb = torch.zeros(0, 3, height, width, dtype=torch.uint8, device=device)
        self.weight = torch.zeros(0, height, width, dtype=torch.uint8, device=device)
        self.inverse_depth = torch.zeros(0, height, width, device=device)

    @property
    def capacity(self) -> int:
        """Capacity in frames. When it changes, all frames have other addresses."""
        return int(self.rgb.shape[0])

    def row(self, frame: TrainingFrame) -> int:
        """The index of a frame along T; copies the frame if it is new.

        Raises:
            ValueError: it has another size.
        """
        if frame in self._rows:
            return self._rows[frame]
        width, height = image_size(frame.camera)
        if (width, height) != (self._width, self._height):
            raise ValueError(f"a frame of {width} x {height} pixels, the others have {self._width} x {self._height}")
        if len(self._rows) == self.capacity:
            more = max(FIRST_CAPACITY, self.capacity)
            self.rgb, self.weight, self.inverse_depth = (
                torch.cat([each, each.new_zeros(more, *each.shape[1:])])
                for each in (self.rgb, self.weight, self.inverse_depth)
            )
        row = self._rows[frame] = len(self._rows)
        target = frame.target
        self.rgb[row] = self._cropped(torch.from_numpy(target.rgb).view(3, height, -1))
        self.weight[row] = self._cropped(torch.from_numpy(target.weight).view(height, -1))
        self.inverse_depth[row] = self._cropped(torch.from_numpy(target.inverse_depth).view(height, -1))
        return row

    def _cropped(self, padded: Tensor) -> Tensor:
        """The rows without their padding, on the device."""
        return padded[..., : self._width].contiguous().to(self.rgb.device)
