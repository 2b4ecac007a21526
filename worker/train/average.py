"""The mean of a model over some of its steps, in which the noise of single steps cancels."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

PREFIX = "average."


class RunningMean:
    """Sums of a model's parameters, under their names and on their device."""

    def __init__(self) -> None:
        self.count = 0
        self._total: dict[str, Tensor] = {}

    def add(self, parameters: Mapping[str, Tensor]) -> None:
        """Add one model to the mean."""
        self.count += 1
        if self.count == 1:
            self._total = {name: values.clone() for name, values in parameters.items()}
            return
        for name, values in parameters.items():
            self._total[name] = self._total[name].to(values.device).add_(values)  # stored ones come from the host

    def put(self, parameters: Mapping[str, Tensor]) -> None:
        """Write the mean into these tensors, and reset the sums to zero."""
        for name, values in parameters.items():
            torch.div(self._total[name].to(values.device), self.count, out=values)
        self.count, self._total = 0, {}

    def arrays(self) -> dict[str, Tensor]:
        """The running sums under "average." names, for a resume file."""
        return {PREFIX + name: values for name, values in self._total.items()}

    def load_arrays(self, arrays: Mapping[str, Tensor], count: int) -> None:
        """Load what arrays() gave from a dict that may also hold other arrays."""
        self.count = count
        self._total = {name.removeprefix(PREFIX): a.clone() for name, a in arrays.items() if name.startswith(PREFIX)}
