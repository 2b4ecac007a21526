"""A copy of one of the model's tensors: in memory, or if it is large in a file that is loaded row by row."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from intrasplat.machine.mapped import let_go, mapped_zeros

LARGE_BYTES = 192 << 20
"""Only the weights of a long clip are larger. Those of a usual clip, of up to 33 bases, stay in memory."""


class TensorCopy:
    """A copy of a float32 tensor. That of a GPU's tensor lies on the GPU."""

    def __init__(self, values: Tensor) -> None:
        """Raises StoreFullError if the disk is full."""
        self._file = None
        if values.device.type == "cpu" and values.numel() * values.element_size() > LARGE_BYTES:
            self._file = mapped_zeros(tuple(values.shape), np.float32)
            self._copy = torch.from_numpy(self._file)
            self.each(values, Tensor.copy_)
        else:
            self._copy = values.clone()

    def tensor(self) -> Tensor:
        """The copy; reading it loads it into memory, until let_go()."""
        return self._copy

    def each(self, values: Tensor, change: Callable[[Tensor, Tensor], object]) -> None:
        """Call change(copy, values), for all at once or row by row."""
        if self._file is None:
            self._copy = self._copy.to(values.device)  # a copy from a resume file lies on the host
            change(self._copy, values)
            return
        for row, copy, value in zip(self._file, self._copy, values, strict=True):
            change(copy, value)
            let_go(row)

    def let_go(self) -> None:
        """Release the memory of a copy that lies in a file."""
        if self._file is not None:
            let_go(self._file)
