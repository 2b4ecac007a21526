"""A copy of a tensor beside the model's: in memory, or where that is large, in a file, a row at a time in memory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from intrasplat.machine.mapped import let_go, mapped_zeros

LARGE_BYTES = 192 << 20
"""Of the weights of a long clip; those of a usual one, of up to 33 bases, are not worth the disk's time."""


class Aside:
    """A float32 tensor's copy, on its device where that is no CPU."""

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
        """The copy; what reads it brings it into memory, until let_go()."""
        return self._copy

    def each(self, values: Tensor, change: Callable[[Tensor, Tensor], object]) -> None:
        """change(copy, values), of all or row by row."""
        if self._file is None:
            self._copy = self._copy.to(values.device)  # stored ones come from the host
            change(self._copy, values)
            return
        for row, copy, value in zip(self._file, self._copy, values, strict=True):
            change(copy, value)
            let_go(row)

    def let_go(self) -> None:
        """Take what lies in a file out of memory."""
        if self._file is not None:
            let_go(self._file)
