"""The mean of a model over some of its steps, in which the noise of single steps cancels."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from intrasplat.machine.mapped import let_go, mapped_zeros

PREFIX = "average."
LARGE_BYTES = 192 << 20
"""Only the weights of a long clip are larger. Those of a usual clip, of up to 33 bases, stay in memory."""


class TensorCopy:
    """A copy of a float32 tensor: in memory, or if it is large in a file that is loaded row by row.

    The copy of a GPU's tensor lies on the GPU.
    """

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


class RunningMean:
    """Sums of a model's parameters, by name. They lie on the parameters' device, or in files where they are large."""

    def __init__(self) -> None:
        self.count = 0
        self._total: dict[str, TensorCopy] = {}

    def add(self, parameters: Mapping[str, Tensor]) -> None:
        """Add one model to the mean."""
        self.count += 1
        if self.count == 1:
            self._total = {name: TensorCopy(values) for name, values in parameters.items()}
            return
        for name, values in parameters.items():
            self._total[name].each(values, Tensor.add_)

    def put(self, parameters: Mapping[str, Tensor]) -> None:
        """Write the mean into these tensors, and reset the sums to zero."""
        for name, values in parameters.items():
            self._total[name].each(values, lambda total, value: torch.div(total, self.count, out=value))
        self.count, self._total = 0, {}

    def arrays(self) -> dict[str, Tensor]:
        """The running sums under "average." names, for a resume file."""
        return {PREFIX + name: total.tensor() for name, total in self._total.items()}

    def let_go(self) -> None:
        """Release the memory of sums that lie in files; call it while arrays() are read."""
        for total in self._total.values():
            total.let_go()

    def load_arrays(self, arrays: Mapping[str, Tensor], count: int) -> None:
        """Load what arrays() returned; `arrays` may hold other names too. count: models added so far."""
        self.count = count
        self._total = {
            name.removeprefix(PREFIX): TensorCopy(a) for name, a in arrays.items() if name.startswith(PREFIX)
        }
