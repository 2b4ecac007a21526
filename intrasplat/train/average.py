"""The mean of a model over some of its steps, in which the noise of single steps cancels."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from intrasplat.train.tensor_copy import TensorCopy

PREFIX = "average."


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
